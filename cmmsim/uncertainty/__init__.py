"""Errors that all poses have in common: errors of the known rig, of teaching, and of a drift."""
