"""Poses, cameras, lens distortion, triangulation, registration, frames from planes, and stickers.

The modules of this package neither read files nor process images.
"""
