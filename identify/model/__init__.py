"""Model of a recorded run: its input, its residuals, and their whitening."""
