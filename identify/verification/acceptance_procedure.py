"""The acceptance tests of one sensor, one after the other, and whether its limit is kept."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cmmsim import UnknownOptionError
from cmmsim.acceptance import (
    AcceptanceError,
    BarTest,
    LatencyTest,
    LengthTest,
    MeasuringVolume,
    SensorUnderTest,
    bar_paths,
    bar_test,
    common_volume,
    latency_test,
    length_test,
    seven_lines,
    volume_of_size,
)
from cmmsim.acceptance.latency_test import FRAMES, require_room
from cmmsim.files.sensor_file import read_sensor_file
from identify.progress import Progress

STANDARDS = ("vdi", "e3064", "e3124")


@dataclass
class AcceptanceRun:
    """What was tested and what came out: a test that was not asked for is None. seconds of each test."""

    under_test: SensorUnderTest
    renderer: str
    volume: MeasuringVolume
    length: LengthTest | None = None
    bar: BarTest | None = None
    latency: LatencyTest | None = None
    seconds: dict[str, float] = field(default_factory=dict)


def chosen_standards(name: str) -> tuple[str, ...]:
    """The tests that a ``--standard`` names.

    Raises:
        UnknownOptionError: with the valid names.
    """
    if name != "all" and name not in STANDARDS:
        raise UnknownOptionError("standard", name, (*STANDARDS, "all"))
    return STANDARDS if name == "all" else (name,)


def require_limit(limit_um: float) -> None:
    """Refuse a limit of the length error that is no positive number.

    Raises:
        AcceptanceError: with the value.
    """
    if not (math.isfinite(limit_um) and limit_um > 0.0):
        raise AcceptanceError(f"the limit of the length error must be a positive number of um, got {limit_um:g}")


def parse_volume(text: str) -> np.ndarray:
    """Sides (3,) [m] of a volume written as ``0.6`` (a cube) or ``0.7x0.6x0.6``.

    Raises:
        AcceptanceError: anything else.
    """
    try:
        sides = np.array([float(part) for part in text.lower().split("x")])
    except ValueError:
        sides = np.zeros(0)
    if len(sides) not in (1, 3) or not np.all(np.isfinite(sides)):
        raise AcceptanceError(f"volume {text!r} is neither one side of a cube nor WIDTHxHEIGHTxDEPTH in m, such as 0.6")
    return np.broadcast_to(sides, 3).copy()


def prepare(
    sensor: str | Path, seed: int, renderer: str | None, volume: str | None, standards: Sequence[str]
) -> AcceptanceRun:
    """An empty run, with everything that can be wrong checked before anything is drawn.

    Raises:
        CmmError: an unknown sensor or renderer, or a volume that is not seen, breaks a rule or lacks room for the bar.
    """
    file = read_sensor_file(sensor)
    under_test = SensorUnderTest(file, seed, renderer)
    found = common_volume(file.rig) if volume is None else volume_of_size(file.rig, parse_volume(volume))
    if "vdi" in standards:
        seven_lines(found)
    if "e3064" in standards:
        bar_paths(found)
    if "e3124" in standards:
        require_room(found)
    return AcceptanceRun(under_test, under_test.renderer_name(), found)


def do(run: AcceptanceRun, standards: Sequence[str], progress: Progress) -> None:
    """Do the tests of a prepared run."""
    under_test, volume = run.under_test, run.volume
    for standard in standards:
        start = time.perf_counter()
        if standard == "vdi":
            with progress.stage("lengths (VDI/VDE 2634-1)", len(seven_lines(volume))) as advance:
                run.length = length_test(under_test, volume, advance=advance)
        elif standard == "e3064":
            with progress.stage("moving bar (ASTM E3064)", len(bar_paths(volume))) as advance:
                run.bar = bar_test(under_test, volume, advance=advance)
        else:
            with progress.stage("latency (ASTM E3124)", FRAMES) as advance:
                run.latency = latency_test(under_test, volume, advance=advance)
        run.seconds[standard] = time.perf_counter() - start
