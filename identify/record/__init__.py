"""Records of runs: their data, their provenance, and checks before an identification."""
