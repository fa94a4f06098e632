"""Figures like the paper's 11, 12 and 13 and those of the errors, for print (PNG), with units on every axis."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from identify.arrays import Array
from identify.files.run_folder import predicted_row, rms_figures, rms_row
from identify.reporting.goals import VALIDATION_UM, VALIDATION_URAD, is_friction_or_pid

COMPONENTS = ("x", "y", "z", "α", "β", "γ")
LETTERS = ("(a)", "(b)", "(c)", "(d)", "(e)", "(f)")
BAND = 2.0
"""Predicted standard deviations drawn around an error of zero: 95 % of true errors lie within."""

MEASURED, INITIAL, IDENTIFIED, TRUE = "black", "tab:green", "tab:blue", "tab:red"


def excitation_figure(time: Array, poses: Array, title: str = "Exciting trajectory") -> Figure:
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
    upper.set_title(f"{title}\n(a) position")
    lower.set_title("(b) orientation")
    lower.set_xlabel("time [s]")
    return figure


def fit_figure(
    time: Array,
    measured: Array,
    initial: Array | None,
    identified: Array,
    title: str,
    truth: Array | None = None,
    std: Array | None = None,
) -> Figure:
    """Measured (black dots), starting (green) and identified (blue) model, with the errors below; like figure 12, 13.

    Poses are (N, 6) [m, rad]; NaN where a measurement was lost or a model has diverged. Where the ``truth`` is given,
    the model's error against it is drawn in red, and where ``std`` (N, 6) is, the band of ± 2 predicted deviations.
    """
    figure = Figure(figsize=(13, 12), layout="constrained")
    axes = figure.subplots(4, 3, sharex=True)
    for i in range(6):
        _fit_panel(axes[i // 3, i % 3], time, measured, initial, identified, i)
        _error_panel(axes[2 + i // 3, i % 3], time, measured, initial, identified, truth, std, i)
    for column in range(3):
        axes[3, column].set_xlabel("time [s]")
    axes[0, 0].legend(loc="upper right", fontsize="small")
    axes[2, 0].legend(loc="upper right", fontsize="small")
    figure.suptitle(title)
    return figure


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
    shown = {name: p for name, p in parameters.items() if p["identifiable"] and p["true"] and p["estimate"] is not None}
    groups = (
        ("friction and joint controller", [n for n in shown if is_friction_or_pid(n)]),
        ("mass and inertia", [n for n in shown if not is_friction_or_pid(n)]),
    )
    figure = Figure(figsize=(11, max(5.0, 0.28 * max(len(names) for _, names in groups))), layout="constrained")
    for axes, (title, names) in zip(figure.subplots(1, 2), groups, strict=True):
        true = np.array([abs(shown[n]["true"]) for n in names])
        error = np.array([shown[n]["estimate"] - shown[n]["true"] for n in names])
        bars = np.array([interval_bars(shown[n]) for n in names]).reshape(-1, 2).T
        rows = np.arange(len(names))
        axes.axvspan(-5, 5, color="tab:green", alpha=0.1)
        axes.axvline(0, color="black", linewidth=1)
        axes.errorbar(100 * error / true, rows, xerr=100 * bars / true, fmt="o", color=IDENTIFIED, capsize=3)
        axes.set_yticks(rows, names, fontsize="small")
        axes.invert_yaxis()
        axes.set_xlabel("estimate − truth, bars: 95 % interval [%]")
        axes.set_title(title)
        axes.grid(alpha=0.3, axis="x")
    return figure


def interval_bars(parameter: dict[str, Any]) -> tuple[float, float]:
    """How far an entry's interval goes below and above its estimate; zeros where it has none."""
    low, high = parameter.get("interval") or (parameter["estimate"], parameter["estimate"])
    return parameter["estimate"] - low, high - parameter["estimate"]


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


def _fit_panel(axes: Axes, time: Array, measured: Array, initial: Array | None, identified: Array, i: int) -> None:
    unit = "mm" if i < 3 else "mrad"
    axes.plot(time, 1e3 * measured[:, i], ".", color=MEASURED, markersize=2.5, label="measured")
    bottom, top = axes.get_ylim()
    if initial is not None:
        axes.plot(time, 1e3 * initial[:, i], color=INITIAL, linewidth=1, label="starting model")
        half = (top - bottom) / 2  # an unstable starting model must not hide the rest
        low, high = axes.get_ylim()
        axes.set_ylim(max(low, bottom - half), min(high, top + half))
    axes.plot(time, 1e3 * identified[:, i], color=IDENTIFIED, linewidth=1, label="identified model")
    axes.set_title(f"{LETTERS[i]} {COMPONENTS[i]}")
    axes.set_ylabel(f"{COMPONENTS[i]} [{unit}]")
    axes.grid(alpha=0.3)


def _error_panel(
    axes: Axes,
    time: Array,
    measured: Array,
    initial: Array | None,
    identified: Array,
    truth: Array | None,
    std: Array | None,
    i: int,
) -> None:
    unit = "um" if i < 3 else "urad"
    error = 1e6 * (measured - identified)[:, i]
    axes.plot(time, error, ".", color=MEASURED, markersize=2, label="measured − identified")
    if truth is not None:
        axes.plot(time, 1e6 * (truth - identified)[:, i], color=TRUE, linewidth=1, label="true − identified")
    if std is not None:
        band = BAND * 1e6 * std[:, i]
        axes.fill_between(time, -band, band, color=TRUE, alpha=0.15, linewidth=0, label=f"predicted ± {BAND:g} std")
    axes.set_title(f"error, {_rms_text(measured, initial, identified, i)}", fontsize="small")
    axes.set_ylabel(f"error of {COMPONENTS[i]} [{unit}]")
    axes.grid(alpha=0.3)


def _rms_text(measured: Array, initial: Array | None, identified: Array, i: int) -> str:
    def rms(model: Array) -> str:
        value = rms_row(rms_figures(measured - model, np.isfinite(measured).all(axis=1)))[i]
        return f"{value:.3g} {'um' if i < 3 else 'urad'}" if np.isfinite(value) else "diverged"

    before = "" if initial is None else f"{rms(initial)} → "
    return f"RMS {before}{rms(identified)}"
