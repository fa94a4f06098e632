"""The tables of a run, and what it says of itself at the terminal; the paper's figures where it
repeats the paper.
"""

import math
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import typer

from identify.files.run_folder import AXES, predicted_row, rms_row
from identify.progress import print_table
from identify.reporting import paper
from identify.reporting.goals import check_goals, explanation_goals
from identify.reporting.number_format import number, with_deviation
from identify.reporting.settings import changed_settings

AXIS_UNITS = ("µm", "µm", "µm", "µrad", "µrad", "µrad")
AXIS_HEADER = tuple(f"{axis} [{unit}]" for axis, unit in zip(AXES, AXIS_UNITS, strict=True))


@dataclass(frozen=True)
class Table:
    """A titled table of text; ``note`` says what the reader must know to read it; ``folded``:
    whether only its title is seen at first."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""
    folded: bool = False

    @property
    def words(self) -> tuple[bool, ...]:
        """Whether each column holds words and not numbers."""
        numeric = re.compile(r"([-+−≤≥(]? ?[\d.]+.*|[-–]?|diverged)$")
        columns = zip(*self.rows, strict=True)
        return tuple(
            k == 0 or not all(numeric.match(cell) for cell in column)
            for k, column in enumerate(columns)
        )

    def without(self, hidden: Collection[int]) -> "Table":
        """The table without some of its columns."""

        def kept(cells: tuple[str, ...]) -> tuple[str, ...]:
            return tuple(cell for k, cell in enumerate(cells) if k not in hidden)

        return replace(self, header=kept(self.header), rows=tuple(map(kept, self.rows)))

    def without_empty(self) -> "Table":
        """The table without columns in which nothing stands."""
        columns = enumerate(zip(*self.rows, strict=True)) if self.rows else ()
        return self.without(
            [k for k, column in columns if all(cell in ("", "-") for cell in column)]
        )

    def markdown(self) -> str:
        """The table as Markdown, numbers aligned to the right."""
        lines = [self.header, ("---",) + ("--:",) * (len(self.header) - 1), *self.rows]
        return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def goals_table(result: dict[str, Any]) -> Table:
    """Every goal with its value, its limit and whether it is met; below them the speed, which no
    goal judges.
    """
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
    note = "Speed has no limit: it is the machine's."
    return Table(
        "Goals", ("goal", "value", "limit", "", "what"), (*rows, *_speed_rows(result)), note
    )


def _speed_rows(result: dict[str, Any]) -> list[tuple[str, ...]]:
    """Speed of what has been done so far."""
    rate = result.get("sensor", {}).get("stereo_frames_per_second")
    seconds = result.get("seconds", {})
    stages = [
        value
        for name, value in seconds.items()
        if name != "total" and "." not in name and value is not None
    ]
    rows: list[tuple[str, ...]] = []
    if rate:
        rows.append(
            (
                "stereo frames",
                f"{number(rate)} 1/s",
                "",
                "",
                "rendered and measured, in one process",
            )
        )
    if stages:
        total = seconds.get("total") or sum(stages)
        rows.append(
            ("whole run", f"{number(total)} s", "", "", "all stages so far, compiling included")
        )
    return rows


def common_error_table(result: dict[str, Any]) -> Table:
    """What all poses of the record have in common: how well it was known, what the record says of
    it, and how well.
    """
    found = result["identification"]
    rows = tuple(
        (
            name,
            number(before, 2),
            with_deviation(found["nuisance_estimates"][name], found["nuisances"][name]),
        )
        for name, before in found.get("nuisance_prior_std", {}).items()
    )
    note = (
        "True minus known, in the unit that ends the name; of the geometry in m and rad. Where a "
        "servo acts, it takes "
        "the platform to where such an error does not show; then little is learnt of "
        f"it.{_shares(found)}"
    )
    header = ("error", "standard deviation beforehand", "found ± standard deviation")
    return Table("What is wrong in all frames alike", header, rows, note, folded=True)


KINDS = {"rig": "cameras", "teaching": "taught frames", "exposure": "exposures apart"}
"""Words for kinds of errors that all frames have in common; the others are words."""


def _shares(found: dict[str, Any]) -> str:
    """What each kind of common error makes of the variance of what is identified, at most, in a
    sentence.
    """
    identified = [
        one.get("common_share") for one in found["parameters"].values() if one["identifiable"]
    ]
    shares = [
        one for one in identified if isinstance(one, dict)
    ]  # older results have none, or one for all kinds
    largest = {kind: max(one[kind] for one in shares) for kind in (shares[0] if shares else ())}
    said = ", ".join(
        f"{KINDS.get(kind, kind)} {number(100.0 * share, 2)} %" for kind, share in largest.items()
    )
    return f" Largest share of the variance of an identified parameter: {said}." if said else ""


def excitation_error_table(result: dict[str, Any], beside_paper: bool = False) -> Table:
    """Model against measurement on the exciting trajectory before and after identification; beside
    the paper's table 3 for a run that repeats its experiment."""
    before = _rms(rms_row(result.get("before")))
    after = _rms(rms_row(result.get("after")))
    header: tuple[str, ...] = ("component", "before", "after")
    columns: list[Sequence[str]] = [AXIS_HEADER, before, after]
    if beside_paper:
        header += ("paper before", "paper after")
        columns += [list(map(number, paper.BEFORE)), list(map(number, paper.AFTER))]
    return Table(
        "Model against measurement on the exciting trajectory, RMS",
        header,
        tuple(zip(*columns, strict=True)),
        "diverged: the loop of the starting model is unstable." if "diverged" in before else "",
    )


