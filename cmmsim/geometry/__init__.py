"""Poses, cameras, lens distortion, triangulation, registration, frames from planes, and discs.

The modules of this package use neither files nor images.
"""
