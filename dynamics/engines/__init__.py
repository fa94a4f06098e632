"""Robots in other multibody engines, and from their files."""
