"""Detectors of sticker centres in images, and the Cramer-Rao bound of their errors."""
