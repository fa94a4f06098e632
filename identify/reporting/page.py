"""The page of a report: one HTML text without a script, whose figures take on the colours of its reader's screen."""

import re
from collections.abc import Mapping
from pathlib import Path

import jinja2

from identify.reporting import paper
from identify.reporting.figures.style import PALETTE
from identify.reporting.goals import check_goals
from identify.reporting.pictures import Picture
from identify.reporting.run_data import RunData
from identify.reporting.sections import SECTIONS
from identify.reporting.tables import goals_table
from identify.reporting.verdict import key_numbers, verdict

TEMPLATES = Path(__file__).parent / "templates"

FIRST_LOOK = ("scene", "errors")
"""Pictures beside the verdict."""

_NAMES = {code: name for name, code in PALETTE.items()}
_CODES = re.compile("|".join(_NAMES))


def render(data: RunData, pictures: Mapping[str, Picture], drawings: Mapping[str, str]) -> str:
    """The report as one HTML text; drawings: the pictures as <svg> elements, by their names."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    said = verdict(data.result, data.cameras_acquitted)
    goals = check_goals(data.result)
    return environment.get_template("report.html.j2").render(
        title=f"Identification of {data.robot}",
        subtitle=f"scenario {data.result.get('scenario')}, seed {data.result.get('seed')}",
        verdict=said,
        numbers=key_numbers(data.result),
        goals=goals_table(data.result),
        missed=sum(not goal.passed for goal in goals),
        goal_count=len(goals),
        warnings=data.result["identification"].get("warnings", []),
        first_look=[name for name in FIRST_LOOK if name in pictures],
        sections=[build(data) for build in SECTIONS],
        pictures=pictures,
        drawings={name: _coloured(text, pictures[name]) for name, text in drawings.items()},
        paper=paper,
    )


def _coloured(svg: str, picture: Picture) -> str:
    """A figure whose colours are variables of the page, described for who cannot see it."""
    text = svg if picture.own_colours else _CODES.sub(lambda code: f"var(--{_NAMES[code[0]]})", svg)
    head, _, rest = text.partition(">")
    head = re.sub(r'\s(width|height)="[^"]*"', "", head)
    return f'{head} role="img" aria-hidden="true">{rest}'
