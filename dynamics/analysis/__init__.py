"""What can be asked of a robot: workspace, body frames, inertias, errors of its geometry."""
