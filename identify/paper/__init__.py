"""Figures and tables of the paper, from our own runs beside its numbers."""
