"""Acceptance tests of the sensor in the style of standards.

VDI/VDE 2634-1 tests lengths, ASTM E3064-16 a moving bar, and ASTM E3124 latency. The artefacts are
imaged by the sensor's own virtual cameras, and measured by its own detection and triangulation.
Their true sizes and poses are used only to judge the result.
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
