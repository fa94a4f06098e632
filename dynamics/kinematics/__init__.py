"""Kinematics of the platform: coordinates and their rates, motion of its joints, closed loops."""
