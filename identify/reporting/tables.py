"""Tables like the paper's 2, 3 and 4 beside the paper's own figures, as rows of text with units in the header."""

import math
import tomllib
from dataclasses import dataclass
from typing import Any

from dynamics.parameters import unit_of
from identify.files.result_file import AXES, predicted_row, rms_row
from identify.reporting import paper_results
from identify.reporting.goals import check_goals

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
    """Every goal with its value, its limit and whether it is met."""
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
    return Table("Goals", ("goal", "value", "limit", "", "what"), rows, "Accuracy: RMS of the worst axis and run.")


def parameter_table(result: dict[str, Any], identifiable_only: bool = False) -> Table:
    """Parameters, like table 2: starting guess, truth, estimate, standard deviation and interval."""
    rows = []
    for name, p in result["identification"]["parameters"].items():
        if not p["identifiable"] and identifiable_only:
            continue
        remark = (ON_GUESS if p.get("rests_on_prior") else "") if p["identifiable"] else NOT_SHOWN
        rows.append((name, unit_of(name), number(p["initial"]), number(p["true"]), *_shown(p), remark))
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
        for axis, unit, b, a, pb, pa in zip(
            AXES, AXIS_UNITS, before, after, paper_results.BEFORE, paper_results.AFTER, strict=True
        )
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
    for number_, run in enumerate(result.get("validation", []), start=1):
        rows.append((f"{number_} true", *_rms(rms_row(run["true"]))))
        rows.append((f"{number_} measured", *_rms(rms_row(run["measured"]))))
        if "initial_true" in run:
            rows.append((f"{number_} starting model, true", *_rms(rms_row(run["initial_true"]))))
    rows += [(f"paper {n} measured", *map(number, row)) for n, row in enumerate(paper_results.VALIDATION, start=1)]
    return Table(
        "RMS on unseen trajectories (like the paper's table 4)",
        ("run", *AXIS_HEADER),
        tuple(rows),
        "true: identified model against the true plant; measured: against what the sensor saw of it.",
    )


def prediction_table(result: dict[str, Any]) -> Table:
    """Predicted deviation of the plant from the identified model beside the deviation found, on unseen trajectories."""
    rows: list[tuple[str, ...]] = []
    for number_, run in enumerate(result.get("validation", []), start=1):
        ratio = run.get("predicted", {}).get("normalised_squared_error")
        rows.append((f"{number_} predicted std", *map(number, predicted_row(run)), ""))
        rows.append((f"{number_} found RMS", *_rms(rms_row(run["true"])), number(ratio)))
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
    sensor = result["sensor"]
    return Table(
        "Sensor: RMS of measured pose against truth",
        ("frames", "lost", "stereo frames a second", *AXIS_HEADER),
        (
            (
                str(sensor["frames"]),
                str(sensor["lost_frames"]),
                number(sensor.get("stereo_frames_per_second")),
                *_rms(rms_row(sensor)),
            ),
        ),
    )


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
