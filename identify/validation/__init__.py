"""Validation against the truth, comparison of estimators, and variation of estimates."""
