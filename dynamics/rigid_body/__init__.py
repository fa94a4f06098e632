"""The rigid robot in CasADi: virtual-work dynamics in twists, and the equation of motion in pose coordinates."""
