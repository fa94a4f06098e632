"""Rigid robot in CasADi: virtual work in twists, and the equation of motion in coordinates."""
