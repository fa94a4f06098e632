"""Summary of a study: `summary.json` and `summary.md`, with plots.

Failed rows are counted and named. No average includes them.
"""

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd

from identify.errors import StudyError
from identify.files.run_folder import save_files
from identify.files.versions import versions
from identify.studies import theory, uniformity
from identify.studies.figures import Others, draw, draw_side_by_side
from identify.studies.labels import labelled, unit_of
from identify.studies.rows import KINDS
from identify.studies.rows.kind import PROBABILITY
from identify.studies.study_file import Study
from identify.studies.table import figure_names
from identify.studies.theory import Statistics, Verdict, check_laws
from identify.studies.uniformity import Uniformity

JSON = "summary.json"
MARKDOWN = "summary.md"
NAMED = 20  # largest number of failed rows, and of reasons, that the summary names
# Largest number of points in the table of `summary.md`. `summary.json` has all points.
LONGEST = 60
Points = list[tuple[dict[str, Any], dict[str, Statistics]]]  # factors and statistics of points


def write(
    folder: Path, study: Study, frame: pd.DataFrame, figures: bool = True, others: Others = ()
) -> dict[str, Any]:
    """Write summary.json, summary.md and, by default, plots into a study's folder.

    folder   Folder of the study.
    frame    Table of the study.
    figures  Whether plots are drawn.
    others   Names and finished rows of other studies, which are always plotted beside this study.

    Returns the content of summary.json. Raises WriteError if a file cannot be written. Raises
    StudyError as `main_figures` does.
    """
    done = frame[frame["error"] == ""]
    names = [
        name for name in figure_names(frame, study) if pd.api.types.is_numeric_dtype(frame[name])
    ]
    # The rms of probabilities says nothing, so their uniformity is tested instead.
    names = [name for name in names if not name.startswith(PROBABILITY)]
    points = _points(study, done, names)
    verdicts = check_laws(study, frame)
    tests = uniformity.judge_uniformity(done, list(study.factors))
    entry = {
        "name": study.name,
        "title": study.title,
        "kind": study.kind,
        "scenario": study.scenario,
        "seed": study.seed,
        "versions": versions(),
        "rows": {
            "planned": study.rows,
            "done": len(done),
            "failed": len(frame) - len(done),
            "missing": study.rows - len(frame),
        },
        "failures": _failures(study, frame),
        "confidence": {"bands": theory.BAND_CONFIDENCE, "laws": theory.CONFIDENCE},
        "units": {
            name: unit for name in [*study.factors, *names] if (unit := unit_of(name, study))
        },
        "theory": [verdict.entry for verdict in verdicts],
        "uniformity": [one.entry for one in tests],
        "points": [
            {"factors": factors, "figures": {name: asdict(one) for name, one in figures.items()}}
            for factors, figures in points
        ],
    }
    shown = main_figures(study, names)
    text = _markdown(study, entry, verdicts, points, shown, tests)
    save_files(folder, {JSON: entry, MARKDOWN: text})
    if figures:
        draw(folder / "figures", study, done, shown, verdicts, tests)
    if others and len(done):
        draw_side_by_side(folder / "figures", study, done, shown, others)
    return entry


def main_figures(study: Study, names: list[str]) -> list[str]:
    """Return the figures among `names` that are plotted and tabulated.

    The study names these figures. If it names none, they are the main figures of a built-in kind,
    or the first six figures of a user's own kind. Raises StudyError if the study names a figure
    that neither the rows nor their kind have. Without rows, no name is checked.
    """
    if study.figures is not None:
        # The first rows of a running study can lack a figure of the kind.
        known = KINDS[study.kind].columns if study.kind in KINDS else {}
        missing = [
            name for name in study.figures if names and name not in names and name not in known
        ]
        if missing:
            raise StudyError(
                f"figures has {missing[0]!r}, but the rows have only {', '.join(names)}"
            )
        return [name for name in study.figures if name in names]
    if study.kind not in KINDS:
        return names[:6]
    return [
        name for name, column in KINDS[study.kind].columns.items() if column.main and name in names
    ]


def _points(study: Study, done: pd.DataFrame, names: list[str]) -> Points:
    """Return factors and statistics of each point that has a finished row.

    Points of a grid have the order of the grid, and points of a sample are sorted. A sample without
    repeats is summarised as one point without factors.
    """
    paths = list(study.factors)
    if not len(done):
        return []
    # In a sample without repeats, each point has a single row and thus no band.
    if not paths or (study.sample is not None and study.repeats == 1):
        return [({}, _statistics(done, names))]
    return [
        (dict(zip(paths, values, strict=True)), _statistics(rows, names))
        for values, rows in done.groupby(paths, sort=study.sample is not None)
    ]


