"""Tables like the paper's 2, 3 and 4 beside the paper's own figures, and what a run says of itself at the terminal.

The paper's figures, RMS of x, y, z [um], alpha, beta, gamma [urad], compare the identified model with the measurement
of a real robot; no truth was known there.
"""

import math
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer

from identify.files.run_folder import AXES, predicted_row, rms_row
from identify.progress import print_table
from identify.reporting.goals import check_goals, explanation_goals

BEFORE = (1260.0, 1160.0, 1550.0, 2520.0, 3580.0, 2800.0)
"""Table 3, starting model on the exciting trajectory."""

AFTER = (408.0, 235.0, 494.0, 956.0, 797.0, 725.0)
"""Table 3, identified model on the exciting trajectory."""

VALIDATION = (
    (517.0, 384.0, 709.0, 1091.0, 963.0, 966.0),
    (273.0, 410.0, 522.0, 1157.0, 1071.0, 932.0),
    (381.0, 403.0, 600.0, 1242.0, 830.0, 1143.0),
    (341.0, 511.0, 617.0, 1136.0, 814.0, 1161.0),
    (322.0, 394.0, 464.0, 1219.0, 877.0, 835.0),
    (310.0, 301.0, 441.0, 1195.0, 1111.0, 1040.0),
    (360.0, 402.0, 455.0, 1263.0, 1176.0, 1024.0),
    (418.0, 483.0, 460.0, 1251.0, 1211.0, 1015.0),
    (342.0, 510.0, 557.0, 1411.0, 1156.0, 711.0),
    (318.0, 379.0, 473.0, 1219.0, 1023.0, 905.0),
)
"""Table 4, identified model on ten unseen trajectories. The 1411 is over the 1.4e-3 rad that the text states."""

INDEX_FIRST, INDEX_BEST = 0.38, 1.345
"""Observability index at the start and after 324 iterations of a genetic algorithm (section 4.2)."""

AXIS_UNITS = ("um", "um", "um", "urad", "urad", "urad")
NOT_SHOWN = "not identifiable"
ON_GUESS = "rests on the starting guess"
AXIS_HEADER = tuple(f"{axis} [{unit}]" for axis, unit in zip(AXES, AXIS_UNITS, strict=True))


