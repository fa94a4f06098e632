"""Report of acceptance tests for ``acceptance.md``.

The report shows the results beside published figures, and explains which of them are comparable.
"""

from typing import Any

import numpy as np

from cmmsim.acceptance.moving_bar import MOST_LOST_FRAMES
from identify.reporting.tables import Table, number

URAD_IN_DEG = float(np.rad2deg(1e-6))
STATISTICS = (("mean", "mean"), ("rms", "RMS"), ("p95", "95th percentile"), ("maximum", "maximum"))
MAGNITUDES = (
    ("position_um", "position [um]"),
    ("orientation_urad", "orientation [urad]"),
    ("distance_um", "distance of the ends [um]"),
)
COMPARABLE = """\
Comparable figures: the NIST figures and our bar test both state the relative error of markers at
the two ends of a rigid bar. The length test follows the rules of the guideline, so its errors have
the same meaning as in such a test.

Differences: the published figures are of real instruments, each in its own volume and test, with
warm-up, air, real lenses, calibration errors and real targets. Our figures are of a simulated
sensor with chosen camera properties, an exactly known calibration and artefacts without error, in
the volume stated above. A figure published as ± must be compared with our largest error, not with
an RMS. The position error of our bar contains the orientation error of its first end times the
length of the bar; its distance error does not. Our latency is set in the sensor file: the test
shows that the reports have this latency, and does not measure the speed of an instrument.
"""


def acceptance_markdown(entry: dict[str, Any]) -> str:
    """Return the report of the tests that were run, from the content of ``acceptance.json``."""
    volume = entry["volume"]
    near, far = volume["depth_from_baseline_mm"]
    sides = " x ".join(f"{side:.0f}" for side in volume["size_mm"])
    parts = [
        f"# Acceptance of {entry['sensor']}",
        f"Renderer {entry['renderer']}, seed {entry['seed']}. Measuring volume {sides} mm "
        f"({volume['cubic_metres']:.3g} m³, space diagonal {volume['diagonal_mm']:.0f} mm), "
        f"{near:.0f} to {far:.0f} mm from the middle of the baseline: wholly seen by both cameras.",
        *([f"Of the sensor's figures: {entry['note']}."] if entry.get("note") else []),
    ]
    # Tests that were not run have no entry, and no table.
    makers = {"vdi_2634_1": length_table, "astm_e3064": bar_table, "astm_e3124": latency_table}
    tables = [make(entry[key]) for key, make in makers.items() if key in entry]
    for table in [*tables, published_table(entry)]:
        parts += [f"## {table.title}", table.markdown(), *([table.note] if table.note else [])]
    return "\n\n".join([*parts, COMPARABLE.strip()]) + "\n"


def length_table(test: dict[str, Any]) -> Table:
    """Return a table of the seven measuring lines with their lengths and errors."""
    rows = []
    for line in test["lines"]:
        errors = [length["error_um"] for length in line["lengths"]]
        certified = ", ".join(f"{length['certified_mm']:.0f}" for length in line["lengths"])
        share = number(line["longest_share_of_diagonal"])
        listed = ", ".join(f"{error:+.1f}" for error in errors)
        largest = number(max(abs(error) for error in errors))
        rows.append((line["name"], certified, share, listed, largest))
    where = test["largest_error_at"]
    low, high = test["mean_error_interval_um"]
    return Table(
        "Lengths in the style of VDI/VDE 2634-1",
        ("line", "lengths [mm]", "longest / diagonal", "errors E [um]", "largest [um]"),
        tuple(rows),
        f"Largest error {test['largest_error_um']:+.1f} um ({where['line']}, "
        f"{where['length_mm']:.0f} mm), limit ± {test['limit_um']:g} um: "
        f"{'met' if test['met'] else 'MISSED'}. {_advice(test)}Mean error "
        f"{test['mean_error_um']:+.2f} um, 95 % interval {low:+.2f} to {high:+.2f} um. A "
        f"length is the mean of {test['exposures_a_length']} exposures; the RMS error of a single "
        "one is "
        f"{number(test['single_exposure_rms_um'])} um, its mean square "
        f"{number(test['variance_ratio'])} times the stated variance.",
    )


