"""Measurement of a pose and its covariance from detected stickers. Knows nothing of true poses."""
