"""Estimators on the same record: the project's own, and those of the literature.

No estimator has access to the internals of the sensor or to the truth.
"""
