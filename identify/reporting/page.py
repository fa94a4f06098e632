"""The page of a report: one HTML text without a script, whose figures take on the colours of its reader's screen."""

import base64
import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2
from PIL import Image

from identify.reporting import paper
from identify.reporting.figures.style import PALETTE
from identify.reporting.goals import check_goals
from identify.reporting.numbers import spelled
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
    """The report as one HTML text; drawings: the pictures as elements, by their names."""
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
        subtitle=_subtitle(data.result),
        verdict=said,
        numbers=key_numbers(data.result),
        goals=goals_table(data.result),
        missed=sum(not goal.passed for goal in goals),
        goal_count=len(goals),
        warnings=[_sentence(text) for text in data.result["identification"].get("warnings", [])],
        first_look=[name for name in FIRST_LOOK if name in pictures],
        sections=[build(data) for build in SECTIONS],
        pictures=pictures,
        drawings={n: text if pictures[n].painted else _coloured(text) for n, text in drawings.items()},
        paper=paper,
    )


WIDEST_PX, QUALITY = 1500, 85
"""Of an image on the page; the PNG file beside it has every pixel."""


def painting(path: Path) -> str:
    """A PNG file as an <img> element that holds it, small enough for a page."""
    stream = io.BytesIO()
    with Image.open(path) as image:
        whole = image.convert("RGB")
        whole.thumbnail((WIDEST_PX, WIDEST_PX))
        whole.save(stream, "webp", quality=QUALITY)
    width, height = whole.size
    data = base64.b64encode(stream.getvalue()).decode()
    return f'<img alt="" width="{width}" height="{height}" src="data:image/webp;base64,{data}">'


def _subtitle(result: Mapping[str, Any]) -> str:
    """Scenario and, of a simulated run, seed."""
    seed = result.get("seed")
    return f"scenario {result.get('scenario')}" + ("" if seed is None else f", seed {seed}")


def _sentence(text: str) -> str:
    """A warning as a sentence."""
    return f"{text[:1].upper()}{spelled(text[1:])}."


def _coloured(element: str) -> str:
    """A figure whose colours are variables of the page; what it shows is told by its caption."""
    text = re.sub(r'\sfill="(#[0-9a-f]{6})"', r' style="fill: \g<1>"', element)  # an attribute takes no variables
    text = _CODES.sub(lambda code: f"var(--{_NAMES[code[0]]})", text)
    head, _, rest = text.partition(">")
    return re.sub(r'\s(width|height)="[^"]*"', "", head) + f' aria-hidden="true">{rest}'
