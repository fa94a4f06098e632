"""Exciting trajectories: criteria, constraints and searches (section 3.3)."""
