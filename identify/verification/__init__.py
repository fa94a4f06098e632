"""Checks of a robot without a sensor, and of a sensor without a robot.

A robot's model is compared with MuJoCo, and its workspace is mapped.
"""
