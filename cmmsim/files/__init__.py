"""Sensor files (TOML): their schema, how they are read, and the rig and the bodies that they describe."""
