"""Figures of a sensor's acceptance tests, calibration, detectors, and teaching by photographs."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from cmmsim import PhotographedTeaching
from cmmsim.acceptance import (
    BarTest,
    LatencyTest,
    LengthTest,
    MeasuringVolume,
    bar_paths,
    seven_lines,
)
from cmmsim.acceptance.moving_bar import SECONDS
from cmmsim.acceptance.statistics import published
from cmmsim.acceptance.volume import CORNERS
from cmmsim.calibration import Calibration
from cmmsim.calibration.sightings import SIDES
from cmmsim.detector_leaderboard import Condition, Score
from cmmsim.geometry.pose import apply, invert
from identify.reporting.figures import panel_grid
from identify.verification.acceptance import AcceptanceRun

# Two corners of a box are connected by an edge if they differ in one coordinate.
EDGES = [(a, b) for a in range(8) for b in range(a) if np.sum(CORNERS[a] != CORNERS[b]) == 1]

# Length of an arrow for a residual of three sigma, as a fraction of the image width.
ARROW_SHARE = 0.06
GRID = 25  # number of points along the width of the image in drawings of the distortion


def acceptance_figures(run: AcceptanceRun) -> dict[str, Figure]:
    """Return the figures of the tests that were run, by name."""
    figures = {}
    if length := run.found.get("vdi"):
        figures["measuring_lines"] = lines_figure(run.volume)
        figures["length_errors"] = length_figure(length, run.limit_um)
    if bar := run.found.get("e3064"):
        figures["bar_paths"] = paths_figure(run.volume)
        figures["bar_errors"] = bar_figure(bar)
    if latency := run.found.get("e3124"):
        figures["latency"] = latency_figure(latency)
    return figures


def lines_figure(volume: MeasuringVolume) -> Figure:
    """Draw the volume with the seven measuring lines. The axes are in mm."""
    curves = {line.name: np.stack([line.start, line.end]) for line in seven_lines(volume)}
    return _in_volume(volume, "Measuring lines (VDI/VDE 2634-1)", curves)


def paths_figure(volume: MeasuringVolume) -> Figure:
    """Draw the volume with the paths of the bar's middle. The axes are in mm."""
    to_volume = invert(volume.base_from_volume)
    curves = {
        path.name: apply(
            to_volume, np.array([path.pose(time)[:3] for time in np.linspace(0.0, SECONDS, 200)])
        )
        for path in bar_paths(volume)
    }
    return _in_volume(volume, "Paths of the bar's middle (ASTM E3064)", curves)


def _in_volume(volume: MeasuringVolume, title: str, curves: dict[str, np.ndarray]) -> Figure:
    """Draw curves (n, 3) [m] in the volume, with axes to the right, away and up."""
    figure = Figure(figsize=(8, 6.5), layout="constrained")
    axes: Any = figure.add_subplot(projection="3d")
    for a, b in EDGES:
        axes.plot(*_as_seen(CORNERS[[a, b]] * volume.size), color="grey", linewidth=0.8)
    for name, curve in curves.items():
        axes.plot(*_as_seen(curve), label=name)
    near, far = volume.depth_range
    axes.set(
        xlabel="x [mm]",
        ylabel="z, away from the rig [mm]",
        zlabel="−y, up [mm]",
        title=f"{title}\nvolume {volume}, {1e3 * near:.0f} to {1e3 * far:.0f} mm from the baseline",
    )
    # The axes of the figure are x, z and -y of the volume.
    axes.set_box_aspect(volume.size[[0, 2, 1]], zoom=0.85)
    axes.view_init(elev=16, azim=-72)
    axes.legend(loc="upper left", fontsize="x-small")
    return figure


def _as_seen(points: np.ndarray) -> np.ndarray:
    """Return x, z and -y (3, n) [mm] of points (n, 3) [m]."""
    return 1e3 * (points * [1.0, -1.0, 1.0]).T[[0, 2, 1]]


