"""Poses, cameras, the stereo rig, frames from planes, and the image of a disc. Knows no file and no
image.
"""