@dataclass(frozen=True)
class Table:
    """A titled table of text; ``note`` says what the reader must know to read it."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def markdown(self) -> str:
        """The table as Markdown, numbers aligned to the right."""
        lines = [self.header, ("---",) + ("--:",) * (len(self.header) - 1), *self.rows]
        return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def goals_table(result: dict[str, Any]) -> Table:
    """Every goal with its value, its limit and whether it is met; below them the speed, which no goal judges."""
    rows = tuple(
        (
            goal.name,
            f"{number(goal.value)} {goal.unit}".strip(),
            f"{'≤' if goal.relation == '<=' else '≥'} {number(goal.limit)} {goal.unit}".strip(),
            "met" if goal.passed else "MISSED",
            goal.detail,
        )
        for goal in check_goals(result)
    )
    note = "Accuracy: RMS of the worst axis and run. Speed has no limit: it is the machine's."
    return Table("Goals", ("goal", "value", "limit", "", "what"), (*rows, *_speed_rows(result)), note)


def _speed_rows(result: dict[str, Any]) -> list[tuple[str, ...]]:
    """Speed of what has been done so far."""
    rate, seconds = result.get("sensor", {}).get("stereo_frames_per_second"), result.get("seconds", {})
    stages = [value for name, value in seconds.items() if name != "total" and "." not in name and value is not None]
    rows: list[tuple[str, ...]] = []
    if rate:
        rows.append(("stereo frames", f"{number(rate)} 1/s", "", "", "rendered and measured, in one process"))
    if stages:
        total = seconds.get("total") or sum(stages)
        rows.append(("whole run", f"{number(total)} s", "", "", "all stages so far, compiling included"))
    return rows


def parameter_table(result: dict[str, Any]) -> Table:
    """Parameters, like table 2: starting guess, truth, estimate, standard deviation and interval."""
    rows = []
    for name, p in result["identification"]["parameters"].items():
        remark = (ON_GUESS if p.get("rests_on_prior") else "") if p["identifiable"] else NOT_SHOWN
        rows.append((name, p["unit"], number(p["initial"]), number(p["true"]), *_shown(p), remark))
    anchor = result["identification"]["scale_anchor"]
    return Table(
        "Parameters (like the paper's table 2)",
        ("parameter", "unit", "initial", "true", "estimate", "std", "95 % interval", "error [%]", ""),
        tuple(rows),
        f"The overall scale is fixed by: {anchor}. A parameter that no motion shows has no estimate. "
        f"One that {ON_GUESS} is shown only in sums with others: it follows from what the guess says of those, and its "
        "interval holds the truth where the guess's standard deviations do; the sums stand among the groups. "
        "The interval ends where no such value can exist, and allows for bounds that hold the estimate; the standard "
        "deviation knows of none. "
        "With the scenario's default parameter sets, initial and true are the two columns of the paper's table 2.",
    )


def group_table(result: dict[str, Any]) -> Table:
    """Base parameters: the combinations of parameters that motion can show, with truth, estimate and deviation."""
    rows = tuple(
        (g["expression"], number(g["initial"]), number(g["true"]), *_shown(g), "" if g["identifiable"] else NOT_SHOWN)
        for g in result["identification"].get("groups", {}).values()
        if len(g["coefficients"]) > 1
    )
    return Table(
        "Groups of parameters that no motion can separate",
        ("group", "initial", "true", "estimate", "std", "95 % interval", "error [%]", ""),
        rows,
        "In the SI unit of the first parameter of each sum. A group may be known where none of its members is; but for "
        f"the common scale no group {ON_GUESS}. Its size is that of its members: of a difference that almost vanishes "
        "the relative error says nothing.",
    )


def excitation_error_table(result: dict[str, Any]) -> Table:
    """Model against measurement on the exciting trajectory before and after identification, like table 3."""
    before, after = _rms(rms_row(result.get("before"))), _rms(rms_row(result.get("after")))
    rows = tuple(
        (f"{axis} [{unit}]", b, a, number(pb), number(pa))
        for axis, unit, b, a, pb, pa in zip(AXES, AXIS_UNITS, before, after, BEFORE, AFTER, strict=True)
    )
    return Table(
        "RMS of model against measurement, exciting trajectory (like the paper's table 3)",
        ("component", "before", "after", "paper before", "paper after"),
        rows,
        "diverged: the loop of the starting model is unstable." if "diverged" in before else "",
    )


def validation_table(result: dict[str, Any]) -> Table:
    """Models against measurement and truth on the unseen trajectories, like table 4, and the paper's rows."""
    rows: list[tuple[str, ...]] = []
    for n, run in enumerate(result.get("validation", []), start=1):
        rows.append((f"{n} true", *_rms(rms_row(run["true"]))))
        rows.append((f"{n} measured", *_rms(rms_row(run["measured"]))))
        if "initial_true" in run:
            rows.append((f"{n} starting model, true", *_rms(rms_row(run["initial_true"]))))
    rows += [(f"paper {n} measured", *map(number, row)) for n, row in enumerate(VALIDATION, start=1)]
    return Table(
        "RMS on unseen trajectories (like the paper's table 4)",
        ("run", *AXIS_HEADER),
        tuple(rows),
        "true: identified model against the true plant; measured: against what the sensor saw of it.",
    )


def prediction_table(result: dict[str, Any]) -> Table:
    """Predicted deviation of the plant from the identified model beside the deviation found, on unseen trajectories."""
    rows: list[tuple[str, ...]] = []
    for n, run in enumerate(result.get("validation", []), start=1):
        ratio = run.get("predicted", {}).get("normalised_squared_error")
        rows.append((f"{n} predicted std", *map(number, predicted_row(run)), ""))
        rows.append((f"{n} found RMS", *_rms(rms_row(run["true"])), number(ratio)))
    return Table(
        "Identified model against the true plant: predicted and found",
        ("run", *AXIS_HEADER, "normalised"),
        tuple(rows),
        "Predicted from the covariance of the parameters through the exact sensitivities, and from what the sensor's "
        "noise does to the plant through the servo. Normalised: squared error in units of the predicted covariance; "
        "one on average where the prediction is right. The runs share one set of parameters, so they stray together, "
        "and the frames that the sensor was taught, whose error moves the plant as a whole and is not predicted.",
    )


