"""Estimators on the same record: the project's own, and those of the literature.

None of them sees the sensor's inside or the truth.
"""
