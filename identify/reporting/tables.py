"""Tables of a run, and the summaries at the terminal.

The paper's figures stand beside those of a run that repeats the paper's experiment.
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
    """Table of text with a title.

    ``note`` says what the reader must know to read it. ``folded`` is true if only the title is seen
    at first.
    """

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""
    folded: bool = False

    @property
    def words(self) -> tuple[bool, ...]:
        """Flags of the columns that hold words, and not numbers."""
        # Signs and dashes are the typographic ones that `number` writes.
        numeric = re.compile(r"([-+−≤≥(]? ?[\d.]+.*|[-–]?|diverged)$")
        columns = zip(*self.rows, strict=True)
        return tuple(
            k == 0 or not all(numeric.match(cell) for cell in column)
            for k, column in enumerate(columns)
        )

    def without(self, hidden: Collection[int]) -> "Table":
        """Return the table without the columns of the given indices."""

        def kept(cells: tuple[str, ...]) -> tuple[str, ...]:
            return tuple(cell for k, cell in enumerate(cells) if k not in hidden)

        return replace(self, header=kept(self.header), rows=tuple(map(kept, self.rows)))

    def without_empty(self) -> "Table":
        """Return the table without columns that hold only empty cells and dashes."""
        columns = enumerate(zip(*self.rows, strict=True)) if self.rows else ()
        return self.without(
            [k for k, column in columns if all(cell in ("", "-") for cell in column)]
        )

    def markdown(self) -> str:
        """Return the table as Markdown, with numbers aligned to the right."""
        lines = [self.header, ("---",) + ("--:",) * (len(self.header) - 1), *self.rows]
        return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def goals_table(result: dict[str, Any]) -> Table:
    """Return every goal with its value, its limit and whether it is met.

    The speed stands below, which no goal judges.
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
    """Return the rows on the speed of the stages that have been run."""
    rate = result.get("sensor", {}).get("stereo_frames_per_second")
    seconds = result.get("seconds", {})
    # Names with a dot are parts of a stage, and would be counted twice.
    stages = [
        value
        for name, value in seconds.items()
        if name != "total" and "." not in name and value is not None
    ]
    rows: list[tuple[str, ...]] = []
    if rate:
        what = "rendered and measured, in one process"
        rows.append(("stereo frames", f"{number(rate)} 1/s", "", "", what))
    if stages:
        total = seconds.get("total") or sum(stages)
        what = "all stages so far, compiling included"
        rows.append(("whole run", f"{number(total)} s", "", "", what))
    return rows


def common_error_table(result: dict[str, Any]) -> Table:
    """Return the errors that all poses of the record have in common.

    Each has the standard deviation that was known beforehand, the estimate from the record and its
    standard deviation.
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
        "servo acts, it takes the platform to where such an error does not show; then little is "
        f"learnt of it.{_shares(found)}"
    )
    header = ("error", "standard deviation beforehand", "found ± standard deviation")
    return Table("What is wrong in all frames alike", header, rows, note, folded=True)


KINDS = {"rig": "cameras", "teaching": "taught frames", "exposure": "exposures apart"}
"""Words for the kinds of common errors whose names need some."""


def _shares(found: dict[str, Any]) -> str:
    """Return a sentence with the largest share of each kind of common error in a variance."""
    identified = [
        one.get("common_share") for one in found["parameters"].values() if one["identifiable"]
    ]
    # Older results have no share, or one number for all kinds together.
    shares = [one for one in identified if isinstance(one, dict)]
    largest = {kind: max(one[kind] for one in shares) for kind in (shares[0] if shares else ())}
    said = ", ".join(
        f"{KINDS.get(kind, kind)} {number(100.0 * share, 2)} %" for kind, share in largest.items()
    )
    return f" Largest share of the variance of an identified parameter: {said}." if said else ""


def excitation_error_table(result: dict[str, Any], beside_paper: bool = False) -> Table:
    """Compare the model with the measurement on the exciting trajectory.

    The rows are before and after identification. For a run that repeats the paper's experiment, the
    paper's table 3 stands beside them.
    """
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
    """Compare the models with measurement and truth on the unseen trajectories.

    For a run that repeats the paper's experiment, the paper's table 4 follows.
    """
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
    """Compare the predicted deviation of the plant from the identified model with the found one.

    The rows are the unseen trajectories.
    """
    rows: list[tuple[str, ...]] = []
    for n, run in enumerate(result.get("validation", []), start=1):
        predicted = run.get("predicted", {})
        rows.append((f"{n}: predicted", *map(number, predicted_row(run)), ""))
        # Without a prediction, the deviation is that from the identified model.
        found = rms_row(predicted if "position_rms_um" in predicted else run["true"])
        rows.append(
            (f"{n}: found", *_rms(found), number(predicted.get("normalised_squared_error")))
        )
    return Table(
        "How far the true robot was expected from the predicted poses, and how far it was, RMS",
        ("run", *AXIS_HEADER, "found²/predicted²"),
        tuple(rows),
        "Predicted by the identified model and what its record taught of errors in common to all "
        "frames; how far, from the uncertainty of both, and from what the cameras' noise does to "
        "the robot through the servo. The last column is the squared error in units of what was "
        "predicted: one on average where the prediction is right. The runs share one set of "
        "parameters, so they stray together. Where cameras and taught frames count as exact, their "
        "error, which moves the robot as a whole, is not predicted.",
        folded=True,
    )


def sensor_table(result: dict[str, Any]) -> Table:
    """Compare the measured poses with the truth."""
    sensor = result["sensor"]
    header = ("frames", "lost", "frames a second", *AXIS_HEADER)
    frames = sensor["frames"]
    lost = sensor["lost_frames"]
    rate = sensor.get("stereo_frames_per_second")
    row = (str(frames), str(lost), number(rate), *_rms(rms_row(sensor)))
    return Table("Measured against true pose, RMS over all frames", header, (row,))


def seconds_table(result: dict[str, Any]) -> Table:
    """Return the time of each stage."""
    rows = tuple((name, number(value)) for name, value in result.get("seconds", {}).items())
    return Table("Time of the stages", ("stage", "seconds"), rows, folded=True)


def settings_table(result: dict[str, Any], recorded: str) -> Table:
    """Return the differences from the built-in scenario that the recorded one is compared with.

    ``recorded`` is the scenario of the record (TOML). Settings that were changed for the
    identification are among the differences.
    """
    base, changed = changed_settings(recorded, result.get("settings"))
    rows = tuple((one.key, one.value, one.built_in, one.meaning) for one in changed)
    return Table(
        f"What differs from the scenario {base}", ("key", "value", f"in {base}", "meaning"), rows
    )


def versions_table(result: dict[str, Any]) -> Table:
    """Return the versions of the software that identified."""
    rows = tuple((name, str(value)) for name, value in result.get("versions", {}).items())
    return Table("Software", ("package", "version"), rows, folded=True)


def _rms(values: list[float]) -> list[str]:
    return [number(value) if math.isfinite(value) else "diverged" for value in values]


def print_identification(result: dict[str, Any], path: Path) -> None:
    """Print a summary of the identification.

    It says what is identified, how well the model explains the record, the time it took, and where
    the result is.
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
    """Print the goals of a run with their values, which were missed, and where the report is."""
    table = goals_table(result)
    print_table(
        table.header[:4], [row[:4] for row in table.rows], ("goal", ""), table.title, table.note
    )
    for goal in check_goals(result):
        if not goal.passed:
            typer.echo(f"missed: {goal.name}: {goal.detail}")
    typer.echo(f"report: {report}")
