"""``acceptance.json``: the figures of acceptance tests, with their units in the names."""

from dataclasses import asdict
from typing import Any

import numpy as np

from cmmsim.acceptance import PUBLISHED, BarTest, LatencyTest, LengthTest, MeasuringVolume, interval_of_mean, summarise
from cmmsim.acceptance.bar import LENGTH
from identify.files.versions import versions
from identify.random_streams import RESAMPLING, mixed_generator
from identify.verification.acceptance_procedure import AcceptanceRun

BLOCK = 10  # neighbouring frames of the bar are resampled together


def acceptance_entry(run: AcceptanceRun, limit_um: float) -> dict[str, Any]:
    """All figures of a run; a test that was not done is absent."""
    entry: dict[str, Any] = {
        "sensor": run.under_test.file.name,
        "note": run.under_test.file.note,
        "renderer": run.renderer,
        "seed": run.under_test.seed,
        "versions": versions(),
        "seconds": run.seconds,
        "volume": _volume(run.volume),
    }
    if run.length is not None:
        entry["vdi_2634_1"] = _length(run.length, limit_um)
    if run.bar is not None:
        entry["astm_e3064"] = _bar(run.bar, mixed_generator(RESAMPLING, run.under_test.seed))
    if run.latency is not None:
        entry["astm_e3124"] = _latency(run.latency)
    entry["published"] = [asdict(figure) for figure in PUBLISHED]
    return entry


def _volume(volume: MeasuringVolume) -> dict[str, Any]:
    return {
        "size_mm": (1e3 * volume.size).tolist(),
        "diagonal_mm": 1e3 * volume.diagonal,
        "cubic_metres": float(np.prod(volume.size)),
        "depth_from_baseline_mm": [1e3 * depth for depth in volume.depth_range],
        "base_from_volume": volume.base_from_volume,
    }


def _length(test: LengthTest, limit_um: float) -> dict[str, Any]:
    largest, errors = test.largest, 1e6 * test.errors
    single = 1e6 * test.single_errors
    # the lengths of a line share its first sticker: only the lines are independent
    line_means = 1e6 * np.array([np.mean([length.error for length in test.of_line(line.name)]) for line in test.lines])
    return {
        "limit_um": limit_um,
        "met": bool(np.abs(errors).max() <= limit_um),
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


def _bar(test: BarTest, rng: np.random.Generator) -> dict[str, Any]:
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
                "name": run.name,
                "frames": len(run.time),
                "lost_frames": run.lost,
                "given_up": run.given_up,
                "position_rms_um": _rms_norm(run.errors[:, :3]),
                "orientation_rms_urad": _rms_norm(run.errors[:, 3:]),
                "distance_rms_um": _rms_norm(run.distance_errors[:, None]),
            }
            for run in test.runs
        ],
    }


def _relative_errors(test: BarTest, moving: bool, rng: np.random.Generator) -> dict[str, Any]:
    errors = test.errors(moving)
    magnitudes = {
        "position_um": np.linalg.norm(errors[:, :3], axis=1),
        "orientation_urad": np.linalg.norm(errors[:, 3:], axis=1),
        "distance_um": np.abs(test.distance_errors(moving)),
    }
    return {name: asdict(summarise(1e6 * values, rng, BLOCK)) for name, values in magnitudes.items()}


def _latency(test: LatencyTest) -> dict[str, Any]:
    found = test.latency
    return {
        "reports": len(test.reported),
        "lost_frames": test.lost,
        "mean_ms": 1e3 * found.mean,
        "mean_interval_ms": [1e3 * bound for bound in found.interval],
        "std_ms": 1e3 * found.std,
        "max_ms": 1e3 * found.maximum,
        "single_report_noise_ms": 1e3 * found.resolution,
        "sensor_file_ms": 1e3 * test.stated,
        "oldest_pose_ms": 1e3 * (found.maximum + test.frame_period),
    }


def _rms_norm(errors: np.ndarray) -> float:
    return float(1e6 * np.sqrt(np.mean(np.sum(errors**2, axis=1))))
