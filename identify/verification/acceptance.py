"""Acceptance tests of one sensor, and their results for ``acceptance.json``."""

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cmmsim import UnknownOptionError
from cmmsim.acceptance import (
    PUBLISHED,
    AcceptanceError,
    BarTest,
    LatencyTest,
    LengthTest,
    MeasuringVolume,
    SensorUnderTest,
    bar_paths,
    bar_test,
    common_volume,
    interval_of_mean,
    latency_test,
    length_test,
    seven_lines,
    summarise,
    volume_of_size,
)
from cmmsim.acceptance.artefacts import LENGTH
from cmmsim.acceptance.latency_test import FRAMES, require_room
from cmmsim.files.sensor_file import read_sensor_file
from identify.files.versions import versions
from identify.progress import Progress
from identify.random_streams import RESAMPLING, mixed_generator
from identify.reporting.goal_causes import Advice

# Number of standard deviations up to which noise explains a length error. By chance, the largest of
# the 35 errors of a test exceeds this number in one of 60 tests.
STDS = 3.5
BLOCK = 10  # number of neighbouring frames of the bar that are resampled together


@dataclass
class AcceptanceRun:
    """Acceptance tests of a sensor and their results.

    ``sensor`` is the sensor's name or file as it was typed. ``standards`` are the names of the
    tests to run. ``limit_um`` is the limit of the length error. ``found`` holds the results and
    ``seconds`` the durations, by the name of the test.
    """

    sensor: str
    under_test: SensorUnderTest
    renderer: str
    volume: MeasuringVolume
    standards: tuple[str, ...]
    limit_um: float
    found: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Standard:
    """Test of one standard.

    Attributes
    ----------
    title
        Name in progress bars.
    key
        Name in ``acceptance.json``.
    steps
        Function that returns the number of steps of the test in a volume. It raises
        AcceptanceError for a volume without room for the test.
    measure
        Function that runs the test and returns its result.
    figures
        Function that returns the entry of ``acceptance.json``.
    """

    title: str
    key: str
    steps: Callable[[MeasuringVolume], int]
    measure: Callable[..., Any]
    figures: Callable[[Any, AcceptanceRun], dict[str, Any]]


def prepare(
    sensor: str | Path,
    seed: int,
    renderer: str | None,
    volume: str | None,
    standard: str,
    limit_um: float,
) -> AcceptanceRun:
    """Prepare a run, and check all arguments before any image is drawn.

    Parameters
    ----------
    sensor
        Name or file of a sensor.
    seed
        Seed of the sensor's noise.
    renderer
        Renderer of the images, or None for the sensor's default.
    volume
        Sides of the measuring volume, see `parse_volume`, or None for the largest visible cube.
    standard
        Name of a test, or ``all``.
    limit_um
        Limit of the length error, in µm.

    Raises
    ------
    CmmError
        The sensor, renderer or standard is unknown, the limit is not a positive number, or the
        volume is not visible, violates a rule of a standard or has no room for a test.
    """
    if not (math.isfinite(limit_um) and limit_um > 0.0):
        raise AcceptanceError(
            f"the limit of the length error must be a positive number of um, got {limit_um:g}"
        )
    if standard != "all" and standard not in STANDARDS:
        raise UnknownOptionError("standard", standard, (*STANDARDS, "all"))
    standards = tuple(STANDARDS) if standard == "all" else (standard,)
    file = read_sensor_file(sensor)
    under_test = SensorUnderTest(file, seed, renderer)
    if volume is None:
        chosen = common_volume(file.rig)
    else:
        chosen = volume_of_size(file.rig, parse_volume(volume))
    # Counting the steps refuses a volume without room for the test.
    for name in standards:
        STANDARDS[name].steps(chosen)
    return AcceptanceRun(
        str(sensor), under_test, under_test.renderer_name(), chosen, standards, limit_um
    )