def correlation_table(result: dict[str, Any]) -> Table:
    """The pairs of identified parameters that the record ties together most."""
    pairs = result["identification"].get("strongest_correlations", [])
    rows = tuple((f"{p['first']}, {p['second']}", f"{p['correlation']:+.4f}") for p in pairs)
    return Table(
        "Strongest correlations of identified parameters",
        ("parameters", "correlation"),
        rows,
        "Poses show friction and gains relative to each other better than their common factor, which moves all of them "
        "together: their ratios are known better than each of them.",
    )


def sensor_table(result: dict[str, Any]) -> Table:
    """Measured pose against truth."""
    sensor, header = result["sensor"], ("frames", "lost", "stereo frames a second", *AXIS_HEADER)
    frames, lost, rate = sensor["frames"], sensor["lost_frames"], sensor.get("stereo_frames_per_second")
    row = (str(frames), str(lost), number(rate), *_rms(rms_row(sensor)))
    return Table("Sensor: RMS of measured pose against truth", header, (row,))


def seconds_table(result: dict[str, Any]) -> Table:
    """Time of each stage."""
    rows = tuple((name, number(value)) for name, value in result.get("seconds", {}).items())
    return Table("Time of the stages", ("stage", "seconds"), rows)


def changed_settings_table(result: dict[str, Any], recorded: str) -> Table:
    """The estimator's settings that are not those of the scenario (TOML) with which the record was made."""
    settings = result.get("settings", {})
    planned = tomllib.loads(recorded) if settings else {}
    rows = []
    for key, value in settings.items():
        section, _, name = key.partition(".")
        before = planned.get(section, {}).get(name)
        if value != before:
            rows.append((key, str(value), "-" if before is None else str(before)))
    return Table("Set anew for the identification", ("key", "value", "when the record was made"), tuple(rows))


def number(value: float | None) -> str:
    """A number with four significant digits; a dash for one that does not exist."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.4g}"


def _rms(values: list[float]) -> list[str]:
    return [number(value) if math.isfinite(value) else "diverged" for value in values]


def _shown(entry: dict[str, Any]) -> tuple[str, str, str, str]:
    """Estimate, deviation, interval and error; dashes for what is not identified, so that nobody quotes it."""
    if not entry["identifiable"]:
        return "-", "-", "-", "-"
    interval = " to ".join(map(number, entry.get("interval", [None])))
    return number(entry["estimate"]), number(entry["std"]), interval, _percent(entry)


def _percent(parameter: dict[str, Any]) -> str:
    true, estimate = parameter["true"], parameter["estimate"]
    if not true or estimate is None:
        return "-"
    return f"{100 * (estimate - true) / abs(true):+.2f}"


def print_identification(result: dict[str, Any], path: Path) -> None:
    """What is identified, how well the model explains the record, the time it took, and where all of it is."""
    identification = result["identification"]
    entries = {kind: identification.get(kind, {}).values() for kind in ("parameters", "groups")}
    counts = [f"{sum(bool(one['identifiable']) for one in of)} of {len(of)} {kind}" for kind, of in entries.items()]
    seconds = result["seconds"].get("identify")
    typer.echo(f"identified: {' and '.join(counts)}, in {number(seconds)} s")
    goals = explanation_goals(result)
    for goal in goals:
        typer.echo(f"{goal.name}: {number(goal.value)} {goal.unit}".rstrip() + f": {goal.detail}")
    if goals:
        verdict = "explains" if all(goal.passed for goal in goals) else "does NOT explain"
        typer.echo(f"the model {verdict} the record")
    typer.echo(f"result: {path}")


def print_goals(result: dict[str, Any], report: Path) -> None:
    """The goals of a run with their values, what was missed, and where its report is."""
    table = goals_table(result)
    print_table(table.header[:4], [row[:4] for row in table.rows], ("goal", ""), table.title, table.note)
    for goal in check_goals(result):
        if not goal.passed:
            typer.echo(f"missed: {goal.name}: {goal.detail}")
    typer.echo(f"report: {report}")
