"""Model of a recorded run: what drives it, what it misses, and what whitens that."""
