"""Export of robots to MuJoCo, and import of robots from MJCF and URDF files."""
