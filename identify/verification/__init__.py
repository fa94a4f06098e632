"""Checks of a robot without any sensor, and of a sensor without any robot."""
