"""Centres of stickers in images: search, fits, other detectors, and the bound that none can
beat.
"""
