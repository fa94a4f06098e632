"""Poses, cameras, the stereo rig, frames from planes, and the image of a disc.

The modules of this package use neither files nor images.
"""
