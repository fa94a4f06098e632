"""Common errors of all poses, due to the known rig, teaching and drift, and drift detection."""
