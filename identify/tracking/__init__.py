"""Tracking of motions under a law and a model, with images in the loop (`cmmsim track`)."""
