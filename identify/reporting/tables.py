"""Tables of a run, and the summaries on the terminal.

For a run that repeats the experiment of the paper, the paper's numbers are given for comparison.
"""

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import typer

from identify.estimation.common_scale import ENTRY, found_errors
from identify.files.run_folder import AXES, actual_row, predicted_row, rms_row
from identify.progress import print_advice, print_table
from identify.reporting import paper
from identify.reporting.goal_causes import advices
from identify.reporting.goals import check_goals, explanation_goals, unseen
from identify.reporting.number_format import number, significant
from identify.reporting.settings import changed_settings, settings_set_anew
from identify.reporting.verdict import intervals_sentence

AXIS_UNITS = ("µm", "µm", "µm", "µrad", "µrad", "µrad")
AXIS_HEADER = tuple(f"{axis} [{unit}]" for axis, unit in zip(AXES, AXIS_UNITS, strict=True))


@dataclass(frozen=True)
class Table:
    """Table of text with a title.

    ``note`` explains the table. ``folded`` is true if only the title is shown at first.
    """

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""
    folded: bool = False

    @property
    def words(self) -> tuple[bool, ...]:
        """True for each column that holds words instead of numbers, and for the first column."""
        # Signs and dashes are typographic, as written by `number`.
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

    The last rows state the speed, for which there is no goal.
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
    note = "Speed has no limit, because it depends on the machine."
    return Table(
        "Goals", ("goal", "value", "limit", "", "what"), (*rows, *_speed_rows(result)), note
    )


