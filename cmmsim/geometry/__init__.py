"""Poses, cameras, the stereo rig, frames from planes, and the image of a disc.

Nothing here knows files or images.
"""