def bar_table(test: dict[str, Any]) -> Table:
    """Return a table of the relative pose error of the bar's ends, standing and moving."""
    rows = []
    for state in ("standing", "moving"):
        for key, name in MAGNITUDES:
            summary = test[state][key]
            values = [
                number(summary[k]) + _interval(summary["interval"].get(k)) for k, _ in STATISTICS
            ]
            rows.append((f"{state}, {name}", *values, str(summary["count"])))
    note = (
        f"A bar with {test['bar_length_mm']:.0f} mm between the clusters at its ends, moved at up "
        f"to {test['largest_speed_mm_s']:.0f} mm/s with {test['exposure_ms']:g} ms of exposure; in "
        f"brackets 95 % intervals. {test['lost_frames']} of {test['frames']} frames lost. The "
        f"squared errors are {number(test['variance_ratio'])} times the stated variance."
    )
    given_up = [f"{run['name']} ({run['given_up']})" for run in test["runs"] if run["given_up"]]
    if given_up:
        note += (
            f" Given up after {MOST_LOST_FRAMES} lost frames in a row, the rest counted as lost: "
            f"{'; '.join(given_up)}."
        )
    return Table(
        "Rigid bar in the style of ASTM E3064-16",
        ("relative pose error", *(name for _, name in STATISTICS), "frames"),
        tuple(rows),
        note,
    )


def latency_table(test: dict[str, Any]) -> Table:
    """Return a table of the latency of the sensor's reports."""
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
        f"{test['reports']} reports of a body on a circle, {test['lost_frames']} frames lost; in "
        "brackets the 95 % interval.",
    )


def published_table(entry: dict[str, Any]) -> Table:
    """Return a table with our figures above the published figures of the same quantity."""
    ours = _our_figures(entry)
    rows = []
    # A dictionary keeps the order of the published figures.
    for quantity in dict.fromkeys(figure["quantity"] for figure in entry["published"]):
        rows += [(quantity, entry["sensor"], value, note) for value, note in ours.get(quantity, ())]
        rows += [
            (quantity, f["instrument"], f"{f['value']:g} {f['unit']}", f["note"])
            for f in entry["published"]
            if f["quantity"] == quantity
        ]
    return Table(
        "Beside published figures", ("quantity", "instrument", "value", "what it is"), tuple(rows)
    )


def _our_figures(entry: dict[str, Any]) -> dict[str, list[tuple[str, str]]]:
    """Return the values and notes of our own figures by quantity."""
    found: dict[str, list[tuple[str, str]]] = {}
    if test := entry.get("vdi_2634_1"):
        note = f"largest length error, mean of {test['exposures_a_length']} exposures"
        found["position, static"] = [(f"{1e-3 * abs(test['largest_error_um']):.4f} mm", note)]
    if test := entry.get("astm_e3064"):
        ends = "of the bar's ends"
        for state, word in (("standing", "static"), ("moving", "moving")):
            for key, name, scale, unit, what in (
                ("position_um", "position", 1e-3, "mm", f"relative pose {ends}"),
                ("distance_um", "position", 1e-3, "mm", f"distance {ends}"),
                ("orientation_urad", "orientation", URAD_IN_DEG, "deg", f"relative pose {ends}"),
            ):
                rms = scale * test[state][key]["rms"]
                largest = scale * test[state][key]["maximum"]
                value = f"{rms:.4f} {unit} RMS, {largest:.4f} {unit} largest"
                found.setdefault(f"{name}, {word}", []).append((value, what))
    if test := entry.get("astm_e3124"):
        found["latency"] = [(f"{test['mean_ms']:.3f} ms", "mean; set by the sensor file")]
    return found


def _advice(test: dict[str, Any]) -> str:
    """Return the likeliest cause of a missed limit and the next command, or an empty text."""
    advice = test["advice"]
    return f"{advice['cause']} Next: `{advice['command']}`. " if advice else ""


def _interval(bounds: Any) -> str:
    return "" if bounds is None else f" ({number(bounds[0])} to {number(bounds[1])})"
