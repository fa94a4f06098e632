"""Figures and tables of the paper from our own runs, beside the numbers of the paper."""
