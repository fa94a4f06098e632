"""Checks of a robot without a sensor, and of a sensor without a robot.

They include the comparison of a robot's model with MuJoCo, and maps of its workspace.
"""
