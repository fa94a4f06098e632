"""Kinematic calibration by static poses: joints, axes, zero angles and lengths of legs."""
