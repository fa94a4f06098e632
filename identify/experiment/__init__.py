"""Simulated experiment: the true plant, the sensor in its loop, and the truth.

Only validation and reports read the truth.
"""
