"""Table and summary of a gauntlet: gauntlet.csv, gauntlet.json, gauntlet.md and gauntlet.html."""

import html
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from identify.files.run_folder import save_files
from identify.files.versions import versions
from identify.studies.rows.gauntlet.drawn_troubles import TROUBLES
from identify.studies.rows.gauntlet.verdict import GROUPS
from identify.studies.study_file import Study

STEM = "gauntlet"  # name of the files, before their suffix
# Smallest ratio of a misfit to that of noise. Fractions of right answers for one and for two causes
# are over cases with at least this ratio. Of two causes, each alone must reach it for one fraction.
DOUBLED = 2.0
LEVEL = 0.95  # confidence of the intervals of fractions


@dataclass(frozen=True)
class Share:
    """Fraction ``share`` of right answers, with their number ``right`` and the number of cases.

    low, high: Clopper and Pearson's interval of the fraction (binomial). goal: goal as text.
    """

    what: str
    right: int
    cases: int
    share: float
    low: float
    high: float
    goal: str


def cases_of(frame: pd.DataFrame) -> pd.DataFrame:
    """Return one row for each case in the table of a study of kind `gauntlet`.

    Names of troubles and groups of causes replace their numbers. -1 and NaN become empty texts.
    The verdict is "failed" if the diagnosis is wrong or the row could not be computed.
    """
    rows = frame.reindex(columns=sorted({*frame.columns, *_NEEDED}))
    # A row that could not be computed lacks its figures, which are NaN here.
    names = [_name(TROUBLES, rows[f"trouble_{place}"]) for place in (1, 2)]
    numbers = {name: rows[name] for name in _NEEDED if not name.startswith(("trouble_", "first_"))}
    sort = np.select(
        [rows["outside"] == 1, *(rows["troubles"] == count for count in range(3))],
        ["outside", "none", "one", "two"],
        "not computed",
    )
    verdict = np.select(
        [rows["right_intervals"] == 1, rows["right_cause"] == 1],
        ["right intervals", "right cause"],
        "failed",
    )
    columns = {
        "case": rows["row"],
        "wrong": sort,
        "trouble_1": names[0],
        "trouble_2": names[1],
        "first_finding": _name(GROUPS, rows["first_group"]),
        "verdict": verdict,
        **numbers,
        "time_ratio": 1.0 + rows["diagnosis_seconds"] / rows["identification_seconds"],
        "error": rows["error"],
    }
    return pd.DataFrame(columns)


_NEEDED = (
    "trouble_1",
    "trouble_2",
    "first_group",
    "troubles",
    "outside",
    *(f"{name}_{place}" for place in (1, 2) for name in ("size", "named", "together", "alone")),
    "size_error_1",
    "size_error_2",
    "stopped",
    "misfit",
    "findings",
    "none_of_these",
    "explained_percent",
    "right_cause",
    "right_intervals",
    "intervals",
    "covered_percent",
    "before_covered_percent",
    "remedied_explained",
    "identification_seconds",
    "diagnosis_seconds",
)


def _name(names: tuple[str, ...], numbers: pd.Series) -> list[str]:
    return ["" if not number >= 0 else names[int(number)] for number in numbers]


def shares(cases: pd.DataFrame) -> list[Share]:
    """Return the fraction of right answers for each sort of case, and for the fitted sizes.

    Sorts without cases are left out. Rows that could not be computed belong to no sort.
    """
    shown = cases["misfit"] >= DOUBLED
    # A case that stopped with an error has no misfit, but counts as well.
    shown |= cases["stopped"] == 1
    one, two = (cases[(cases["wrong"] == sort) & shown] for sort in ("one", "two"))
    known = pd.concat([one, two])
    errors = pd.concat([known["size_error_1"], known["size_error_2"]]).dropna()
    within = errors.abs() <= 3.0
    right = {
        "one cause: it, or causes named together with it, first": (one["right_cause"], "≥ 95 %"),
        "two causes that each double the misfit: both among the first three": (
            two[~(two[["alone_1", "alone_2"]] < DOUBLED).any(axis=1)]["right_cause"],
            "≥ 85 %",
        ),
        "two causes of any size: both among the first three": (two["right_cause"], ""),
        "nothing wrong: nobody accused": (_right(cases, "none"), "≥ 95 %"),
        "outside the catalogue: none of these": (_right(cases, "outside"), "≥ 90 %"),
        "size of a fitted cause within three deviations": (within, "≥ 95 %"),
    }
    return [_share(what, values, goal) for what, (values, goal) in right.items() if len(values)]


