"""Kinematic calibration: where joints, axes and zero angles of a robot are, and how long its legs,
by static poses.
"""
