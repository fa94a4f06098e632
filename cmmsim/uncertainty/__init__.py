"""Errors that all poses have in common: of the rig as it is known, of teaching, and of a drift."""
