"""Judging against the truth: unseen trajectories, estimators side by side, variation of the
estimates.
"""
