"""HTML page of a report.

The page is one file without a script. Its figures, except those that are images, adapt to the
colours of the reader's screen.
"""

import base64
import io
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jinja2
from PIL import Image

from identify.files.atomic import figure_bytes, write_files
from identify.files.run_folder import RunFolder
from identify.progress import Progress, SilentProgress
from identify.reporting import paper
from identify.reporting.figures.style import PALETTE, drawn, svg_text
from identify.reporting.goal_causes import advices
from identify.reporting.goals import check_goals
from identify.reporting.number_format import typographic
from identify.reporting.pictures import Picture, pictures
from identify.reporting.report_sections import SECTIONS
from identify.reporting.run_data import RunData, read_run
from identify.reporting.tables import goals_table
from identify.reporting.verdict import key_numbers, verdict

TEMPLATES = Path(__file__).parent / "templates"

FIRST_LOOK = ("scene", "errors")  # names of the pictures beside the verdict
# Largest width and height of an image on the page. The separate PNG file has all pixels.
WIDEST_PX = 1500
QUALITY = 85  # quality of an image on the page, on the scale of WebP

# Figures are drawn in the colours of the palette. The page replaces these by CSS variables.
_NAMES = {code: name for name, code in PALETTE.items()}
_CODES = re.compile("|".join(_NAMES))


def write_report(
    folder: Path | str,
    progress: Progress | None = None,
    further: Callable[[], dict[Path, bytes]] = dict,
) -> Path:
    """Write the report and the figures of a run folder, and return the path of the report.

    The files are ``report.html``, ``figures/*.png`` and ``figures/*.pdf``. Either all or none of
    them are written. ``further`` is called after all is drawn, and returns more files to write.

    Raises OutputFolderError if an earlier stage has not been run. Raises RecordError if a file of
    the run is damaged. Raises WriteError if a file cannot be written.
    """
    run = RunFolder(Path(folder))
    data = read_run(run)
    shown = pictures(data)
    drawings = {}
    files: dict[Path, bytes] = {}
    # Everything is drawn before anything is written: after a failure, the old report remains.
    with (progress or SilentProgress()).stage("report", len(shown) + 1) as advance:
        for name, picture in shown.items():
            figure = drawn(picture.draw)
            png = figure_bytes(figure, ".png")
            files[run.figures / f"{name}.png"] = png
            files[run.figures / f"{name}.pdf"] = figure_bytes(figure, ".pdf")
            # An SVG with many strokes would be larger than the image, and slow to display.
            drawings[name] = image_element(png) if picture.as_image else svg_text(figure, name)
            advance()
        files[run.report] = render(data, shown, drawings).encode()
        write_files(files | further(), parents=True)
        advance()
    return run.report


def render(data: RunData, shown: Mapping[str, Picture], drawings: Mapping[str, str]) -> str:
    """Return the report as one HTML text.

    ``drawings`` holds the pictures as HTML elements, by their names.
    """
    judgement = verdict(data.result, data.cameras_consistent)
    goals = check_goals(data.result)
    missed = [goal for goal in goals if not goal.passed]
    return (
        page_environment()
        .get_template("report.html.j2")
        .render(
            title=f"Identification of {data.robot}",
            subtitle=_subtitle(data.result),
            verdict=judgement,
            numbers=key_numbers(data.result),
            goals=goals_table(data.result),
            missed=len(missed),
            advices=advices(missed, data.result, data.folder),
            goal_count=len(goals),
            **{
                kind: [_sentence(text) for text in data.result["identification"].get(kind, [])]
                for kind in ("notes", "warnings")
            },
            first_look=[name for name in FIRST_LOOK if name in shown],
            sections=[build(data) for build in SECTIONS],
            pictures=shown,
            drawings={
                n: text if shown[n].as_image else _coloured(text) for n, text in drawings.items()
            },
            paper=paper,
        )
    )


def page_environment() -> jinja2.Environment:
    """Return the environment in which the templates of pages are rendered."""
    # The texts come from files, and can have characters with a meaning in HTML.
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def picture_elements(shown: Mapping[str, Picture]) -> dict[str, str]:
    """Draw pictures, and return them as HTML elements by their names."""
    elements = {}
    for name, picture in shown.items():
        figure = drawn(picture.draw)
        # An SVG with many strokes would be larger than the image, and slow to display.
        elements[name] = (
            image_element(figure_bytes(figure, ".png"))
            if picture.as_image
            else _coloured(svg_text(figure, name))
        )
    return elements


def image_element(png: bytes) -> str:
    """Return an <img> element with a PNG image, reduced in size and quality for a page."""
    stream = io.BytesIO()
    with Image.open(io.BytesIO(png)) as image:
        reduced = image.convert("RGB")
        reduced.thumbnail((WIDEST_PX, WIDEST_PX))
        reduced.save(stream, "webp", quality=QUALITY)
    width, height = reduced.size
    data = base64.b64encode(stream.getvalue()).decode()
    return f'<img alt="" width="{width}" height="{height}" src="data:image/webp;base64,{data}">'


def _subtitle(result: Mapping[str, Any]) -> str:
    """Return the name of the scenario and, for a simulated run, the seed."""
    seed = result.get("seed")
    return f"scenario {result.get('scenario')}" + ("" if seed is None else f", seed {seed}")


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{typographic(text[1:])}."


def _coloured(element: str) -> str:
    """Return an <svg> element with variables of the page for colours, and without a fixed size.

    Screen readers skip the element, because the caption describes the figure.
    """
    # CSS variables work in a style, but not in an attribute of SVG.
    text = re.sub(r'\sfill="(#[0-9a-f]{6})"', r' style="fill: \g<1>"', element)
    text = _CODES.sub(lambda code: f"var(--{_NAMES[code[0]]})", text)
    head, _, rest = text.partition(">")
    # Without a fixed size, the drawing scales to the width of the page.
    return re.sub(r'\s(width|height)="[^"]*"', "", head) + f' aria-hidden="true">{rest}'
