"""Estimators on the same record, the project's own and those of the literature; none sees sensor or
truth.
"""
