"""Exposures without images: random sticker centres that simulate the results of a detector."""