def _speed_rows(result: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return the rows on the speed of the stages that have been run."""
    rate = result.get("sensor", {}).get("stereo_frames_per_second")
    seconds = result.get("seconds", {})
    # Names with a dot are parts of a stage, and are already counted in it.
    stages = {
        name: value
        for name, value in seconds.items()
        if name != "total" and "." not in name and value is not None
    }
    rows: list[tuple[str, ...]] = []
    if rate:
        what = "rendered and measured, in one process"
        rows.append(("processed stereo frames", f"{number(rate)} 1/s", "", "", what))
    if stages:
        if total := seconds.get("total"):
            what = "all stages, teaching and compiling included"
            rows.append(("whole run", f"{number(total)} s", "", "", what))
        else:
            said = f"{number(sum(stages.values()))} s"
            rows.append((f"time of {', '.join(stages)}", said, "", "", "compiling included"))
    return rows


def excitation_error_table(result: dict[str, Any], repeats_paper: bool = False) -> Table:
    """Compare the model with the measurement on the exciting trajectory.

    The columns are the RMS of the initial and of the identified model. With ``repeats_paper``,
    those of the paper's table 3 follow.
    """
    initial = _rms(rms_row(result.get("before")))
    identified = _rms(rms_row(result.get("after")))
    header: tuple[str, ...] = ("component", "initial model", "identified model")
    columns: list[Sequence[str]] = [AXIS_HEADER, initial, identified]
    if repeats_paper:
        header += ("paper, initial", "paper, identified")
        columns += [list(map(number, paper.BEFORE)), list(map(number, paper.AFTER))]
    return Table(
        "Model against measurement on the exciting trajectory, RMS",
        header,
        tuple(zip(*columns, strict=True)),
        "diverged: the loop of the initial model is unstable." if "diverged" in initial else "",
    )


def validation_table(result: dict[str, Any], repeats_paper: bool = False) -> Table:
    """Compare the models with measurement and truth on the validation trajectories.

    With ``repeats_paper``, the rows of the paper's table 4 follow.
    """
    rows: list[tuple[str, ...]] = []
    validation = result.get("validation", [])
    estimated = unseen(result).estimated if validation else ""
    for n, run in enumerate(validation, start=1):
        if estimated:
            rows.append((f"{n}: predicted, true", *_rms(rms_row(run["predicted"]))))
        rows.append((f"{n}: identified, true", *_rms(rms_row(run["true"]))))
        rows.append((f"{n}: identified, measured", *_rms(rms_row(run["measured"]))))
        if "initial_true" in run:
            rows.append((f"{n}: initial, true", *_rms(rms_row(run["initial_true"]))))
    if repeats_paper:
        rows += [
            (f"paper {n}: identified, measured", *map(number, row))
            for n, row in enumerate(paper.VALIDATION, 1)
        ]
    return Table(
        "Each validation trajectory, RMS",
        ("run: model, against", *AXIS_HEADER),
        tuple(rows),
        "true: against the true poses of the robot; measured: against its measured poses."
        + (f" predicted: the identified model with {estimated}." if estimated else ""),
        folded=True,
    )


def prediction_table(result: dict[str, Any]) -> Table:
    """Compare the expected with the actual deviation of the true robot from the predicted poses.

    There are two rows for each validation trajectory.
    """
    rows: list[tuple[str, ...]] = []
    for n, run in enumerate(result.get("validation", []), start=1):
        predicted = run.get("predicted", {})
        rows.append((f"{n}: expected", *map(significant, predicted_row(run)), ""))
        squared = number(predicted.get("normalised_squared_error"))
        rows.append((f"{n}: actual", *_rms(actual_row(run)), squared))
    return Table(
        "Expected and actual distance of the true robot from the predicted poses, RMS",
        ("run", *AXIS_HEADER, "actual²/expected²"),
        tuple(rows),
        "Poses are predicted by the identified model and the estimated errors common to all "
        "frames. The expected distance follows from the uncertainty of both, and from the noise "
        "of the cameras, which moves the robot through the servo. The last column is the squared "
        "error relative to its expectation: one on average if the uncertainty is right. All runs "
        "have the same estimated parameters, so their errors are not independent. If cameras and "
        "taught frames count as exact, their errors, which move the whole robot, are not included.",
        folded=True,
    )


def sensor_table(result: dict[str, Any]) -> Table:
    """Compare the measured poses with the truth."""
    sensor = result["sensor"]
    header = ("frames", "lost", "frames per second", *AXIS_HEADER)
    frames = sensor["frames"]
    lost = sensor["lost_frames"]
    rate = sensor.get("stereo_frames_per_second")
    row = (str(frames), str(lost), number(rate), *_rms(rms_row(sensor)))
    return Table("Measured against true pose, RMS over all frames", header, (row,))


def seconds_table(result: dict[str, Any]) -> Table:
    """Return the time of each stage before the report."""
    seconds = result.get("seconds", {}).items()
    rows = tuple((name, number(v)) for name, v in seconds if name not in ("report", "total"))
    return Table("Time of the stages before the report", ("stage", "seconds"), rows, folded=True)


def estimator_table(result: dict[str, Any], recorded: str) -> Table:
    """Return the settings of the estimator that differ from the recorded scenario (TOML)."""
    rows = tuple(settings_set_anew(recorded, result.get("settings")))
    return Table("What was set anew for the identification", ("key", "value", "meaning"), rows)


def settings_table(result: dict[str, Any], recorded: str, designed: bool = True) -> Table:
    """Return the differences between the recorded scenario and a built-in one.

    ``recorded`` is the scenario of the record (TOML). Settings that were changed for the
    identification are included. Those of the excitation are left out unless the motion was
    ``designed`` by them.
    """
    base, changed = changed_settings(recorded, result.get("settings"))
    rows = tuple(
        (one.key, one.value, one.built_in, one.meaning)
        for one in changed
        if designed or not one.key.startswith("excitation.")
    )
    return Table(
        f"What differs from the scenario {base}", ("key", "value", f"in {base}", "meaning"), rows
    )


def versions_table(result: dict[str, Any]) -> Table:
    """Return the versions of the software of the identification."""
    rows = tuple((name, str(value)) for name, value in result.get("versions", {}).items())
    return Table("Software", ("package", "version"), rows, folded=True)


def _rms(values: list[float]) -> list[str]:
    return [significant(value) if math.isfinite(value) else "diverged" for value in values]


def sums_of(identification: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the base parameters that combine several parameters."""
    groups = identification.get("groups", {}).values()
    return [group for group in groups if len(group["coefficients"]) > 1]


def identified_counts(identification: Mapping[str, Any]) -> str:
    """Say how many parameters, and how many sums of parameters, are identified."""
    kinds = {
        "parameters": list(identification["parameters"].values()),
        "sums of parameters": sums_of(identification),
    }
    return ", and ".join(
        f"{sum(bool(one['identifiable']) for one in entries)} of {len(entries)} {words}"
        for words, entries in kinds.items()
        if entries
    )


def common_scale_sentence(identification: Mapping[str, Any]) -> str:
    """Return sentences on how well the common scale is known, or "" without an entry of it."""
    scale = identification.get(ENTRY)
    if scale is None:
        return ""
    shared = scale["shared"]
    known = sum(bool(one["identifiable"]) for one in identification["parameters"].values())
    said = (
        f"The common scale, as the proportional gain {scale['gain']} shows it, has a standard "
        f"deviation of {100 * scale['std']:.2g} %. {len(shared) + 1} of the {known} identified "
        "parameters share its error"
    )
    errors = found_errors(identification)
    if errors is None:
        widest = 100 * max(shared.values())
        return f"{said}. Their ratios to this gain have standard deviations up to {widest:.2g} %."
    return (
        f"{said}, which is {100 * errors[0]:+.2g} % here. Their ratios to this gain are off by at "
        f"most {100 * errors[1]:.2g} %."
    )


def measures_sentence(result: dict[str, Any]) -> str:
    """Return the sentences on what the goals of a run measure, which the report has as a column."""
    validated = bool(result.get("validation"))
    compared = [f"of the {unseen(result).what} in the worst run"] if validated else []
    compared += ["of measured poses over all frames"] if result.get("sensor") else []
    said = []
    if compared:
        said.append(
            f"Errors against the truth are the RMS of the worst axis: {', and '.join(compared)}."
        )
    if explanation_goals(result):
        said.append(
            "Residuals are measured minus identified poses. Noise variance is that which the "
            "cameras state. The p value is the probability that noise alone makes residuals as "
            "correlated from frame to frame."
        )
    return " ".join(said)


def print_identification(result: dict[str, Any], path: Path) -> None:
    """Print a summary of the identification.

    The summary states what is identified, how well the model explains the record, the time, and the
    path of the result. It names the cause and the next command if the model does not explain the
    record.
    """
    counts = identified_counts(result["identification"])
    typer.echo(f"identified: {counts}, in {number(result['seconds'].get('identify'))} s")
    if said := common_scale_sentence(result["identification"]):
        typer.echo(said)
    goals = explanation_goals(result)
    for goal in goals:
        typer.echo(f"{goal.name}: {f'{number(goal.value)} {goal.unit}'.strip()}: {goal.detail}")
    if goals and all(goal.passed for goal in goals):
        typer.echo("the model explains the record to within the cameras' noise")
    elif goals:
        typer.echo(
            "the model does NOT explain the record: the model is wrong, or the errors of the "
            "cameras exceed their stated noise"
        )
    missed = [goal for goal in goals if not goal.passed]
    for one, _ in advices(missed, result, path.parent):
        print_advice(one.cause, one.command)
    typer.echo(f"result: {path}")


def print_goals(result: dict[str, Any], report: Path) -> None:
    """Print the goals of a run with their values and, at the end, the path of the report.

    Between them are what the goals measure, the common scale, how many intervals contain the truth,
    widened limits, and the missed goals with their likeliest causes and the commands to type next.
    """
    table = goals_table(result)
    goals = check_goals(result)
    print_table(
        table.header[:4], [row[:4] for row in table.rows], ("goal", ""), table.title, table.note
    )
    identification = result.get("identification") or {}
    for said in (
        measures_sentence(result),
        common_scale_sentence(identification),
        intervals_sentence(identification),
    ):
        if said:
            typer.echo(said)
    for goal in goals:
        if goal.passed and goal.widened:
            typer.echo(f"{goal.name}: {goal.widened}")
    missed = [goal for goal in goals if not goal.passed]
    for goal in missed:
        typer.echo(f"missed: {goal.name}: {goal.detail}")
    for one, names in advices(missed, result, report.parent):
        print_advice(one.cause, one.command, ", ".join(names))
    typer.echo(f"report: {report}")
