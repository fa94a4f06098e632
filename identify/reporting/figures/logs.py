"""Figures of the telemetry of a run: times, motion, joints with their commands, and spectrum."""

import numpy as np
from matplotlib.figure import Figure

from identify.arrays import Array
from identify.reporting.figures.style import (
    BLUE,
    COMPONENTS,
    GREY,
    INK,
    LINE,
    LINES,
    RED,
    WIDTH,
    legend_above,
    panel_grid,
)

LENGTH, ANGLE = slice(0, 3), slice(3, 6)  # components of a pose


def interval_figure(pose_time: Array, command_time: Array) -> Figure:
    """Draw the intervals between the times of poses (N,) and of commands (M,), s, over the run."""
    figure = Figure(figsize=(WIDTH, 1.9), layout="constrained")
    axes = figure.subplots()
    for time, name, colour, marker in (
        (command_time, "commands", GREY, "x"),
        (pose_time, "poses", BLUE, "."),
    ):
        axes.plot(time[1:], 1e3 * np.diff(time), marker, color=colour, markersize=2.5, label=name)
    axes.set(xlabel="time [s]", ylabel="to the row before [ms]", ylim=(0, None))
    legend_above(figure, axes)
    return figure


def motion_figure(time: Array, poses: Array, gaps: Array, jumps: Array) -> Figure:
    """Draw measured poses (K, 6) over their times (K,), with gaps (G, 2) and jumps (J,), s."""
    figure = Figure(figsize=(WIDTH, 3.4), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True)
    for axes, kind, label in zip(
        panels,
        (LENGTH, ANGLE),
        ("position\nfrom the first [mm]", "angles\nfrom the first [mrad]"),
        strict=True,
    ):
        for begin, end in gaps:
            axes.axvspan(begin, end, color=LINE)
        for jump in jumps:
            axes.axvline(jump, color=RED, linewidth=0.8)
        for k in range(6)[kind]:
            axes.plot(time, 1e3 * (poses[:, k] - poses[0, k]), label=COMPONENTS[k], **LINES[k])
        axes.set_ylabel(label)
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), handlelength=3.0)
    panels[-1].set_xlabel("time [s]")
    return figure


def joint_figure(
    time: Array, coordinates: Array, command_time: Array, command: Array, unit: str
) -> Figure:
    """Draw joint coordinates (K, n) of the poses, and the commands (M, n), over their times, s."""
    figure, panels = panel_grid(coordinates.shape[1], WIDTH / 3, 1.5, above=0.3, sharex=True)
    for joint, axes in enumerate(panels):
        axes.step(
            command_time,
            command[:, joint],
            where="post",
            color=RED,
            linestyle="--",
            label="command",
        )
        axes.plot(time, coordinates[:, joint], color=BLUE, label="joint coordinate of the pose")
        axes.set_title(f"joint {joint + 1} [{unit}]")
    for axes in panels[-3:]:
        axes.set_xlabel("time [s]")
    legend_above(figure, panels[0])
    return figure


def spectrum_figure(frequency: Array, power: Array, highest_hz: float, noise: Array) -> Figure:
    """Draw the root of the spectrum (F, 6) of poses, m2/Hz and rad2/Hz, over frequencies (F,), Hz.

    `noise` (6,) has the standard deviations, m and rad, of white noise, whose level is drawn too.
    A vertical line marks `highest_hz`, up to which there is motion.
    """
    figure = Figure(figsize=(WIDTH, 2.4), layout="constrained")
    panels = figure.subplots(1, 2)
    for axes, kind, unit in zip(panels, (LENGTH, ANGLE), ("mm", "mrad"), strict=True):
        for k in range(6)[kind]:
            seen = frequency > 0
            root = 1e3 * np.sqrt(power[seen, k])
            axes.loglog(frequency[seen], root, label=COMPONENTS[k], **LINES[k])
        level = 1e3 * np.sqrt(np.mean(noise[kind] ** 2) / frequency[-1])
        if np.isfinite(level) and level > 0:
            axes.axhline(level, color=INK, linewidth=0.8, linestyle=":", label="noise")
        axes.axvline(highest_hz, color=GREY, linewidth=0.8)
        axes.set(xlabel="frequency [Hz]", ylabel=f"[{unit}/√Hz]")
        axes.legend(loc="lower left")
    return figure
