"""Rigid-body dynamics in CasADi: virtual work, and the equation of motion in coordinates."""
