"""Style of all figures.

Sizes and fonts are those for print. Every curve has its own line style or marker, so that curves
also differ without colour. A report replaces the colours by colours of the reader's screen. Its
figures must therefore use only the colours of `PALETTE`.
"""

import io
import re
from collections.abc import Callable
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from identify.arrays import Array

WIDTH = 7.1  # width of both columns of a journal's page, in inches
COLUMN = 3.5  # width of one column, in inches

PALETTE = {
    "ink": "#000000",
    "paper": "#ffffff",
    "grey": "#5f6368",
    "line": "#d4d4d4",
    "blue": "#0067a5",
    "red": "#b84a00",
    "green": "#00704f",
    "wine": "#8a2258",
    "amber": "#7a6000",
    "indigo": "#3b2a94",
}
INK, PAPER, GREY, LINE, BLUE, RED, GREEN, WINE, AMBER, INDIGO = PALETTE.values()

STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "axes.titlesize": 8.5,
    "axes.titlelocation": "left",
    "axes.labelsize": 8,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": LINE,
    "grid.linewidth": 0.5,
    "xtick.color": INK,
    "ytick.color": INK,
    "lines.linewidth": 1.1,
    "lines.markersize": 3.5,
    "hatch.linewidth": 0.6,
    # Hinted letters have other widths at each dpi, and a layout would hold for one dpi alone.
    "text.hinting": "none",
    # Text is stored as text, which can be searched and copied.
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
}

COMPONENTS = ("x", "y", "z", "α", "β", "γ")
UNITS = ("µm", "µm", "µm", "µrad", "µrad", "µrad")
# Line styles of the components of a pose.
LINES: tuple[dict[str, Any], ...] = (
    {"color": BLUE, "linestyle": "-"},
    {"color": RED, "linestyle": "--"},
    {"color": GREEN, "linestyle": "-."},
    {"color": WINE, "linestyle": "-"},
    {"color": AMBER, "linestyle": "--"},
    {"color": INDIGO, "linestyle": "-."},
)

STANDS = 1e-9  # movement of panels, as a fraction of a figure, below which its layout has settled
STILL = 1e-9  # range, m or rad, below which a component counts as not moving


def drawn(draw: Callable[[], Figure]) -> Figure:
    """Draw a figure in this style, and compute its layout once for all of its files."""
    with mpl.rc_context(STYLE):
        figure = draw()
        # Layout engines move the axes at every drawing, so that the files would differ.
        engine = figure.get_layout_engine()
        if engine:
            # A layout can change the ticks, and the next one makes room for their labels.
            places = np.empty(0)
            for _ in range(3):
                engine.execute(figure)
                before, places = places, np.array([one.get_position() for one in figure.axes])
                if before.shape == places.shape and np.abs(places - before).max() < STANDS:
                    break
            # The engine "none" would still have every file drawn twice.
            figure.set_layout_engine(None)
        return figure


def svg_text(figure: Figure, name: str) -> str:
    """Return a figure as an <svg> element.

    Its identifiers begin with the name, so that several figures can be on one page.
    """
    with mpl.rc_context(STYLE | {"svg.hashsalt": name}):
        stream = io.StringIO()
        figure.savefig(stream, format="svg", transparent=True, metadata={"Date": None})
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text, flags=re.DOTALL)
    # Otherwise, identifiers of several figures on one page would collide.
    text = re.sub(r'(\sid="|href="#|url\(#)', rf"\g<1>{name}-", text)
    # Hundredths of a point are enough, and make a smaller file.
    text = re.sub(r"(\d\.\d\d)\d+", r"\g<1>", text)
    return re.sub(r"\s*\n\s*", "\n", text)


def moving(poses: Array) -> list[int]:
    """Return the indices of the components of poses (N, 6) [m, rad] that move. NaN is ignored."""
    return [i for i in range(6) if np.nanmax(poses[:, i]) - np.nanmin(poses[:, i]) > STILL]


def panel_grid(
    count: int, width: float, height: float, above: float = 0.0, **shared: Any
) -> tuple[Figure, list[Axes]]:
    """Return a figure with ``count`` panels, three per row.

    count          Number of panels.
    width, height  Size of a panel, in inches.
    above          Space for a title above the panels, in inches.
    **shared       Arguments of `matplotlib.figure.Figure.subplots`.
    """
    columns = min(count, 3)
    rows = -(-count // columns)
    figure = Figure(figsize=(width * columns, above + height * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, **shared).ravel().tolist()
    for axes in panels[count:]:
        axes.set_visible(False)
    return figure, panels[:count]


def legend_above(figure: Figure, axes: Axes, columns: int = 4) -> None:
    """Draw the legend of one panel above all panels."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=columns, handlelength=3.0)
