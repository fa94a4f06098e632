"""Kinematics of the platform: its coordinates and rates, the motion of its joints, closed loops."""
