"""Text and table of a diagnosis in the report."""

from typing import Any

from identify.reporting.number_format import number, with_deviation
from identify.reporting.tables import Table

SHOWN = 12
"""Number of candidates that the table has."""


def diagnosis_text(result: dict[str, Any]) -> tuple[str, ...]:
    """Return what the diagnosis of a result says, with the remedies. Empty if there is none."""
    entry = result.get("diagnosis")
    if entry is None:
        return ()
    remedies = [text for one in entry["findings"] for text in one["remedies"]]
    asked = (
        "What the model leaves of the record was asked for its cause. Each cause is judged by how "
        "much of the misfit it explains beside the parameters; those that chance does not explain "
        "are fitted, one after the other."
    )
    return (asked, f"Diagnosis: {entry['says']}.", *(f"Remedy: {text}." for text in remedies))


def diagnosis_table(result: dict[str, Any]) -> Table:
    """Return the candidates of a diagnosis as they were ranked, without rows if there is none."""
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
        "What each cause alone explains of the misfit",
        ("cause or group", "explains", "score statistic", "free numbers", "size ± std", "unit"),
        rows,
        "Before any cause is fitted, to first order; the deviations are those that noise makes.",
        folded=True,
    )
