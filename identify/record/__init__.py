"""What the experimenter has: the record of a run, and the motion and loop it was asked for."""
