"""Figure of a geometric calibration from static poses."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from identify.reporting.figures.style import BLUE, GREY, RED, WIDTH

ROOM = 20.0  # factor by which the upper end of an axis is raised, to make room for the legend


def geometry_figure(entry: Mapping[str, Any]) -> Figure:
    """Draw the content of a geometry.json.

    A panel shows the standard deviation of each geometric parameter and, if the truth is known, its
    error. If the expected error at validation poses was computed, a second panel shows this
    error against the number of measured poses, for random and for chosen poses.
    """
    several = "random_poses" in entry
    figure = Figure(figsize=(WIDTH, 3.0), layout="constrained")
    panels = np.atleast_1d(
        figure.subplots(1, 1 + several, width_ratios=(3, 2) if several else None)
    )
    _numbers(panels[0], entry["parameters"])
    if several:
        _by_count(panels[1], entry)
    return figure


def _numbers(axes: Axes, parameters: Mapping[str, Mapping[str, Any]]) -> None:
    """Draw standard deviations and errors, relative to the tolerance.

    There is one column per kind of parameter, and one point per leg.
    """
    kinds = list(dict.fromkeys(name.partition(".")[2] for name in parameters))
    legs = list(dict.fromkeys(name.partition(".")[0] for name in parameters))
    # The points of the legs are spread over 0.6 of the width of a column.
    xs = [
        kinds.index(name.partition(".")[2])
        + 0.6 * (legs.index(name.partition(".")[0]) / len(legs) - 0.4)
        for name in parameters
    ]
    rows = parameters.values()
    # An error of zero cannot be drawn on a logarithmic axis.
    missed = [
        (x, p)
        for x, p in zip(xs, rows, strict=True)
        if p["true"] is not None and p["estimate"] != p["true"]
    ]
    known = [(x, abs(p["estimate"] - p["true"]) / p["tolerance"]) for x, p in missed]
    axes.plot(
        xs, [p["std"] / p["tolerance"] for p in rows], "o", color=BLUE, label="standard deviation"
    )
    if known:
        axes.plot(*zip(*known, strict=True), "x", color=RED, label="error")
    # A parameter counts as determined if its standard deviation is below a third of the tolerance.
    axes.axhline(1 / 3, color=GREY, linewidth=0.8, linestyle="--")
    axes.annotate(
        "determined below",
        (1, 1 / 3),
        xycoords=("axes fraction", "data"),
        color=GREY,
        ha="right",
        va="bottom",
    )
    axes.set_yscale("log")
    axes.set_xticks(range(len(kinds)), kinds, rotation=40, ha="right", rotation_mode="anchor")
    axes.set_ylabel("share of the tolerance [1]")
    axes.set_title("geometric numbers, one point per leg")
    axes.grid(visible=False, axis="x")
    axes.legend(loc="lower right")


def _by_count(axes: Axes, entry: Mapping[str, Any]) -> None:
    """Draw the expected error at validation poses against the number of random and chosen poses."""
    random = entry["random_poses"]
    chosen = entry["selection"]["chosen"]
    for key, unit, color, line in (
        ("position_rms_um", "position [µm]", BLUE, "-"),
        ("orientation_rms_urad", "orientation [µrad]", RED, "--"),
    ):
        # There are random sets of several sizes, and one chosen set.
        counts = [one["poses"] for one in random]
        values = [_rms(one[key]) for one in random]
        axes.plot(counts, values, line, color=color, label=f"random poses, {unit}")
        axes.plot(
            [chosen["poses"]], [_rms(chosen[key])], "o", color=color, label=f"chosen poses, {unit}"
        )
    axes.set_yscale("log")
    axes.set_ylim(top=axes.get_ylim()[1] * ROOM)
    axes.set_xlabel("number of poses")
    axes.set_title("expected error at validation poses")
    axes.legend(loc="upper right")


def _rms(values: list[float]) -> float:
    """Return the RMS over the components that the platform has."""
    return float(np.sqrt(np.mean(np.square(values))))
