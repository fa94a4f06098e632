"""The record of a run, with the motion that was asked for and the loop that made it."""
