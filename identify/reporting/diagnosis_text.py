"""Text and table of a diagnosis in the report."""

from typing import Any

from identify.reporting.number_format import number, with_deviation
from identify.reporting.tables import Table

SHOWN = 12
"""Largest number of candidates in the table."""


def diagnosis_text(result: dict[str, Any]) -> tuple[str, ...]:
    """Return the diagnosis of a result and its remedies as sentences. Empty without a diagnosis."""
    entry = result.get("diagnosis")
    if entry is None:
        return ()
    remedies = [text for one in entry["findings"] for text in one["remedies"]]
    introduction = (
        "The residuals of the model were examined for their cause. Each possible cause is judged "
        "by the share of the misfit that it explains in addition to the parameters. Causes that "
        "are not explained by chance are fitted, one after the other."
    )
    return (
        introduction,
        f"Diagnosis: {entry['says']}.",
        *(f"Remedy: {text}." for text in remedies),
    )


def diagnosis_table(result: dict[str, Any]) -> Table:
    """Return the candidates of a diagnosis in their order, without rows if there is no
    diagnosis.
    """
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
        for one in entry["candidates"][:SHOWN]
    )
    return Table(
        "Share of the misfit that each cause alone explains",
        ("cause or group", "explains", "score statistic", "free numbers", "size ± std", "unit"),
        rows,
        "To first order, before any cause is fitted. Standard deviations are due to noise.",
        folded=True,
    )
