"""Measurement of a pose and its covariance from detected stickers. It knows nothing of true
poses.
"""
