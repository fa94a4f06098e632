"""What a run says of itself at the terminal, on standard output."""

from pathlib import Path
from typing import Any

import typer

from identify.reporting.goals import explanation_goals
from identify.reporting.tables import goals_table, number
from identify.terminal import print_table


def print_identification(result: dict[str, Any], path: Path) -> None:
    """What is identified, how well the model explains the record, the time it took, and where all of it is."""
    identification = result["identification"]
    counts = [f"{_identified(identification.get(kind, {}))} {kind}" for kind in ("parameters", "groups")]
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
    for goal, *_, met, detail in table.rows:
        if met != "met":
            typer.echo(f"missed: {goal}: {detail}")
    typer.echo(f"report: {report}")


def _identified(entries: dict[str, Any]) -> str:
    return f"{sum(bool(entry['identifiable']) for entry in entries.values())} of {len(entries)}"