def length_figure(test: LengthTest, limit_um: float) -> Figure:
    """Draw the error of the measured lengths against the length.

    Dots are single exposures. Each point of a line is the mean of one length.
    """
    figure = Figure(figsize=(9, 5.5), layout="constrained")
    axes = figure.subplots()
    for number, line in enumerate(test.lines):
        lengths = test.of_line(line.name)
        true = np.array([1e3 * length.true for length in lengths])
        single = 1e6 * np.array([length.measured - length.true for length in lengths])
        shown = axes.plot(true, [1e6 * length.error for length in lengths], "o-", label=line.name)
        # Dots are shifted by a few mm, so that the seven lines do not hide each other.
        axes.plot(
            true[:, None] + 1.5 * (number - 3),
            single,
            ".",
            color=shown[0].get_color(),
            alpha=0.35,
            markersize=4,
        )
    for sign in (-1.0, 1.0):
        axes.axhline(sign * limit_um, color="black", linestyle="--", linewidth=1)
    axes.set(xlabel="certified length [mm]", ylabel="length measurement error [um]")
    axes.set_title(
        f"VDI/VDE 2634-1: largest error {1e6 * test.largest.error:+.1f} um, limit ± {limit_um:g} "
        "um (dashes)\ndots: single exposures, lines: their mean"
    )
    axes.legend(fontsize="small", ncols=2)
    axes.grid(alpha=0.3)
    return figure


def bar_figure(test: BarTest) -> Figure:
    """Draw the relative pose error of the bar over time, and its distribution.

    Published limits are drawn with the distribution.
    """
    figure = Figure(figsize=(12, 8), layout="constrained")
    panels = figure.subplots(2, 2, width_ratios=(3, 2))
    for (series, histogram), name, unit, columns in zip(
        panels, ("position", "orientation"), ("um", "urad"), (slice(0, 3), slice(3, 6)), strict=True
    ):
        for run in test.runs:
            series.plot(
                run.time,
                1e6 * np.linalg.norm(run.errors[:, columns], axis=1),
                linewidth=0.7,
                label=run.name,
            )
        series.set_ylabel(f"{name} error [{unit}]")
        series.axvline(0.0, color="black", linestyle="--", linewidth=1)
        series.grid(alpha=0.3)
        _distribution(histogram, test, columns, name, unit)
    panels[0, 0].set_title(
        "error of the second end relative to the first (dashes: the bar starts to move)"
    )
    panels[0, 0].legend(fontsize="x-small", ncols=2)
    panels[1, 0].set_xlabel("time [s]")
    figure.suptitle("Rigid bar in the style of ASTM E3064-16")
    return figure


def _distribution(axes: Axes, test: BarTest, columns: slice, name: str, unit: str) -> None:
    """Draw the fraction of frames below an error, with published values as vertical lines."""
    for moving, word in ((False, "standing"), (True, "moving")):
        magnitudes = np.sort(1e6 * np.linalg.norm(test.errors(moving)[:, columns], axis=1))
        axes.plot(
            magnitudes,
            np.arange(1, len(magnitudes) + 1) / len(magnitudes),
            label=f"this sensor, {word}",
        )
    for number, figure in enumerate([*published(f"{name}, static"), *published(f"{name}, moving")]):
        # Published values are in mm or degrees, and the axis is in µm or µrad.
        value = 1e3 * figure.value if figure.unit == "mm" else 1e6 * np.deg2rad(figure.value)
        state = figure.quantity.split(", ")[1]
        style = ":" if state == "static" else "-."
        axes.axvline(
            value, color=f"C{number + 2}", linestyle=style, label=f"{figure.instrument}, {state}"
        )
    axes.set(xscale="log", xlabel=f"{name} error [{unit}]", ylabel="fraction of frames")
    axes.legend(fontsize="x-small")
    axes.grid(alpha=0.3)


