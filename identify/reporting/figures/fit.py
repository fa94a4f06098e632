"""Figures that show how well models follow the robot.

They show each component over a run, a summary of a run, and all validation runs.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator

from identify.arrays import Array
from identify.files.run_folder import actual_row, predicted_row, rms_figures, rms_row
from identify.reporting.figures.style import (
    BLUE,
    COLUMN,
    COMPONENTS,
    GREEN,
    GREY,
    INK,
    LINES,
    PAPER,
    RED,
    UNITS,
    WIDTH,
    legend_above,
    moving,
)
from identify.reporting.number_format import significant

# Half width of the band in which the true errors are expected, in standard deviations. It contains
# 95 % of them.
BAND = 2.0

BAND_NAME = f"expected ± {BAND:g} standard deviations"

# Smallest number of measured poses to draw of a longer run. The errors below have every frame.
MARKS = 40


class Curve(NamedTuple):
    """Values (N,) over time in the unit of their panel, with the style of their line."""

    name: str
    values: Array
    drawn: dict[str, Any]


STARTING: dict[str, Any] = {"color": GREEN, "linestyle": (0, (4, 2)), "linewidth": 1.0}
IDENTIFIED: dict[str, Any] = {"color": BLUE, "linestyle": "-"}
MEASURED: dict[str, Any] = {
    "color": INK,
    "linestyle": "none",
    "marker": "o",
    "markersize": 2.4,
    "fillstyle": "none",
}
NOISE: dict[str, Any] = {"color": GREY, "linestyle": "-", "linewidth": 0.4}
TRUE: dict[str, Any] = {"color": RED, "linestyle": "-", "linewidth": 1.4}


@dataclass(frozen=True)
class Fit:
    """Measured and modelled poses (N, 6) of a run, m and rad.

    Poses are NaN if a measurement was lost or a model has diverged.

    Attributes
    ----------
    time
        Times (N,), s.
    measured, identified, initial, truth
        Measured poses, poses of the identified and of the initial model, and true poses.
    predicted, std
        Predicted poses (N, 6), and the expected standard deviation (N, 6) of the true poses about
        them. Predicted poses also contain the estimated errors that all frames share.
    noise
        Standard deviation (6,) of one measured pose according to the sensor.
    """

    time: Array
    measured: Array
    identified: Array
    initial: Array | None = None
    truth: Array | None = None
    predicted: Array | None = None
    std: Array | None = None
    noise: Array | None = None

    def pose_curves(self, i: int) -> list[Curve]:
        """Return measurement and models of component i, in mm or mrad."""
        marked = MEASURED | {"markevery": max(1, len(self.time) // MARKS)}
        curves = [
            ("measured", self.measured, marked),
            ("identified model", self.identified, IDENTIFIED),
        ]
        if self.initial is not None:
            curves.insert(1, ("initial model", self.initial, STARTING))
        return [Curve(name, 1e3 * poses[:, i], drawn) for name, poses, drawn in curves]

    def error_curves(self, i: int) -> list[Curve]:
        """Return the errors of the identified model in component i, in µm or µrad.

        They are the measurement and, if it is known, the truth, each minus the identified model.
        """
        curves = [
            Curve("measured − identified", 1e6 * (self.measured - self.identified)[:, i], NOISE)
        ]
        if self.truth is not None:
            curves.append(
                Curve("true − identified", 1e6 * (self.truth - self.identified)[:, i], TRUE)
            )
        return curves

    def pose_range(self, i: int) -> tuple[float, float]:
        """Return the range of the measurement in mm or mrad, extended to show the models.

        The extension is limited to half of the range on either side, because an unstable model
        would otherwise hide everything else.
        """
        curves = [curve.values for curve in self.pose_curves(i)]
        measured, *models = [values[np.isfinite(values)] for values in curves]
        # A component that does not move has no range: show one unit around it.
        low = measured.min()
        high = measured.max()
        reach = (high - low) / 2 or 1.0
        every = np.concatenate([measured, *models])
        low = max(low - reach, every.min())
        high = min(high + reach, every.max())
        margin = 0.05 * (high - low) or 1.0
        return low - margin, high + margin

    def rms_text(self, i: int) -> str:
        """Format the RMS of the models against the measurement in component i."""
        # Lost frames do not count, but a model that has diverged does.
        counted = np.isfinite(self.measured).all(axis=1)
        models = [model for model in (self.initial, self.identified) if model is not None]
        values = [rms_row(rms_figures(self.measured - model, counted))[i] for model in models]
        shown = [significant(value) if np.isfinite(value) else "diverged" for value in values]
        return f"RMS {' → '.join(shown)} {UNITS[i]}"

    def distances(self, first: int) -> list[Curve]:
        """Return the norms of the errors in position (first = 0) [µm] or orientation (3) [µrad].

        The errors are those of both models and of the measurement against the truth. If the truth
        is not known, they are those of the models against the measurement.
        """
        if self.truth is None:
            reference = self.measured
            suffix = ", against the measurement"
        else:
            reference = self.truth
            suffix = ""
        poses: dict[str, tuple[Array | None, dict[str, Any]]] = {
            f"initial model{suffix}": (self.initial, STARTING),
            f"identified model{suffix}": (self.identified, IDENTIFIED),
        }
        if self.truth is not None:
            poses = {"measured poses": (self.measured, NOISE)} | poses
        return [
            Curve(
                name, 1e6 * np.linalg.norm((model - reference)[:, first : first + 3], axis=1), drawn
            )
            for name, (model, drawn) in poses.items()
            if model is not None
        ]


def fit_figure(fit: Fit) -> Figure:
    """Draw the measured poses and both models, with the errors below each component.

    The figure corresponds to figures 12 and 13 of the paper.
    """
    shown = moving(fit.identified)
    rows = -(-len(shown) // 3)
    figure = Figure(figsize=(WIDTH, 0.6 + 3.3 * rows), layout="constrained")
    axes = figure.subplots(2 * rows, 3, sharex=True, squeeze=False)
    for panel in axes.ravel()[2 * len(shown) :]:
        panel.set_visible(False)
    for place, i in enumerate(shown):
        above = axes[2 * (place // 3), place % 3]
        below = axes[2 * (place // 3) + 1, place % 3]
        _draw(above, fit.time, fit.pose_curves(i))
        above.set_ylim(*fit.pose_range(i))
        above.set_title(f"({'abcdef'[place]}) {COMPONENTS[i]}")
        above.set_ylabel(f"{COMPONENTS[i]} [{'mm' if i < 3 else 'mrad'}]")
        _draw(below, fit.time, fit.error_curves(i))
        if fit.predicted is not None and fit.std is not None:
            middle = 1e6 * (fit.predicted - fit.identified)[:, i]
            ends = middle[:, None] + BAND * 1e6 * np.outer(fit.std[:, i], (-1, 1))
            below.plot(fit.time, ends, color=RED, linestyle=":", linewidth=0.9)
            below.lines[-1].set_label(BAND_NAME)
        below.set_title(fit.rms_text(i), fontsize=7)
        below.set_ylabel(f"error of {COMPONENTS[i]} [{UNITS[i]}]")
    for panel in axes[-1]:
        panel.set_xlabel("time [s]")
    _legend_of(figure, (axes[0, 0], axes[1, 0]))
    return figure


def error_figure(fit: Fit) -> Figure:
    """Draw a summary of the errors of both models over a run.

    If the truth is known, the errors of models and measurement are against it. Otherwise, the
    errors of the models are relative to the measurement, and the noise of the cameras is shown.
    """
    parts = [
        first for first in (0, 3) if any(first <= i < first + 3 for i in moving(fit.identified))
    ]
    figure = Figure(
        figsize=(COLUMN, 0.9 + (1.4 if len(parts) > 1 else 2.4) * len(parts)), layout="constrained"
    )
    panels = figure.subplots(len(parts), 1, sharex=True, squeeze=False)[:, 0]
    for axes, first in zip(panels, parts, strict=True):
        _draw(axes, fit.time, fit.distances(first))
        if fit.truth is None and fit.noise is not None:
            # The curves are lengths of error vectors; this level is the length of the noise.
            level = 1e6 * float(np.linalg.norm(fit.noise[first : first + 3]))
            axes.axhline(level, color=GREY, linestyle=":", label="noise of one measured pose")
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(numticks=12))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.set_ylabel("position [µm]" if first == 0 else "orientation [µrad]")
        # An error near zero would stretch the logarithmic axis without limit.
        values = np.concatenate(
            [curve.values[np.isfinite(curve.values)] for curve in fit.distances(first)[-2:]]
        )
        low = 1e-3
        if (values > 0).any():
            low = max(float(np.quantile(values[values > 0], 0.01)), low)
        axes.set_ylim(bottom=low / 2)
    panels[-1].set_xlabel("time [s]")
    legend_above(figure, panels[0], columns=1)
    return figure


def _draw(axes: Axes, time: Array, curves: Sequence[Curve]) -> None:
    for curve in curves:
        axes.plot(time, curve.values, label=curve.name, **curve.drawn)


def _legend_of(figure: Figure, panels: Sequence[Axes]) -> None:
    """Draw one legend above several panels."""
    entries = {
        label: handle
        for axes in panels
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        list(entries.values()), list(entries), loc="outside upper left", ncols=2, handlelength=3.0
    )


HATCHES = ("", "////", "xxxx")  # patterns of the three bars of a run, distinct without colour


def validation_figure(result: dict[str, Any]) -> Figure:
    """Draw the actual and the expected distance of the true robot from the predicted poses.

    Bars are the actual RMS distances on each validation trajectory, and diamonds the expected ones.
    The measured poses minus the identified model are drawn as well. The limits of the goals are
    not, as they can be about other poses.
    """
    validation = result["validation"]
    figure = Figure(figsize=(WIDTH, 5.0), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True)
    runs = np.arange(1, len(validation) + 1)
    for axes, first in zip(panels, (0, 3), strict=True):
        for i in range(first, first + 3):
            actual = [actual_row(run)[i] for run in validation]
            measured = [rms_row(run["measured"])[i] for run in validation]
            predicted = [predicted_row(run)[i] for run in validation]
            # Three bars per run, side by side: x, y, z or α, β, γ.
            places = runs + 0.25 * (i - first - 1)
            look = {
                "edgecolor": LINES[i]["color"],
                "facecolor": PAPER if i % 3 else LINES[i]["color"],
            }
            axes.bar(
                places,
                actual,
                0.2,
                hatch=HATCHES[i % 3],
                label=f"{COMPONENTS[i]}, actual",
                **look,
            )
            # Marks of all three components look the same, and need only one entry in the legend.
            labelled = i == first
            axes.plot(
                places,
                measured,
                "_",
                color=INK,
                markersize=9,
                label="measured − identified" if labelled else None,
            )
            axes.plot(
                places,
                predicted,
                "D",
                color=INK,
                fillstyle="none",
                label="expected" if labelled else None,
            )
        axes.set_ylabel(f"RMS of {'position' if first == 0 else 'orientation'} [{UNITS[first]}]")
        # On a narrow screen, a legend at the right would be out of sight.
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)
        axes.grid(visible=False, axis="x")
    panels[1].set_xlabel("validation trajectory")
    panels[1].set_xticks(runs)
    return figure
