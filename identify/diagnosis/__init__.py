"""Diagnosis of a model that misses its record: which cause explains the residuals, and its size."""
