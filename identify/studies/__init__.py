"""Noise studies: a scenario varied over factors, in many rows, on one machine or many."""