def _statistics(rows: pd.DataFrame, names: list[str]) -> dict[str, Statistics]:
    """Return the statistics of each figure over the rows that have this figure."""
    values = {name: rows[name].dropna().to_numpy(dtype=float) for name in names}
    return {name: theory.point_statistics(found) for name, found in values.items() if len(found)}


def _failures(study: Study, frame: pd.DataFrame) -> dict[str, Any]:
    failed = frame[frame["error"] != ""]
    named = failed.head(NAMED)[["row", "repeat", *study.factors, "error"]]
    return {
        "reasons": failed["error"].value_counts().head(NAMED).to_dict(),
        "first": named.to_dict("records"),
    }


def _markdown(
    study: Study,
    entry: dict[str, Any],
    verdicts: list[Verdict],
    points: Points,
    shown: list[str],
    tests: list[Uniformity],
) -> str:
    rows = entry["rows"]
    lines = [
        f"# {study.title or study.name}",
        "",
        f"Study `{study.name}`, rows of kind `{study.kind}`, scenario `{study.scenario}`, seed "
        f"{study.seed}: "
        f"{rows['done']} rows done, {rows['failed']} failed, {rows['missing']} missing.",
    ]
    if verdicts:
        lines += [
            "",
            "## Theory",
            "",
            f"Intervals at {theory.CONFIDENCE:.0%}."
            + (" Verdicts can change with the missing rows." if rows["missing"] else ""),
            "",
            "| law | says | measured | interval | verdict |",
            "|---|---|---|---|---|",
        ]
        lines += [_law_row(verdict) for verdict in verdicts]
    if tests:
        lines += [
            "",
            "## Uniformity",
            "",
            "Stated probability of values below the truth, over the rows. It is uniform where the "
            "stated distributions are right.",
            "",
            *uniformity.table(tests),
        ]
    if rows["failed"]:
        lines += ["", "## Failed rows", "", "The figures below exclude them."]
        lines += [f"- {count} x {reason}" for reason, count in entry["failures"]["reasons"].items()]
        lines += [
            "",
            f"{_rows_text([one['row'] for one in entry['failures']['first']], rows['failed'])}.",
        ]
    lines += ["", "## Points", "", _bands_text(points), "", *_table(study, points, shown)]
    return "\n".join(lines) + "\n"


def _rows_text(named: list[int], count: int) -> str:
    """Return the numbers of rows, of which there are `count` in all."""
    if len(named) < count:
        return f"Rows {', '.join(map(str, named))} and {count - len(named)} more"
    *others, last = map(str, named)
    return f"Rows {', '.join(others)} and {last}" if others else f"Row {last}"


def _law_row(verdict: Verdict) -> str:
    law = verdict.law
    measured = verdict.reason
    interval = ""
    if verdict.measured is not None:
        measured = f"{verdict.measured:.4g}"
        interval = f"{verdict.low:.4g} to {verdict.high:.4g}"
    return f"| {law.statement} | {law.expected} | {measured} | {interval} | {verdict.verdict} |"


def _bands_text(points: Points) -> str:
    if points and all(one.rows < 2 for _, figures in points for one in figures.values()):
        return (
            "Rms over rows. With a single repeat there is no band: the same command with "
            "--repeats 10 adds repeats."
        )
    return f"Rms over rows, with its {theory.BAND_CONFIDENCE:.0%} band."


def _table(study: Study, points: Points, shown: list[str]) -> list[str]:
    factors = list(points[0][0]) if points else []
    heads = [labelled(path, study) for path in factors]
    heads += ["rows", *(labelled(name, study) for name in shown)]
    lines = [f"| {' | '.join(heads)} |", "|" + "---|" * len(heads)]
    for values, figures in points[:LONGEST]:
        count = max((one.rows for one in figures.values()), default=0)
        cells = [
            f"{value:.6g}" if isinstance(value, float) else str(value) for value in values.values()
        ]
        cells += [str(count), *(_cell(figures.get(name)) for name in shown)]
        lines.append(f"| {' | '.join(cells)} |")
    if len(points) > LONGEST:
        lines.append(f"\n{len(points) - LONGEST} more points are in `{JSON}`.")
    return lines


def _cell(one: Statistics | None) -> str:
    if one is None:
        return "none"
    if one.rms_band is None or not all(map(math.isfinite, one.rms_band)):
        return f"{one.rms:.4g}"
    return f"{one.rms:.4g} ({one.rms_band[0]:.4g} to {one.rms_band[1]:.4g})"
