"""Export of robots to MJCF and URDF files, import from such files, and simulation in MuJoCo."""
