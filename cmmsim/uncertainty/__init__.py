"""Common errors of all poses, due to the known rig, teaching and print, and drift detection."""
