"""Sensor files (TOML): schema, reading, and the rig and the bodies that they describe."""

from cmmsim.files.schema import SensorFile, Timing
from cmmsim.files.sensor_file import built_in_names, dotted, read_sensor_file

__all__ = ["SensorFile", "Timing", "built_in_names", "dotted", "read_sensor_file"]
