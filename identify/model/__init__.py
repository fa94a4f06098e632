"""Model of a recorded run: what drives it, its residuals, and their whitening."""
