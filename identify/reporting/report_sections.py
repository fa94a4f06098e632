"""Sections of the report after its opening summary: text, pictures, tables and folded parts."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from identify.estimation.identifiability import FRICTION_SHARE, IDENTIFIABLE_SHARE
from identify.record.frame_times import missing_rows
from identify.record.from_telemetry import LOGGED_ROWS, MISSING_ROWS
from identify.reporting import paper, parameter_tables, tables
from identify.reporting.number_format import number, significant, typographic, with_deviation
from identify.reporting.run_data import RunData
from identify.reporting.tables import Table

CAUSES = 12  # largest number of causes in the table of a diagnosis, those that explain most


@dataclass(frozen=True)
class FoldedText:
    """Text that is folded under a title.

    ``printed`` is true if it is also shown in print. ``verbatim`` is true if its line breaks are
    kept.
    """

    title: str
    text: str
    printed: bool = True
    verbatim: bool = False


@dataclass(frozen=True)
class Section:
    """Section of the report.

    text           Paragraphs.
    pictures       Names of pictures.
    folded         Names of folded pictures, by title.
    tables, folds  Tables, and folded texts.
    """

    title: str
    text: tuple[str, ...] = ()
    pictures: tuple[str, ...] = ()
    folded: Mapping[str, str] = field(default_factory=dict)
    tables: tuple[Table, ...] = ()
    folds: tuple[FoldedText, ...] = ()


def sensor_section(data: RunData) -> Section:
    """Describe the sensor: its errors if the truth is known, otherwise its stated uncertainty."""
    ok = data.experiment["measured_ok"].values.astype(bool)
    note = data.scenario.sensor_note
    name = Path(data.scenario.sensor).stem
    said = [] if data.truth is None else [f"The sensor is “{name}”{f': {note}' if note else '.'}"]
    if isinstance(data.scene, str):
        said.append(f"Robot and cameras are not drawn: {data.scene}.")
    # The result of a real robot has no entry `sensor`, because no truth is known.
    if "sensor" not in data.result:
        said += [
            row_counts(data.experiment, ok, data.scenario.timing.frame_rate_hz),
            "The truth is not known: the uncertainties below are those that the sensor states.",
        ]
        return Section("Sensor", (" ".join(said),), ("stereo_frame", "ellipses"))
    if data.cameras_consistent:
        common_errors = data.result["identification"].get("nuisances")
        beside = ", plus errors that all frames have in common" if common_errors else ""
        said.append(
            "Its errors agree with the noise that it states, and are independent from frame to "
            f"frame{beside}."
        )
    elif data.cameras_consistent is not None:
        said.append(
            "Its errors are larger than the noise and the common errors that it states, or depend "
            "on the errors of earlier frames."
        )
    watch = data.result.get("drift_watch")
    if watch and watch.get("noticed_s") is None:
        said.append(
            "The cameras kept their calibration, according to the pattern of the stickers and to "
            "the distance between the two rays to each sticker."
        )
    # An empty table is omitted.
    common = [table for table in (parameter_tables.common_error_table(data.result),) if table.rows]
    shown = (tables.sensor_table(data.result), *common)
    return Section("Sensor", (" ".join(said),), ("stereo_frame", "ellipses"), tables=shown)


def row_counts(record: xr.Dataset, ok: NDArray[np.bool_], rate_hz: float) -> str:
    """Say how many rows and poses a record of a real robot has. ok (N,): rows with a used pose."""
    rows = int(record.attrs.get(LOGGED_ROWS, len(ok)))
    missing = int(record.attrs.get(MISSING_ROWS, missing_rows(record["time"].values, rate_hz)))
    source = "log" if LOGGED_ROWS in record.attrs else "record"
    parts = [f"The {source} has {rows} rows for poses: {int(ok.sum())} with a pose that is used"]
    if len(ok) > ok.sum():
        parts.append(f"{len(ok) - int(ok.sum())} whose pose was lost or a gross error")
    if rows > len(ok):
        parts.append(f"{rows - len(ok)} that are left out, before two commands act or in a gap")
    said = ", ".join([*parts[:-1], f"and {parts[-1]}"]) if len(parts) > 1 else parts[0]
    gaps = f" Beside them, {missing} frames of {rate_hz:g} Hz are missing in it."
    return f"{said}.{gaps if missing else ''}"


def excitation_section(data: RunData) -> Section:
    """Describe the exciting motion."""
    return Section("Excitation", _index_text(data), ("path", "excitation"))


def fit_section(data: RunData) -> Section:
    """Describe how the search ended, how well the models fit, and the diagnosis if there is one."""
    found = data.result["identification"]
    text = f"{_steps(found)} ended because {typographic(found['stop_reason'])}."
    table = tables.excitation_error_table(data.result, data.repeats_paper)
    causes = _diagnosis_table(data.result)
    return Section(
        "Fit",
        (text, *_paper_text(data), *_diagnosis_text(data.result)),
        ("fit_excitation", "diagnosis"),
        tables=(table, *([causes] if causes.rows else [])),
    )


def parameter_section(data: RunData) -> Section:
    """Describe the identified parameters and, folded, the other parameters with the reasons."""
    found = data.result["identification"]
    parameters = found["parameters"]
    known = [p for p in parameters.values() if p["identifiable"]]
    text = [
        f"The record identifies {tables.identified_counts(found)}. A quantity is identified if its "
        f"standard deviation is less than {100 * IDENTIFIABLE_SHARE:g} % of that of its initial "
        "guess, and of its size. The size is that of the initial guess or, for a friction with a "
        f"guess of zero, {100 * FRICTION_SHARE:g} % of the torque or force that the joints hold at "
        "home.",
        parameter_tables.scale_sentence(found),
        *filter(None, [tables.common_scale_sentence(found)]),
        *filter(None, [parameter_tables.drive_sentence(found)]),
        *_prior_text(found),
        *_conditioning_text(found),
    ]
    folds = [
        FoldedText(f"Not identified, {len(names)} of {len(parameters)}: {reason}", ", ".join(names))
        for reason, names in parameter_tables.unidentified(found)
    ]
    pairs = [parameter_tables.correlation_table(data.result)] if known else []
    shown = [table for table in (parameter_tables.parameter_table(data.result),) if table.rows]
    shown += [table for table in (parameter_tables.group_table(data.result),) if table.rows]
    folded = {"Correlations of the errors of the parameters": "correlation"} if known else {}
    return Section(
        "Parameters", tuple(text), ("parameters", "groups"), folded, (*shown, *pairs), tuple(folds)
    )


def validation_section(data: RunData) -> Section:
    """Describe the errors on validation trajectories."""
    if not data.validation:
        text = (
            "This record has no validation trajectories. Record another motion of the robot, and "
            "compare it with the prediction of the model: a model that only follows the motion to "
            "which it was fitted is of no use."
        )
        return Section("Validation", (text,))
    both = (
        tables.validation_table(data.result, data.repeats_paper),
        tables.prediction_table(data.result),
    )
    text = f"{len(data.validation)} trajectories that were not used in the identification."
    return Section("Validation", (text,), ("validation_errors", "fit_validation"), tables=both)


def provenance_section(data: RunData) -> Section:
    """List the settings and versions that repeat the run, and the times of its stages."""
    designed = "reference_position" in data.experiment
    # A built-in scenario is no standard for a record of one's own.
    own = data.truth is None
    changed = (
        tables.estimator_table(data.result, data.scenario_toml)
        if own
        else tables.settings_table(data.result, data.scenario_toml, designed)
    )
    made = f"Record made {data.experiment.attrs.get('created', 'at an unknown time')}."
    text = [made, "Every picture is also in the folder figures, as PDF for print and as PNG."]
    if not (changed.rows or own):
        text.append(
            f"No setting differs from those of the built-in scenario: {changed.title.split()[-1]}."
        )
    return Section(
        "How it was made",
        tuple(text),
        tables=(
            *([changed] if changed.rows else []),
            tables.seconds_table(data.result),
            tables.versions_table(data.result),
        ),
        folds=(FoldedText("The whole scenario", data.scenario_toml, printed=False, verbatim=True),),
    )


# Functions that build the sections, in the order of the report.
SECTIONS: tuple[Callable[[RunData], Section], ...] = (
    sensor_section,
    excitation_section,
    fit_section,
    parameter_section,
    validation_section,
    provenance_section,
)


def _steps(found: Mapping[str, Any]) -> str:
    """Begin a sentence with the numbers of steps and of searches. Each search has its own limit."""
    steps = found["iterations"]
    searches = len(found.get("searches") or [""])
    counted = f"{steps} step{'s' * (steps != 1)}"
    if searches == 1:
        return f"The search took {counted}; it"
    return f"The {searches} searches took {counted} together; the last one"


def _prior_text(found: dict[str, Any]) -> list[str]:
    """State how many estimates depend on the initial guesses of other parameters."""
    counts = {
        "parameters": sum(bool(p.get("rests_on_prior")) for p in found["parameters"].values()),
        "sums": sum(bool(g.get("rests_on_prior")) for g in tables.sums_of(found)),
    }
    said = " and ".join(f"{count} of these {kind}" for kind, count in counts.items() if count)
    if not said:
        return []
    return [
        f"{said} rest on the initial guesses of other parameters, and are only as good as these. "
        "They are marked in the tables."
    ]


def _conditioning_text(found: dict[str, Any]) -> list[str]:
    """State on how many quantities the motion depends, and how many of them the record shows."""
    conditioning = found.get("conditioning")
    if conditioning is None:
        return []
    directions = conditioning["directions"]
    shown = directions - conditioning["unshown"]
    sums = len(tables.sums_of(found))
    single = len(found.get("groups", {})) - sums
    # One direction of these quantities, that of the common factor, is not among the directions.
    gains = directions + 1 - sums - single
    return [
        f"The motion depends on {sums} sums of parameters, on {single} single parameters and on "
        f"{gains} gains. Poses show these {sums} + {single} + {gains} = {directions + 1} "
        f"quantities up to one common factor, so that {directions} are independent. This record "
        f"determines {shown} of them better than the initial guess does. A quantity counts as "
        "identified only if it is also known well enough."
    ]


def _index_text(data: RunData) -> tuple[str, ...]:
    """State what the search for an exciting trajectory gained, if there was one."""
    chosen = data.trajectories
    if chosen is None:
        return ()
    text = (
        "The observability index (eq. 39 of the paper; larger is better) is "
        f"{significant(chosen.first_index, 3)} for the first random candidate, "
        f"{significant(chosen.median_index, 3)} for the median, and "
        f"{significant(chosen.observability_index, 3)} for the trajectory that was used."
    )
    if data.repeats_paper:
        text += (
            f" With its own geometry, the paper improved it from {paper.INDEX_FIRST:g} to "
            f"{paper.INDEX_BEST:g} by a genetic algorithm."
        )
    return (text,)


def _diagnosis_text(result: dict[str, Any]) -> tuple[str, ...]:
    """Return the diagnosis of a result and its remedies as sentences, or an empty tuple."""
    entry = result.get("diagnosis")
    if entry is None:
        return ()
    needed = not entry.get("not_needed")
    remedies = [text for one in entry["findings"] if needed for text in one["remedies"]]
    introduction = (
        "The residuals of the model were examined for their cause. Each possible cause is judged "
        "by the share of the misfit that it explains in addition to the parameters. Causes that "
        "explain more than chance are fitted, one after the other."
    )
    return (
        introduction,
        f"Diagnosis: {entry['says']}.",
        *(f"Remedy: {text}." for text in remedies),
    )


def _diagnosis_table(result: dict[str, Any]) -> Table:
    """Return the first candidates of a diagnosis. Without a diagnosis, the table has no rows."""
    entry = result.get("diagnosis") or {"candidates": []}
    rows = tuple(
        (
            one["name"],
            f"{number(100 * one['share'], 3)} %",
            number(one["statistic"], 4),
            str(one["freedoms"]),
            "-" if one["value"] is None else with_deviation(one["value"], one["std"]),
            one["unit"],
        )
        for one in entry["candidates"][:CAUSES]
    )
    return Table(
        "Share of the misfit that each cause alone explains",
        ("cause or group", "explains", "score statistic", "free numbers", "size ± std", "unit"),
        rows,
        "The values are of first order, before any cause is fitted. Standard deviations are due to "
        "noise.",
        folded=True,
    )


def _paper_text(data: RunData) -> tuple[str, ...]:
    if not data.repeats_paper:
        return ()
    ours = (
        "; its filter and its search for a trajectory differ from those of the paper, which the "
        "scenario paper_settings has"
    )
    rest = ", filter and search" if data.scenario.name == paper.PAPER_SETTINGS else ours
    return (
        "This run repeats the paper's experiment on a simulated robot of the same kind, with its "
        f"masses, gains and motion frequencies{rest}. The numbers of the paper are given for "
        "comparison. They are from a real robot, whose truth is not known.",
    )