def latency_figure(test: LatencyTest) -> Figure:
    """Draw the latency of each report, and the distribution of the latencies.

    A band is the interval of the mean, and a line the latency that the sensor file states.
    """
    figure = Figure(figsize=(9, 4.5), layout="constrained")
    series, histogram = figure.subplots(1, 2, sharey=True, width_ratios=(3, 1))
    found = test.latency
    series.plot(test.reported, 1e3 * found.delays, ".", markersize=4, label="one report")
    low, high = (1e3 * bound for bound in found.interval)
    series.axhspan(low, high, color="tab:orange", alpha=0.4, label="95 % interval of the mean")
    series.axhline(
        1e3 * test.stated,
        color="black",
        linestyle="--",
        linewidth=1,
        label="stated in the sensor file",
    )
    histogram.hist(1e3 * found.delays, bins=30, orientation="horizontal")
    series.set(xlabel="time of the report [s]", ylabel="latency [ms]")
    histogram.set_xlabel("reports")
    series.set_title(
        f"ASTM E3124: mean {1e3 * found.mean:.4f} ms, standard deviation {1e3 * found.std:.4f} ms"
    )
    series.legend(fontsize="small")
    series.grid(alpha=0.3)
    return figure


def residual_figure(found: Calibration) -> Figure:
    """Draw the residuals, measured minus computed, as arrows at the measured points."""
    figure, panels = _image_panels(found, f"residuals, sigma {found.adjustment.sigma_px:.3g} px")
    for k, axes in enumerate(panels):
        pixels = found.sightings[k].pixels
        residuals = found.adjustment.residuals[k]
        three_sigma = 3.0 * max(found.adjustment.sigma_px, 1e-9)
        arrows = axes.quiver(
            *pixels.T,
            *residuals.T,
            angles="xy",
            scale_units="xy",
            width=0.0015,
            scale=three_sigma / (ARROW_SHARE * found.rig.left.width),
        )
        axes.quiverkey(arrows, 0.85, 1.03, three_sigma, f"{three_sigma:.2g} px")
        rms = np.sqrt(np.mean(residuals**2))
        axes.set_title(
            f"{SIDES[k]}: {len(residuals)} points, rms {rms:.3g} px", loc="left", fontsize="medium"
        )
    return figure


def coverage_figure(found: Calibration) -> Figure:
    """Draw the board points of all used images, outside which the distortion is extrapolated."""
    figure, panels = _image_panels(found, "board points of all used images")
    for k, axes in enumerate(panels):
        seen = found.sightings[k]
        axes.scatter(seen.pixels[:, 0], seen.pixels[:, 1], s=3, c=seen.view, cmap="turbo")
        axes.set_title(
            f"{SIDES[k]}: {len(np.unique(seen.view))} images", loc="left", fontsize="medium"
        )
    return figure


def distortion_figure(found: Calibration) -> Figure:
    """Draw the shift of each image point by the lens distortion, in px.

    White crosses are the principal points.
    """
    figure, panels = _image_panels(found, "lens distortion")
    for axes, camera, name in zip(panels, found.rig.cameras, SIDES, strict=True):
        step = camera.width / GRID
        x, y = np.meshgrid(np.arange(0.0, camera.width, step), np.arange(0.0, camera.height, step))
        pixels = np.stack([x, y], axis=-1)
        ideal, known = camera.undistort(pixels)
        # Far from the centre, some distortions have no inverse.
        moved = np.where(known[..., None], pixels - ideal, np.nan)
        length = np.linalg.norm(moved, axis=-1)
        shown = axes.pcolormesh(x, y, length, shading="nearest", cmap="viridis")
        axes.plot(*camera.centre, "w+", markersize=10)
        figure.colorbar(shown, ax=axes, label="shift [px]", shrink=0.8)
        axes.set_title(f"{name}: up to {np.nanmax(length):.3g} px", loc="left", fontsize="medium")
    return figure


