"""Errors that all poses have in common: those of the known rig, of teaching, and of a drift."""
