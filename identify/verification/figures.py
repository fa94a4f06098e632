"""Figures of acceptance tests: the volume with its lines, length errors, errors of the bar, latency (PNG)."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cmmsim.acceptance import BarTest, LatencyTest, LengthTest, MeasuringVolume, bar_paths, seven_lines
from cmmsim.acceptance.bar_paths import SECONDS
from cmmsim.acceptance.published import published
from cmmsim.acceptance.volume import CORNERS
from cmmsim.geometry.pose import apply, invert
from identify.files.figure import blank_figure

EDGES = [(a, b) for a in range(8) for b in range(a) if np.sum(CORNERS[a] != CORNERS[b]) == 1]


def lines_figure(volume: MeasuringVolume) -> Figure:
    """The volume with the seven measuring lines; axes in mm."""
    curves = {line.name: np.stack([line.start, line.end]) for line in seven_lines(volume)}
    return _in_volume(volume, "Measuring lines (VDI/VDE 2634-1)", curves)


def paths_figure(volume: MeasuringVolume) -> Figure:
    """The volume with the paths of the bar's middle; axes in mm."""
    to_volume = invert(volume.base_from_volume)
    curves = {
        path.name: apply(to_volume, np.array([path.pose(time)[:3] for time in np.linspace(0.0, SECONDS, 200)]))
        for path in bar_paths(volume)
    }
    return _in_volume(volume, "Paths of the bar's middle (ASTM E3064)", curves)


def length_figure(test: LengthTest, limit_um: float) -> Figure:
    """Length measurement error against length: single exposures as dots, the mean of each length as a line."""
    figure = blank_figure(9, 5.5)
    axes = figure.subplots()
    for number, line in enumerate(test.lines):
        lengths = test.of_line(line.name)
        true = np.array([1e3 * length.true for length in lengths])
        single = 1e6 * np.array([length.measured - length.true for length in lengths])
        shown = axes.plot(true, [1e6 * length.error for length in lengths], "o-", label=line.name)
        axes.plot(true[:, None] + 1.5 * (number - 3), single, ".", color=shown[0].get_color(), alpha=0.35, markersize=4)
    for sign in (-1.0, 1.0):
        axes.axhline(sign * limit_um, color="black", linestyle="--", linewidth=1)
    axes.set_xlabel("certified length [mm]")
    axes.set_ylabel("length measurement error [um]")
    axes.set_title(
        f"VDI/VDE 2634-1: largest error {1e6 * test.largest.error:+.1f} um, limit ± {limit_um:g} um (dashes)"
        "\ndots: single exposures, lines: their mean"
    )
    axes.legend(fontsize="small", ncols=2)
    axes.grid(alpha=0.3)
    return figure


def bar_figure(test: BarTest) -> Figure:
    """Relative pose error of the bar over time, and its distribution beside the published limits."""
    figure = blank_figure(12, 8)
    panels = figure.subplots(2, 2, width_ratios=(3, 2))
    for run in test.runs:
        for row, columns, scale in ((0, slice(0, 3), 1e6), (1, slice(3, 6), 1e6)):
            panels[row, 0].plot(
                run.time, scale * np.linalg.norm(run.errors[:, columns], axis=1), linewidth=0.7, label=run.name
            )
    for row, (name, unit) in enumerate((("position", "um"), ("orientation", "urad"))):
        panels[row, 0].set_ylabel(f"{name} error [{unit}]")
        panels[row, 0].axvline(0.0, color="black", linestyle="--", linewidth=1)
        panels[row, 0].grid(alpha=0.3)
        _distribution(panels[row, 1], test, row, name, unit)
    panels[0, 0].set_title("error of the second end relative to the first (dashes: the bar starts to move)")
    panels[0, 0].legend(fontsize="x-small", ncols=2)
    panels[1, 0].set_xlabel("time [s]")
    figure.suptitle("Rigid bar in the style of ASTM E3064-16")
    return figure


def latency_figure(test: LatencyTest) -> Figure:
    """Delay of each report, their mean with its interval, and what the sensor file states."""
    figure = blank_figure(9, 4.5)
    series, spread = figure.subplots(1, 2, sharey=True, width_ratios=(3, 1))
    found = test.latency
    series.plot(test.reported, 1e3 * found.delays, ".", markersize=4, label="one report")
    low, high = (1e3 * bound for bound in found.interval)
    series.axhspan(low, high, color="tab:orange", alpha=0.4, label="95 % interval of the mean")
    series.axhline(1e3 * test.stated, color="black", linestyle="--", linewidth=1, label="stated in the sensor file")
    spread.hist(1e3 * found.delays, bins=30, orientation="horizontal")
    series.set_xlabel("time of the report [s]")
    series.set_ylabel("latency [ms]")
    spread.set_xlabel("reports")
    series.set_title(f"ASTM E3124: mean {1e3 * found.mean:.4f} ms, standard deviation {1e3 * found.std:.4f} ms")
    series.legend(fontsize="small")
    series.grid(alpha=0.3)
    return figure


def _distribution(axes: Axes, test: BarTest, row: int, name: str, unit: str) -> None:
    """Share of frames below an error, standing and moving, with published figures as vertical lines."""
    for moving, word in ((False, "standing"), (True, "moving")):
        magnitudes = np.sort(1e6 * np.linalg.norm(test.errors(moving)[:, 3 * row : 3 * row + 3], axis=1))
        axes.plot(magnitudes, np.arange(1, len(magnitudes) + 1) / len(magnitudes), label=f"this sensor, {word}")
    figures = [*published(f"{name}, static"), *published(f"{name}, moving")]
    for number, figure in enumerate(figures):
        value = 1e3 * figure.value if figure.unit == "mm" else 1e6 * np.deg2rad(figure.value)
        style = ":" if figure.quantity.endswith("static") else "-."
        axes.axvline(
            value,
            color=f"C{number + 2}",
            linestyle=style,
            label=f"{figure.instrument}, {figure.quantity.split(', ')[1]}",
        )
    axes.set_xscale("log")
    axes.set_xlabel(f"{name} error [{unit}]")
    axes.set_ylabel("share of frames")
    axes.legend(fontsize="x-small")
    axes.grid(alpha=0.3)


def _in_volume(volume: MeasuringVolume, title: str, curves: dict[str, np.ndarray]) -> Figure:
    """Curves (n,3) m in the volume, drawn as a reader sees it: x to the right, depth away, up."""
    figure = blank_figure(8, 6.5)
    axes: Any = figure.add_subplot(projection="3d")
    for a, b in EDGES:
        axes.plot(*_shown(CORNERS[[a, b]] * volume.size), color="grey", linewidth=0.8)
    for name, curve in curves.items():
        axes.plot(*_shown(curve), label=name)
    near, far = volume.depth_range
    axes.set(
        xlabel="x [mm]",
        ylabel="z, away from the rig [mm]",
        zlabel="−y, up [mm]",
        title=f"{title}\nvolume {volume}, {1e3 * near:.0f} to {1e3 * far:.0f} mm from the baseline",
    )
    axes.set_box_aspect(volume.size[[0, 2, 1]], zoom=0.85)
    axes.view_init(elev=16, azim=-72)
    axes.legend(loc="upper left", fontsize="x-small")
    return figure


def _shown(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x, z and -y (n,) mm of points (n,3) m."""
    return 1e3 * points[:, 0], 1e3 * points[:, 2], -1e3 * points[:, 1]