def _right(cases: pd.DataFrame, sort: str) -> pd.Series:
    return cases[cases["wrong"] == sort]["right_cause"]


def _share(what: str, values: pd.Series, goal: str) -> Share:
    right = int(values.sum())
    band = binomtest(right, len(values)).proportion_ci(LEVEL)
    fraction = right / len(values)
    return Share(what, right, len(values), fraction, float(band.low), float(band.high), goal)


def coverage(cases: pd.DataFrame) -> dict[str, float]:
    """Return the percentage of intervals that contain the truth in cases diagnosed right.

    ``std_percent`` is the standard error of the mean over cases, because the intervals of one case
    depend on each other. Cases without identified quantities after the remedy, and thus without
    intervals, are counted separately. The result is empty if no case has intervals.
    """
    rightly_named = cases[(cases["right_cause"] == 1) & (cases["outside"] == 0)]
    percent = rightly_named["covered_percent"].dropna()
    if not len(percent):
        return {}
    statistics = {
        "cases": len(percent),
        "cases_without_intervals": len(rightly_named) - len(percent),
        "covered_percent": float(percent.mean()),
    }
    if len(percent) == 1:
        return statistics
    return statistics | {"std_percent": float(percent.std(ddof=1) / np.sqrt(len(percent)))}


def kinds(cases: pd.DataFrame) -> Iterator[tuple[str, int, int, float, float]]:
    """Yield each kind of trouble with statistics of the cases that have this one trouble only.

    These are the numbers of cases and of right answers, the median misfit, and the mean percentage
    of intervals that contain the truth.
    """
    single = cases[cases["wrong"].isin(["one", "outside"])]
    for name in TROUBLES:
        of_kind = single[single["trouble_1"] == name]
        if len(of_kind):
            yield (
                name,
                len(of_kind),
                int(of_kind["right_cause"].sum()),
                float(of_kind["misfit"].median()),
                float(of_kind["covered_percent"].mean()),
            )


def write(folder: Path, study: Study, frame: pd.DataFrame) -> dict[str, Any]:
    """Write the files of a gauntlet into its folder, and return the content of gauntlet.json.

    Raises WriteError.
    """
    cases = cases_of(frame)
    ratio = cases["time_ratio"].median()
    entry = {
        "scenario": study.scenario,
        "seed": study.seed,
        "versions": versions(),
        "cases": len(cases),
        "verdicts": {str(key): int(n) for key, n in cases["verdict"].value_counts().items()},
        "shares": [asdict(one) for one in shares(cases)],
        "intervals_after_remedy": coverage(cases),
        "time_ratio_median": None if np.isnan(ratio) else float(ratio),
        "misses": [_miss(row) for _, row in cases[cases["verdict"] == "failed"].iterrows()],
    }
    lines = _markdown(entry, cases)
    save_files(
        folder,
        {
            f"{STEM}.csv": cases.to_csv(index=False, float_format="%.6g"),
            f"{STEM}.json": entry,
            f"{STEM}.md": "\n".join(lines) + "\n",
            f"{STEM}.html": _html(entry, cases),
        },
    )
    return entry