def parse_volume(text: str) -> np.ndarray:
    """Return the sides (3,) [m] of a volume written ``0.6`` (a cube) or ``0.7x0.6x0.6``.

    Raises AcceptanceError if the text is neither one nor three finite numbers.
    """
    try:
        sides = np.array([float(part) for part in text.lower().split("x")])
    except ValueError:
        # An empty array is refused below, with the same message.
        sides = np.zeros(0)
    if len(sides) not in (1, 3) or not np.all(np.isfinite(sides)):
        raise AcceptanceError(
            f"volume {text!r} is neither one side of a cube nor WIDTHxHEIGHTxDEPTH in m, such as "
            "0.6"
        )
    return np.broadcast_to(sides, 3).copy()


def run_tests(run: AcceptanceRun, progress: Progress) -> None:
    """Run the tests of a prepared run, and store their results and durations in it."""
    for name in run.standards:
        standard = STANDARDS[name]
        start = time.perf_counter()
        with progress.stage(standard.title, standard.steps(run.volume)) as advance:
            run.found[name] = standard.measure(run.under_test, run.volume, advance=advance)
        run.seconds[name] = time.perf_counter() - start


def acceptance_content(run: AcceptanceRun) -> dict[str, Any]:
    """Return the content of ``acceptance.json``, without tests that were not run."""
    volume = run.volume
    return {
        "sensor": run.under_test.file.name,
        "note": run.under_test.file.note,
        "renderer": run.renderer,
        "seed": run.under_test.seed,
        "versions": versions(),
        "seconds": run.seconds,
        "volume": {
            "size_mm": (1e3 * volume.size).tolist(),
            "diagonal_mm": 1e3 * volume.diagonal,
            "cubic_metres": float(np.prod(volume.size)),
            "depth_from_baseline_mm": [1e3 * depth for depth in volume.depth_range],
            "base_from_volume": volume.base_from_volume,
        },
        **{
            STANDARDS[name].key: STANDARDS[name].figures(test, run)
            for name, test in run.found.items()
        },
        "published": [asdict(figure) for figure in PUBLISHED],
    }


def _length(test: LengthTest, run: AcceptanceRun) -> dict[str, Any]:
    largest = test.largest
    errors = 1e6 * test.errors
    single = 1e6 * test.single_errors
    met = bool(np.abs(errors).max() <= run.limit_um)
    # All lengths of a line begin at the same sticker, so only different lines are independent.
    line_means = 1e6 * np.array(
        [np.mean([length.error for length in test.of_line(line.name)]) for line in test.lines]
    )
    return {
        "limit_um": run.limit_um,
        "met": met,
        "advice": None if met else asdict(_why_inaccurate(test, run)),
        "largest_error_um": 1e6 * largest.error,
        "largest_error_at": {"line": largest.line, "length_mm": 1e3 * largest.true},
        "mean_error_um": float(errors.mean()),
        "mean_error_interval_um": interval_of_mean(line_means),
        "rms_error_um": float(np.sqrt(np.mean(errors**2))),
        "exposures_a_length": single.shape[1],
        "single_exposure_rms_um": float(np.sqrt(np.mean(single**2))),
        "variance_ratio": test.variance_ratio,
        "lines": [
            {
                "name": line.name,
                "start_mm": 1e3 * line.start,
                "end_mm": 1e3 * line.end,
                "longest_share_of_diagonal": float(line.lengths.max()) / test.volume.diagonal,
                "lengths": [
                    {
                        "certified_mm": 1e3 * length.true,
                        "measured_mm": 1e3 * float(length.measured.mean()),
                        "error_um": 1e6 * length.error,
                        "single_exposure_std_um": 1e6 * length.std,
                    }
                    for length in test.of_line(line.name)
                ],
            }
            for line in test.lines
        ],
    }