def validation_table(result: dict[str, Any], beside_paper: bool = False) -> Table:
    """Models against measurement and truth on the unseen trajectories; with the paper's table 4 for
    a run that repeats its experiment."""
    rows: list[tuple[str, ...]] = []
    for n, run in enumerate(result.get("validation", []), start=1):
        rows.append((f"{n}: identified, true", *_rms(rms_row(run["true"]))))
        rows.append((f"{n}: identified, measured", *_rms(rms_row(run["measured"]))))
        if "initial_true" in run:
            rows.append((f"{n}: starting, true", *_rms(rms_row(run["initial_true"]))))
    if beside_paper:
        rows += [
            (f"paper {n}: identified, measured", *map(number, row))
            for n, row in enumerate(paper.VALIDATION, 1)
        ]
    return Table(
        "Each unseen trajectory, RMS",
        ("run: model, against", *AXIS_HEADER),
        tuple(rows),
        "true: against where the true robot was; measured: against what the cameras saw of it.",
        folded=True,
    )


def prediction_table(result: dict[str, Any]) -> Table:
    """Predicted deviation of the plant from the identified model beside the deviation found, on
    unseen trajectories.
    """
    rows: list[tuple[str, ...]] = []
    for n, run in enumerate(result.get("validation", []), start=1):
        predicted = run.get("predicted", {})
        rows.append((f"{n}: predicted", *map(number, predicted_row(run)), ""))
        found = rms_row(predicted if "position_rms_um" in predicted else run["true"])
        rows.append(
            (f"{n}: found", *_rms(found), number(predicted.get("normalised_squared_error")))
        )
    return Table(
        "How far the true robot was expected from the predicted poses, and how far it was, RMS",
        ("run", *AXIS_HEADER, "found²/predicted²"),
        tuple(rows),
        "Predicted by the identified model and what its record taught of errors in common to all "
        "frames; how far, from "
        "the uncertainty of both, and from what the cameras' noise does to the robot through the "
        "servo. The last "
        "column is the squared error in units of what was predicted: one on average where the "
        "prediction is right. "
        "The runs share one set of parameters, so they stray together. Where cameras and taught "
        "frames count as exact, "
        "their error, which moves the robot as a whole, is not predicted.",
        folded=True,
    )


def sensor_table(result: dict[str, Any]) -> Table:
    """Measured pose against truth."""
    sensor = result["sensor"]
    header = ("frames", "lost", "frames a second", *AXIS_HEADER)
    frames = sensor["frames"]
    lost = sensor["lost_frames"]
    rate = sensor.get("stereo_frames_per_second")
    row = (str(frames), str(lost), number(rate), *_rms(rms_row(sensor)))
    return Table("Measured against true pose, RMS over all frames", header, (row,))


def seconds_table(result: dict[str, Any]) -> Table:
    """Time of each stage."""
    rows = tuple((name, number(value)) for name, value in result.get("seconds", {}).items())
    return Table("Time of the stages", ("stage", "seconds"), rows, folded=True)


def settings_table(result: dict[str, Any], recorded: str) -> Table:
    """What differs from the built-in scenario with which the recorded one (TOML) is to be compared,
    the settings that were changed for the identification among it."""
    base, changed = changed_settings(recorded, result.get("settings"))
    rows = tuple((one.key, one.value, one.built_in, one.meaning) for one in changed)
    return Table(
        f"What differs from the scenario {base}", ("key", "value", f"in {base}", "meaning"), rows
    )


def versions_table(result: dict[str, Any]) -> Table:
    """Versions of the software that identified."""
    rows = tuple((name, str(value)) for name, value in result.get("versions", {}).items())
    return Table("Software", ("package", "version"), rows, folded=True)


def _rms(values: list[float]) -> list[str]:
    return [number(value) if math.isfinite(value) else "diverged" for value in values]


def print_identification(result: dict[str, Any], path: Path) -> None:
    """What is identified, how well the model explains the record, the time it took, and where all
    of it is.
    """
    identification = result["identification"]
    kinds = {"parameters": "parameters", "groups": "sums of them that motion shows"}
    entries = {said: identification.get(kind, {}).values() for kind, said in kinds.items()}
    counts = [
        f"{sum(bool(one['identifiable']) for one in of)} of {len(of)} {said}"
        for said, of in entries.items()
    ]
    typer.echo(
        f"identified: {' and '.join(counts)}, in {number(result['seconds'].get('identify'))} s"
    )
    goals = explanation_goals(result)
    for goal in goals:
        typer.echo(f"{goal.name}: {number(goal.value)} {goal.unit}: {goal.detail}")
    if goals and all(goal.passed for goal in goals):
        typer.echo("the model explains the record to within the cameras' noise")
    elif goals:
        typer.echo(
            "the model does NOT explain the record: it is wrong, or the cameras err by more than "
            "they state"
        )
    typer.echo(f"result: {path}")


def print_goals(result: dict[str, Any], report: Path) -> None:
    """The goals of a run with their values, what was missed, and where its report is."""
    table = goals_table(result)
    print_table(
        table.header[:4], [row[:4] for row in table.rows], ("goal", ""), table.title, table.note
    )
    for goal in check_goals(result):
        if not goal.passed:
            typer.echo(f"missed: {goal.name}: {goal.detail}")
    typer.echo(f"report: {report}")
