"""Measurement of a pose and its covariance from detected stickers, without use of true poses."""
