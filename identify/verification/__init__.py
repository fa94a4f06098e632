"""Checks of a robot, of a sensor, and of the telemetry of a run.

They include the comparison of a robot's model with MuJoCo, and maps of its workspace.
"""
