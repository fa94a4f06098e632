"""Exposures without images: which stickers a detector would find in them, where, and with which covariance."""
