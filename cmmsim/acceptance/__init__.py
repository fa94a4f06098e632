"""Acceptance tests of the sensor in the style of standards.

Lengths are tested in the style of VDI/VDE 2634-1, a moving bar in that of ASTM E3064-16, and
latency in that of ASTM E3124. The sensor's own virtual cameras take images of the artefacts, and
its own detection and triangulation measure them. True sizes and poses of the artefacts are used
only to compute the errors.
"""

from cmmsim.acceptance.artefacts import SensorUnderTest
from cmmsim.acceptance.latency_test import Latency, LatencyTest, estimate_latency, latency_test
from cmmsim.acceptance.length_test import LengthTest, length_test
from cmmsim.acceptance.moving_bar import BarTest, bar_paths, bar_test
from cmmsim.acceptance.statistics import PUBLISHED, Statistics, interval_of_mean, summarise
from cmmsim.acceptance.volume import (
    MeasuringLine,
    MeasuringVolume,
    common_volume,
    require_rules,
    seven_lines,
    volume_of_size,
)
from cmmsim.errors import AcceptanceError

__all__ = [
    "PUBLISHED",
    "AcceptanceError",
    "BarTest",
    "Latency",
    "LatencyTest",
    "LengthTest",
    "MeasuringLine",
    "MeasuringVolume",
    "SensorUnderTest",
    "Statistics",
    "bar_paths",
    "bar_test",
    "common_volume",
    "estimate_latency",
    "interval_of_mean",
    "latency_test",
    "length_test",
    "require_rules",
    "seven_lines",
    "summarise",
    "volume_of_size",
]