def _why_inaccurate(test: LengthTest, run: AcceptanceRun) -> Advice:
    """Return the likeliest cause of the largest length error, and the command to type next."""
    largest = test.largest
    exposures = len(largest.measured)
    std_um = 1e6 * largest.std / math.sqrt(exposures)
    ratio = abs(1e6 * largest.error) / std_um
    if ratio <= STDS:
        sides = "x".join(f"{side / 2:.3g}" for side in run.volume.size)
        return Advice(
            f"The error is due to noise of the images: the mean of {exposures} exposures of this "
            f"length has a stated standard deviation of {std_um:.2g} um. The far corners of a "
            "smaller volume are nearer to the cameras.",
            f"cmmsim acceptance {run.sensor} --standard vdi --volume {sides}",
        )
    return Advice(
        f"The error is {ratio:.2g} times its stated standard deviation of {std_um:.2g} um: the "
        "centres of the stickers are found with an error that no averaging removes.",
        f"cmmsim detectors {run.sensor}",
    )


def _bar(test: BarTest, run: AcceptanceRun) -> dict[str, Any]:
    # A separate random stream makes the intervals independent of other draws.
    rng = mixed_generator(RESAMPLING, run.under_test.seed)
    return {
        "bar_length_mm": 1e3 * LENGTH,
        "frames": test.frames,
        "lost_frames": test.lost,
        "largest_speed_mm_s": 1e3 * test.largest_speed,
        "exposure_ms": 1e3 * test.exposure,
        "variance_ratio": test.variance_ratio,
        "standing": _relative_errors(test, False, rng),
        "moving": _relative_errors(test, True, rng),
        "runs": [
            {
                "name": bar.name,
                "frames": len(bar.time),
                "lost_frames": bar.lost,
                "given_up": bar.given_up,
                "position_rms_um": 1e6 * _rms_norm(bar.errors[:, :3]),
                "orientation_rms_urad": 1e6 * _rms_norm(bar.errors[:, 3:]),
                "distance_rms_um": 1e6 * _rms_norm(bar.distance_errors[:, None]),
            }
            for bar in test.runs
        ],
    }


def _relative_errors(test: BarTest, moving: bool, rng: np.random.Generator) -> dict[str, Any]:
    errors = test.errors(moving)
    magnitudes = {
        "position_um": np.linalg.norm(errors[:, :3], axis=1),
        "orientation_urad": np.linalg.norm(errors[:, 3:], axis=1),
        "distance_um": np.abs(test.distance_errors(moving)),
    }
    return {
        name: asdict(summarise(1e6 * values, rng, BLOCK)) for name, values in magnitudes.items()
    }


def _rms_norm(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def _latency(test: LatencyTest, run: AcceptanceRun) -> dict[str, Any]:
    measured = test.latency
    return {
        "reports": len(test.reported),
        "lost_frames": test.lost,
        "mean_ms": 1e3 * measured.mean,
        "mean_interval_ms": [1e3 * bound for bound in measured.interval],
        "std_ms": 1e3 * measured.std,
        "max_ms": 1e3 * measured.maximum,
        "single_report_noise_ms": 1e3 * measured.resolution,
        "sensor_file_ms": 1e3 * test.stated,
        "oldest_pose_ms": 1e3 * (measured.maximum + test.frame_period),
    }


def _circle_steps(volume: MeasuringVolume) -> int:
    require_room(volume)
    return FRAMES


# Tests by the names that the command line knows.
STANDARDS = {
    "vdi": Standard(
        "lengths (VDI/VDE 2634-1)",
        "vdi_2634_1",
        lambda volume: len(seven_lines(volume)),
        length_test,
        _length,
    ),
    "e3064": Standard(
        "moving bar (ASTM E3064)",
        "astm_e3064",
        lambda volume: len(bar_paths(volume)),
        bar_test,
        _bar,
    ),
    "e3124": Standard("latency (ASTM E3124)", "astm_e3124", _circle_steps, latency_test, _latency),
}
