"""What the figures of a run show, and the figures themselves for print (PNG): the paper's 11, 12, 13 and the errors.

The report draws the same with plotly (`report_plots`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from identify.arrays import Array
from identify.files.run_folder import predicted_row, rms_figures, rms_row
from identify.reporting.goals import VALIDATION_UM, VALIDATION_URAD, is_friction_or_pid

COMPONENTS = ("x", "y", "z", "α", "β", "γ")
LETTERS = ("(a)", "(b)", "(c)", "(d)", "(e)", "(f)")
BLACK, GREEN, BLUE, RED = "black", "#2ca02c", "#1f77b4", "#d62728"

BAND = 2.0
"""Predicted standard deviations drawn around an error of zero: 95 % of true errors lie within."""

BAND_NAME = f"predicted ± {BAND:g} std"


def panel_grid(count: int, width: float, height: float, above: float = 0.0, **shared: Any) -> tuple[Figure, list[Axes]]:
    """A figure with so many panels of that size, inches, three beside each other, and room above them for a title."""
    columns = min(count, 3)
    rows = -(-count // columns)
    figure = Figure(figsize=(width * columns, above + height * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, **shared).ravel().tolist()
    for axes in panels[count:]:
        axes.set_visible(False)
    return figure, panels[:count]


class Curve(NamedTuple):
    """Values (N,) over time in the unit of their panel, as dots or as a line."""

    name: str
    values: Array
    colour: str
    dots: bool = False


@dataclass(frozen=True)
class Fit:
    """What was measured of a run over its time (N,) [s], and what models do: poses (N, 6) [m, rad].

    NaN where a measurement was lost or a model has diverged. initial: of the starting model; std: predicted deviation
    of the truth from the identified model.
    """

    time: Array
    measured: Array
    identified: Array
    initial: Array | None = None
    truth: Array | None = None
    std: Array | None = None

    def pose_curves(self, i: int) -> list[Curve]:
        """Component i, in mm or mrad: measurement and models."""
        curves = [("measured", self.measured, BLACK, True), ("identified model", self.identified, BLUE, False)]
        if self.initial is not None:
            curves.insert(1, ("starting model", self.initial, GREEN, False))
        return [Curve(name, 1e3 * poses[:, i], colour, dots) for name, poses, colour, dots in curves]

    def error_curves(self, i: int) -> list[Curve]:
        """Errors of the identified model in component i, in um or urad, against measurement and truth."""
        curves = [Curve("measured − identified", 1e6 * (self.measured - self.identified)[:, i], BLACK, dots=True)]
        if self.truth is not None:
            curves.append(Curve("true − identified", 1e6 * (self.truth - self.identified)[:, i], RED))
        return curves

    def pose_range(self, i: int) -> tuple[float, float]:
        """Range of the measurement, widened for the models by half at most: an unstable one must not hide the rest."""
        measured, *models = (curve.values[np.isfinite(curve.values)] for curve in self.pose_curves(i))
        low, high = measured.min(), measured.max()
        reach, every = (high - low) / 2 or 1.0, np.concatenate([measured, *models])
        low, high = max(low - reach, every.min()), min(high + reach, every.max())
        margin = 0.05 * (high - low) or 1.0
        return low - margin, high + margin

    def rms_text(self, i: int) -> str:
        """RMS of the models against the measurement in component i."""
        counted = np.isfinite(self.measured).all(axis=1)
        models = [model for model in (self.initial, self.identified) if model is not None]
        values = [rms_row(rms_figures(self.measured - model, counted))[i] for model in models]
        unit = "um" if i < 3 else "urad"
        return "RMS " + " → ".join(f"{value:.3g} {unit}" if np.isfinite(value) else "diverged" for value in values)


class RelativeErrors(NamedTuple):
    """Names, and in per cent of the truth: error and reach of the 95 % interval below and above the estimate, (n,)."""

    names: list[str]
    error: Array
    below: Array
    above: Array


def relative_errors(parameters: dict[str, dict[str, Any]]) -> RelativeErrors:
    """Of the identifiable parameters of a result whose truth is known; no reach where there is no interval."""
    shown = {n: p for n, p in parameters.items() if p["identifiable"] and p["true"] and p["estimate"] is not None}
    rows = [(p["true"], p["estimate"], *(p.get("interval") or 2 * [p["estimate"]])) for p in shown.values()]
    true, estimate, low, high = np.array(rows, dtype=float).reshape(-1, 4).T
    percent = 100 / np.abs(true)
    return RelativeErrors(
        list(shown), percent * (estimate - true), percent * (estimate - low), percent * (high - estimate)
    )


def excitation_figure(time: Array, poses: Array) -> Figure:
    """Position and orientation of a trajectory: ``time`` (N,) [s], ``poses`` (N, 6) [m, rad]; like figure 11."""
    figure = Figure(figsize=(8, 6), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    panels = ((upper, range(3), "position from start [mm]"), (lower, range(3, 6), "orientation from start [mrad]"))
    for axes, columns, label in panels:
        for i in columns:
            axes.plot(time, 1e3 * (poses[:, i] - poses[0, i]), label=COMPONENTS[i])
        axes.set_ylabel(label)
        axes.legend(loc="upper right")
        axes.grid(alpha=0.3)
    upper.set_title("Exciting trajectory\n(a) position")
    lower.set_title("(b) orientation")
    lower.set_xlabel("time [s]")
    return figure


def fit_figure(fit: Fit, title: str) -> Figure:
    """Measured (black dots), starting (green) and identified (blue) model, errors below; like figure 12, 13."""
    figure = Figure(figsize=(13, 12), layout="constrained")
    axes = figure.subplots(4, 3, sharex=True)
    for i in range(6):
        above, below = axes[i // 3, i % 3], axes[2 + i // 3, i % 3]
        _draw(above, fit.time, fit.pose_curves(i))
        above.set_ylim(*fit.pose_range(i))
        above.set_title(f"{LETTERS[i]} {COMPONENTS[i]}")
        above.set_ylabel(f"{COMPONENTS[i]} [{'mm' if i < 3 else 'mrad'}]")
        _draw(below, fit.time, fit.error_curves(i))
        if fit.std is not None:
            band = BAND * 1e6 * fit.std[:, i]
            below.fill_between(fit.time, -band, band, color=RED, alpha=0.15, linewidth=0, label=BAND_NAME)
        below.set_title(f"error, {fit.rms_text(i)}", fontsize="small")
        below.set_ylabel(f"error of {COMPONENTS[i]} [{'um' if i < 3 else 'urad'}]")
    for panel in axes[3]:
        panel.set_xlabel("time [s]")
    for panel in axes[::2, 0]:
        panel.legend(loc="upper right", fontsize="small")
    figure.suptitle(title)
    return figure


SIZES: dict[str, Any] = {"markersize": 2.5, "linewidth": 1}


def _draw(axes: Axes, time: Array, curves: Sequence[Curve]) -> None:
    for curve in curves:
        axes.plot(time, curve.values, "." if curve.dots else "-", color=curve.colour, label=curve.name, **SIZES)
    axes.grid(alpha=0.3)


def validation_figure(validation: list[dict[str, Any]]) -> Figure:
    """RMS of the identified model on each unseen trajectory, against truth and measurement, with what was predicted and
    the goals."""
    figure = Figure(figsize=(11, 7), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True)
    runs = np.arange(1, len(validation) + 1)
    for axes, first, limit, unit in ((panels[0], 0, VALIDATION_UM, "um"), (panels[1], 3, VALIDATION_URAD, "urad")):
        for i in range(3):
            true = [rms_row(run["true"])[first + i] for run in validation]
            measured = [rms_row(run["measured"])[first + i] for run in validation]
            bars = axes.bar(runs + 0.25 * (i - 1), true, 0.22, label=f"{COMPONENTS[first + i]}, against truth")
            axes.plot(runs + 0.25 * (i - 1), measured, "_", color=bars.patches[0].get_facecolor(), markersize=12)
            predicted = [predicted_row(run)[first + i] for run in validation]
            axes.plot(runs + 0.25 * (i - 1), predicted, "kd", markersize=4, markerfacecolor="none")
        axes.axhline(limit, color="black", linestyle="--", linewidth=1, label=f"goal {limit:g} {unit}")
        axes.set_ylabel(f"RMS [{unit}]")
        axes.legend(fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0))
        axes.grid(alpha=0.3, axis="y")
    panels[0].set_title("Identified model on unseen trajectories (dashes: against measurement; diamonds: predicted)")
    panels[1].set_xlabel("unseen trajectory")
    panels[1].set_xticks(runs)
    return figure


def parameter_figure(parameters: dict[str, dict[str, Any]]) -> Figure:
    """Relative error of every identifiable parameter with its 95 % interval, friction and gains apart."""
    groups = {
        "friction and joint controller": {n: p for n, p in parameters.items() if is_friction_or_pid(n)},
        "mass and inertia": {n: p for n, p in parameters.items() if not is_friction_or_pid(n)},
    }
    shown = {title: relative_errors(group) for title, group in groups.items()}
    height = max(5.0, 0.28 * max(len(found.names) for found in shown.values()))
    figure = Figure(figsize=(11, height), layout="constrained")
    for axes, (title, found) in zip(figure.subplots(1, 2), shown.items(), strict=True):
        rows = np.arange(len(found.names))
        axes.axvspan(-5, 5, color=GREEN, alpha=0.1)
        axes.axvline(0, color="black", linewidth=1)
        axes.errorbar(found.error, rows, xerr=(found.below, found.above), fmt="o", color=BLUE, capsize=3)
        axes.set_yticks(rows, found.names, fontsize="small")
        axes.invert_yaxis()
        axes.set_xlabel("estimate − truth, bars: 95 % interval [%]")
        axes.set_title(title)
        axes.grid(alpha=0.3, axis="x")
    return figure


def correlation_figure(correlations: Array, names: Sequence[str]) -> Figure:
    """Correlations (n, n) of estimates as a coloured matrix; a line of text where nothing is identified."""
    side = max(5.0, 2.0 + 0.28 * len(names))
    figure = Figure(figsize=(side + 0.5, side), layout="constrained")
    axes = figure.subplots()
    if not names:
        axes.set_axis_off()
        axes.set_title("No parameter is identified: no correlations")
        return figure
    image = axes.imshow(correlations, cmap="RdBu_r", vmin=-1, vmax=1)
    axes.set_xticks(range(len(names)), names, rotation=90, fontsize="small")
    axes.set_yticks(range(len(names)), names, fontsize="small")
    axes.set_title("Correlation of the identified parameters")
    figure.colorbar(image, ax=axes, label="correlation [1]", shrink=0.8)
    return figure