def _miss(row: pd.Series) -> dict[str, Any]:
    named = [row[f"trouble_{place}"] for place in (1, 2) if row[f"trouble_{place}"]]
    answer = row["first_finding"] or "nothing"
    if row["none_of_these"] == 1:
        answer = f"none of these, first {answer}"
    if row["stopped"] == 1 or row["error"]:
        answer = row["error"] or "stopped with an error"
    misfit = row["misfit"]
    return {
        "case": int(row["case"]),
        "wrong": " and ".join(named) or "nothing",
        "said": answer,
        "misfit": None if np.isnan(misfit) else float(misfit),
    }


def _tables(
    entry: dict[str, Any], cases: pd.DataFrame
) -> Iterator[tuple[str, list[str], list[list[str]]]]:
    """Yield the tables of a gauntlet, each as its title, header and rows of text."""
    rows = [
        [
            one["what"],
            f"{one['right']} of {one['cases']}",
            f"{100 * one['share']:.3g} %",
            f"{100 * one['low']:.3g} to {100 * one['high']:.3g} %",
            one["goal"],
        ]
        for one in entry["shares"]
    ]
    if covered := entry["intervals_after_remedy"]:
        std = covered.get("std_percent")
        band = "" if std is None else f"± {1.96 * std:.2g} %"
        share = f"{covered['covered_percent']:.3g} %"
        what = "95 % intervals that hold after the remedy, where any are identified"
        named = covered["cases"] + covered["cases_without_intervals"]
        rows.append([what, f"{covered['cases']} of {named} cases", share, band, "93 to 97 %"])
    if (ratio := entry["time_ratio_median"]) is not None:
        what = "time with diagnosis over time without, median"
        rows.append([what, f"{len(cases)} cases", f"{ratio:.3g}", "", "≤ 2"])
    header = ["what", "right", "share", "95 % interval", "goal"]
    yield f"{len(cases)} cases", header, rows
    yield (
        "One trouble a case, by kind",
        ["trouble", "cases", "right", "misfit, median", "intervals that hold"],
        [
            [
                name,
                str(count),
                str(right),
                f"{misfit:.3g}",
                "none" if np.isnan(covered) else f"{covered:.3g} %",
            ]
            for name, count, right, misfit, covered in kinds(cases)
        ],
    )
    yield (
        "Misses",
        ["case", "what was wrong", "what the diagnosis said first", "misfit"],
        [
            [
                str(one["case"]),
                one["wrong"],
                one["said"],
                "" if one["misfit"] is None else f"{one['misfit']:.3g}",
            ]
            for one in entry["misses"]
        ],
    )


NOTE = (
    f"Shares of one and two causes are over cases whose misfit is at least {DOUBLED:g} times that "
    "of noise."
)


def _markdown(entry: dict[str, Any], cases: pd.DataFrame) -> list[str]:
    lines = [f"# Gauntlet of `{entry['scenario']}`, seed {entry['seed']}", "", NOTE]
    for title, header, rows in _tables(entry, cases):
        lines += ["", f"## {title}", "", f"| {' | '.join(header)} |", "|---" * len(header) + "|"]
        lines += [f"| {' | '.join(row)} |" for row in rows]
    return lines


def _html(entry: dict[str, Any], cases: pd.DataFrame) -> str:
    parts = []
    for title, header, rows in _tables(entry, cases):
        head = "".join(f"<th>{html.escape(name)}</th>" for name in header)
        body = "".join(
            f"<tr>{''.join(f'<td>{html.escape(cell)}</td>' for cell in row)}</tr>" for row in rows
        )
        parts.append(f"<h2>{html.escape(title)}</h2><table><tr>{head}</tr>{body}</table>")
    title = html.escape(f"Gauntlet of {entry['scenario']}, seed {entry['seed']}")
    style = "body{font-family:sans-serif}td,th{padding:2px 8px;text-align:left}"
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title>'
        f"<style>{style}</style><h1>{title}</h1><p>{html.escape(NOTE)}</p>{''.join(parts)}</html>\n"
    )