def _image_panels(found: Calibration, title: str) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(12, 5), layout="constrained")
    panels = list(figure.subplots(1, 2).flat)
    for axes in panels:
        axes.set(
            xlim=(-0.5, found.rig.left.width - 0.5),
            ylim=(found.rig.left.height - 0.5, -0.5),
            aspect="equal",
        )
        axes.set(xlabel="x [px]", ylabel="y [px]")
    figure.suptitle(title)
    return figure, panels


def detectors_figure(scores: Sequence[Score], at_work: Condition) -> Figure:
    """Draw the RMS error of the detectors against the noise, in logarithmic scales.

    There is one panel for each combination of radius, tilt and point spread.
    """
    views = list(dict.fromkeys(_view(score.condition) for score in scores))
    figure, panels = panel_grid(len(views), 4.5, 3.2, above=0.8, sharey=True)
    for view, axes in zip(views, panels, strict=True):
        _condition_panel(axes, [score for score in scores if _view(score.condition) == view])
        radius, tilt, psf = view
        work = "working point: " if view == _view(at_work) else ""
        seen = f"radius {radius:.3g} px, tilt {np.degrees(tilt):.0f}°, σ_psf {psf:.2g} px"
        axes.set_title(work + seen, fontsize="small")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    figure.suptitle("Error of a sticker's centre in the image")
    return figure


def _view(condition: Condition) -> tuple[float, float, float]:
    return condition.radius_px, condition.tilt, condition.psf_px


def _condition_panel(axes: Axes, scores: Sequence[Score]) -> None:
    noise = sorted({score.condition.noise for score in scores})
    bound = {score.condition.noise: score.bound_px for score in scores}
    axes.plot(
        100.0 * np.array(noise),
        [bound[n] for n in noise],
        "k--",
        marker="_",
        label="Cramer-Rao bound",
    )
    for name in dict.fromkeys(score.detector for score in scores):
        own = sorted((s for s in scores if s.detector == name), key=lambda s: s.condition.noise)
        # The error is infinite if every sticker was lost. Such points are not drawn.
        error = np.array([s.rms_px for s in own])
        percent = [100.0 * s.condition.noise for s in own]
        axes.plot(
            percent,
            np.where(np.isfinite(error), error, np.nan),
            "o-",
            markersize=3,
            label=name.replace("_", " "),
        )
    axes.set(xscale="log", yscale="log", xlabel="noise [% of contrast]", ylabel="rms error [px]")
    axes.set_xticks(100.0 * np.array(noise), [f"{100.0 * n:.2g}" for n in noise])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.grid(alpha=0.3, which="both")


def teaching_residuals(found: PhotographedTeaching) -> Figure:
    """Draw the residuals, measured minus computed centres, as arrows at the centres."""
    figure = Figure(figsize=(12, 5), layout="constrained")
    panels = figure.subplots(1, 2)
    seen = found.observations
    three_sigma = 3.0 * max(found.rms_px, 1e-9)
    figure.suptitle(f"residuals of stickers, rms {found.rms_px:.3g} px")
    for side, axes in enumerate(panels):
        camera = found.bundle.state.rig.cameras[side]
        for moves, colour, body in ((False, "tab:orange", "base"), (True, "tab:blue", "platform")):
            own = seen.moves == moves
            arrows = axes.quiver(
                *seen.pixels[side, own].T,
                *found.bundle.residuals[side, own].T,
                angles="xy",
                scale_units="xy",
                width=0.0015,
                color=colour,
                label=body,
                scale=three_sigma / (ARROW_SHARE * camera.width),
            )
        axes.quiverkey(arrows, 0.85, 1.03, three_sigma, f"{three_sigma:.2g} px")
        rms = np.sqrt(np.mean(found.bundle.residuals[side] ** 2))
        axes.set(
            xlim=(0, camera.width),
            ylim=(camera.height, 0),
            xlabel="x [px]",
            ylabel="y [px]",
            aspect="equal",
        )
        axes.set_title(f"{SIDES[side]}: rms {rms:.3g} px", loc="left", fontsize="medium")
    panels[0].legend(loc="upper right", fontsize="small")
    return figure
