"""From detected stickers to a pose with its covariance, and the teaching of frames and stickers."""
