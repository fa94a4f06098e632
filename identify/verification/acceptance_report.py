"""``acceptance.json`` and ``acceptance.md``: figures of acceptance tests with units, beside the published ones."""

from dataclasses import asdict
from typing import Any

import numpy as np

from cmmsim.acceptance import PUBLISHED, BarTest, LatencyTest, LengthTest, MeasuringVolume, interval_of_mean, summarise
from cmmsim.acceptance.artefacts import LENGTH
from cmmsim.acceptance.moving_bar import GIVEN_UP
from identify.files.versions import versions
from identify.random_streams import RESAMPLING, mixed_generator
from identify.reporting.tables import Table, number
from identify.verification.acceptance_procedure import AcceptanceRun

# `acceptance.json`: the figures of acceptance tests, with their units in the names.


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


# `acceptance.md`: tables of acceptance tests, ours beside the published figures, and what may be compared.


URAD_IN_DEG = float(np.rad2deg(1e-6))
STATISTICS = (("mean", "mean"), ("rms", "RMS"), ("p95", "95th percentile"), ("maximum", "maximum"))
MAGNITUDES = (
    ("position_um", "position [um]"),
    ("orientation_urad", "orientation [urad]"),
    ("distance_um", "distance of the ends [um]"),
)
COMPARABLE = """\
What is comparable: the NIST figures are of the same kind as our bar test, the relative error of markers at both ends of
a rigid bar. The length test follows the rules of the guideline, so its errors mean what such a test's errors mean.

What is not: the published figures belong to real instruments, each in its own volume and test, with warm-up, air, real
lenses, calibration errors and real targets. Ours are of a simulated sensor whose camera figures were chosen, which
knows its own calibration exactly, and whose artefacts are certified without error, in the volume stated above. A figure
published as ± is to be held against our largest error, not against an RMS. The position error of our bar contains the
orientation error of its first end times the bar's length; its distance error does not. Our latency is what the sensor
file asks for: the test shows that the reports keep it, and says nothing about how fast an instrument is.
"""


def length_table(entry: dict[str, Any]) -> Table:
    """Lengths of the seven lines: the longest, its share of the diagonal, and the errors."""
    test = entry["vdi_2634_1"]
    rows = []
    for line in test["lines"]:
        lengths = line["lengths"]
        errors = [length["error_um"] for length in lengths]
        rows.append(
            (
                line["name"],
                ", ".join(f"{length['certified_mm']:.0f}" for length in lengths),
                number(line["longest_share_of_diagonal"]),
                ", ".join(f"{error:+.1f}" for error in errors),
                number(max(abs(error) for error in errors)),
            )
        )
    verdict = "met" if test["met"] else "MISSED"
    where = test["largest_error_at"]
    low, high = test["mean_error_interval_um"]
    note = (
        f"Largest error {test['largest_error_um']:+.1f} um ({where['line']}, {where['length_mm']:.0f} mm), limit "
        f"± {test['limit_um']:g} um: {verdict}. Mean error {test['mean_error_um']:+.2f} um, 95 % interval "
        f"{low:+.2f} to {high:+.2f} um. A length is the mean of {test['exposures_a_length']} exposures; the RMS "
        f"error of a single one is {number(test['single_exposure_rms_um'])} um, its mean square "
        f"{number(test['variance_ratio'])} times the stated variance."
    )
    return Table(
        "Lengths in the style of VDI/VDE 2634-1",
        ("line", "lengths [mm]", "longest / diagonal", "errors E [um]", "largest [um]"),
        tuple(rows),
        note,
    )


def bar_table(entry: dict[str, Any]) -> Table:
    """Statistics of the relative pose error of the bar's ends, standing and moving, with 95 % intervals."""
    test = entry["astm_e3064"]
    rows = []
    for state in ("standing", "moving"):
        for key, name in MAGNITUDES:
            figures = test[state][key]
            values = [number(figures[k]) + _interval(figures["interval"].get(k)) for k, _ in STATISTICS]
            rows.append((f"{state}, {name}", *values, str(figures["count"])))
    note = (
        f"A bar with {test['bar_length_mm']:.0f} mm between the clusters at its ends, moved at up to "
        f"{test['largest_speed_mm_s']:.0f} mm/s with {test['exposure_ms']:g} ms of exposure; in brackets 95 % "
        f"intervals. {test['lost_frames']} of {test['frames']} frames lost. The squared "
        f"errors are {number(test['variance_ratio'])} times the stated variance."
    )
    given_up = [f"{run['name']} ({run['given_up']})" for run in test["runs"] if run["given_up"]]
    if given_up:
        note += f" Given up after {GIVEN_UP} lost frames in a row, the rest counted as lost: {'; '.join(given_up)}."
    return Table(
        "Rigid bar in the style of ASTM E3064-16",
        ("relative pose error", *(name for _, name in STATISTICS), "frames"),
        tuple(rows),
        note,
    )


