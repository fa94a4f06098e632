"""Kinematics of the platform: its coordinates and their rates, the motion of its joints, forward kinematics."""
