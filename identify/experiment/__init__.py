"""Simulated experiment: the true plant, the sensor in its loop, and the truth.

The estimator never reads the truth.
"""