def latency_table(entry: dict[str, Any]) -> Table:
    """Latency of the reports."""
    test = entry["astm_e3124"]
    low, high = test["mean_interval_ms"]
    rows = (
        ("mean", f"{test['mean_ms']:.4f} ({low:.4f} to {high:.4f})"),
        ("standard deviation", f"{test['std_ms']:.4f}"),
        ("maximum", f"{test['max_ms']:.4f}"),
        ("of the standard deviation, from position noise", f"{test['single_report_noise_ms']:.4f}"),
        ("stated in the sensor file", f"{test['sensor_file_ms']:.4f}"),
        ("oldest pose at hand: maximum and one frame", f"{test['oldest_pose_ms']:.4f}"),
    )
    return Table(
        "Latency in the style of ASTM E3124",
        ("from the middle of the exposure to the report", "[ms]"),
        rows,
        f"{test['reports']} reports of a body on a circle, {test['lost_frames']} frames lost; in brackets the "
        "95 % interval.",
    )


def published_table(entry: dict[str, Any]) -> Table:
    """Our figures above the published ones of the same quantity."""
    ours = _our_figures(entry)
    rows = []
    quantities = dict.fromkeys([*(figure["quantity"] for figure in entry["published"])])
    for quantity in quantities:
        rows += [(quantity, entry["sensor"], value, note) for value, note in ours.get(quantity, ())]
        rows += [
            (quantity, f["instrument"], f"{f['value']:g} {f['unit']}", f["note"])
            for f in entry["published"]
            if f["quantity"] == quantity
        ]
    return Table("Beside published figures", ("quantity", "instrument", "value", "what it is"), tuple(rows))


def acceptance_markdown(entry: dict[str, Any]) -> str:
    """The whole report of the tests that were done."""
    volume = entry["volume"]
    near, far = volume["depth_from_baseline_mm"]
    sides = " x ".join(f"{side:.0f}" for side in volume["size_mm"])
    parts = [
        f"# Acceptance of {entry['sensor']}",
        f"Renderer {entry['renderer']}, seed {entry['seed']}. Measuring volume {sides} mm "
        f"({volume['cubic_metres']:.3g} m³, space diagonal {volume['diagonal_mm']:.0f} mm), {near:.0f} to "
        f"{far:.0f} mm from the middle of the baseline: wholly seen by both cameras.",
        *([f"Of the sensor's figures: {entry['note']}."] if entry.get("note") else []),
    ]
    tables = [
        make(entry)
        for key, make in (("vdi_2634_1", length_table), ("astm_e3064", bar_table), ("astm_e3124", latency_table))
        if key in entry
    ]
    for table in [*tables, published_table(entry)]:
        parts += [f"## {table.title}", table.markdown(), *([table.note] if table.note else [])]
    return "\n\n".join([*parts, COMPARABLE.strip()]) + "\n"


def _our_figures(entry: dict[str, Any]) -> dict[str, list[tuple[str, str]]]:
    """Values and notes of our own figures by quantity."""
    found: dict[str, list[tuple[str, str]]] = {}
    if "vdi_2634_1" in entry:
        test = entry["vdi_2634_1"]
        found["position, static"] = [
            (
                f"{1e-3 * abs(test['largest_error_um']):.4f} mm",
                f"largest length error, mean of {test['exposures_a_length']} exposures",
            )
        ]
    if "astm_e3064" in entry:
        for state, word in (("standing", "static"), ("moving", "moving")):
            figures = entry["astm_e3064"][state]
            for key, name, scale, unit in (
                ("position_um", "position", 1e-3, "mm"),
                ("distance_um", "position", 1e-3, "mm"),
                ("orientation_urad", "orientation", URAD_IN_DEG, "deg"),
            ):
                values = figures[key]
                what = "distance of the bar's ends" if key == "distance_um" else "relative pose of the bar's ends"
                found.setdefault(f"{name}, {word}", []).append(
                    (f"{scale * values['rms']:.4f} {unit} RMS, {scale * values['maximum']:.4f} {unit} largest", what)
                )
    if "astm_e3124" in entry:
        found["latency"] = [(f"{entry['astm_e3124']['mean_ms']:.3f} ms", "mean; set by the sensor file")]
    return found


def _interval(bounds: Any) -> str:
    return "" if bounds is None else f" ({number(bounds[0])} to {number(bounds[1])})"
