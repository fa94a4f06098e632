"""Checks of a robot without any sensor: against MuJoCo in the paper's figure 7, and maps of its workspace."""
