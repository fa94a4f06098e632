"""Validation against the truth on unseen motions, comparison of estimators, and their variation."""
