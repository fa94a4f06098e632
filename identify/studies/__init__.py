"""Noise studies: a scenario varied over factors, many rows, on one machine or many."""
