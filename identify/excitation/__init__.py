"""Exciting trajectories: criteria, constraints and searches (section 3.3)."""

from identify.excitation.design import design_trajectories

__all__ = ["design_trajectories"]
