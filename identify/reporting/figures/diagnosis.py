"""Figure of a diagnosis: the share of the misfit that each cause explains."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from identify.reporting.figures.style import BLUE, GREY, LINE, RED, WIDTH

SHOWN = 10  # largest number of candidates that are drawn


def diagnosis_figure(entry: dict[str, Any]) -> Figure:
    """Draw the diagnosis in a result.

    The left panel shows the share of the misfit that each candidate alone explains. The right
    panel shows the misfit that remains as one finding after the other is fitted.
    """
    shown = entry["candidates"][:SHOWN]
    figure = Figure(figsize=(WIDTH, 0.9 + 0.2 * max(len(shown), 4)), layout="constrained")
    alone, remaining = figure.subplots(1, 2, width_ratios=(3, 2))
    rows = np.arange(len(shown))
    alone.barh(rows, [100 * one["share"] for one in shown], color=BLUE, height=0.6)
    alone.set_yticks(rows, [one["name"] for one in shown])
    alone.set(xlabel="explains alone [% of the misfit]", xlim=(0, 105))
    alone.invert_yaxis()
    names = ["no cause", *(f"+ {one['name']}" for one in entry["findings"])]
    misfit = 100 * (1 - np.cumsum([0.0, *(one["share"] for one in entry["findings"])]))
    steps = np.arange(len(names))
    remaining.barh(steps, np.maximum(misfit, 0.0), color=RED, height=0.6)
    remaining.axvline(0, color=GREY, linewidth=0.8)
    remaining.set_yticks(steps, names)
    remaining.set(xlabel="misfit left [%]", xlim=(0, 105))
    remaining.invert_yaxis()
    for axes in (alone, remaining):
        axes.grid(visible=True, axis="x", color=LINE)
        axes.grid(visible=False, axis="y")
    return figure
