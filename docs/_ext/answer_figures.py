"""A picture of each kept answer: its figures against what the study varies, with their 95 %
bands."""

from textwrap import fill
from typing import Any

import matplotlib as mpl
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from identify.reporting.figures.style import STYLE, panel_grid
from identify.studies.figures import scale

PANEL, LETTERS = (3.0, 2.4), 24
"""Size of a panel, inches, and how many letters its height has room for."""

WIDE = 30.0
"""Ratio of the largest to the least value from which an axis over names is logarithmic."""

Middle = tuple[float, tuple[float, float] | None]
"""Mean or rms of a figure, and its band if there is one."""

Point = tuple[tuple[Any, ...], dict[str, Middle]]
"""Levels of the factors, and figures by name."""


def picture(points: list[Point], factors: list[str], shown: dict[str, str]) -> Figure:
    """A panel for each figure under its head in `shown`, against the factor with most levels; a
    curve for each setting of the others, which have these heads."""
    levels = [
        list(dict.fromkeys(setting[place] for setting, _ in points))
        for place in range(len(factors))
    ]
    along = max(range(len(factors)), key=lambda place: len(levels[place]))
    with mpl.rc_context(STYLE):
        figure, panels = panel_grid(len(shown), *PANEL)
        for axes, (name, head) in zip(panels, shown.items(), strict=True):
            curves: dict[tuple[Any, ...], list[Point]] = {}
            for setting, figures in points:
                if name in figures:
                    curves.setdefault(setting[:along] + setting[along + 1 :], []).append(
                        (setting, figures)
                    )
            for others, own in curves.items():
                said = ", ".join(str(level) for level in others)
                _curve(
                    axes,
                    [(setting[along], figures[name]) for setting, figures in own],
                    levels[along],
                    said,
                )
            if _names(levels[along]):
                _scale_over_names(axes, levels[along])
            else:
                scale(axes, pd.Series(levels[along]))
            axes.set_ylabel(fill(head.replace("`", ""), LETTERS))
            axes.set_xlabel(factors[along])
            if len(curves) > 1:
                axes.legend(
                    fontsize="small", title=", ".join(factors[:along] + factors[along + 1 :])
                )
    return figure


def _curve(axes: Axes, values: list[tuple[Any, Any]], levels: list[Any], label: str) -> None:
    """One curve over numbers; points over names."""
    names = _names(levels)
    at = [levels.index(level) if names else level for level, _ in values]
    middles = [middle for _, (middle, _) in values]
    bands = [band or (middle, middle) for _, (middle, band) in values]
    reach = [
        [max(middle - low, 0.0) for middle, (low, _) in zip(middles, bands, strict=True)],
        [max(high - middle, 0.0) for middle, (_, high) in zip(middles, bands, strict=True)],
    ]
    axes.errorbar(
        at,
        middles,
        reach,
        marker="o",
        markersize=4,
        capsize=2,
        ls="" if names else "-",
        label=label,
    )


def _scale_over_names(axes: Axes, names: list[Any]) -> None:
    """Shares of 100 % are told apart on a linear axis."""
    axes.set_xticks(range(len(names)), names, rotation=30, ha="right")
    low, high = axes.dataLim.intervaly
    if low > 0 and high > WIDE * low:
        axes.set_yscale("log")


def _names(levels: list[Any]) -> bool:
    return not all(isinstance(level, float | int) for level in levels)
