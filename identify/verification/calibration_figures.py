"""Figures of a calibration: residuals over the image, where board points were seen, and what the lenses bend."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cmmsim.calibration import Calibration
from identify.files.figure import blank_figure

SIDES = ("left", "right")
ARROW_SHARE = 0.06
"""Of the image width: length of an arrow for a residual of three sigma."""
GRID = 25
"""Points along the width of the image at which distortion is drawn."""


def residual_figure(found: Calibration) -> Figure:
    """Residuals, measured minus computed, as arrows where they were seen."""
    figure, panels = _panels(found, f"residuals, sigma {found.adjustment.sigma_px:.3g} px")
    for k, axes in enumerate(panels):
        pixels, residuals = found.sightings[k].pixels, found.adjustment.residuals[k]
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
        axes.set_title(f"{SIDES[k]}: {len(residuals)} points, rms {rms:.3g} px", loc="left", fontsize="medium")
    return figure


def coverage_figure(found: Calibration) -> Figure:
    """All board points of all images: where none were seen, distortion is extrapolated."""
    figure, panels = _panels(found, "board points of all used images")
    for k, axes in enumerate(panels):
        seen = found.sightings[k]
        axes.scatter(seen.pixels[:, 0], seen.pixels[:, 1], s=3, c=seen.view, cmap="turbo")
        axes.set_title(f"{SIDES[k]}: {len(np.unique(seen.view))} images", loc="left", fontsize="medium")
    return figure


def distortion_figure(found: Calibration) -> Figure:
    """How far the lenses move each point of the image, in px; white crosses: principal points."""
    figure, panels = _panels(found, "lens distortion")
    for axes, camera, name in zip(panels, found.rig.cameras, SIDES, strict=True):
        step = camera.width / GRID
        x, y = np.meshgrid(np.arange(0.0, camera.width, step), np.arange(0.0, camera.height, step))
        pixels = np.stack([x, y], axis=-1)
        ideal, known = camera.undistort(pixels)
        moved = np.where(known[..., None], pixels - ideal, np.nan)
        length = np.linalg.norm(moved, axis=-1)
        shown = axes.pcolormesh(x, y, length, shading="nearest", cmap="viridis")
        axes.plot(*camera.centre, "w+", markersize=10)
        figure.colorbar(shown, ax=axes, label="shift [px]", shrink=0.8)
        axes.set_title(f"{name}: up to {np.nanmax(length):.3g} px", loc="left", fontsize="medium")
    return figure


def _panels(found: Calibration, title: str) -> tuple[Figure, list[Axes]]:
    figure = blank_figure(12, 5)
    panels = list(figure.subplots(1, 2).flat)
    for axes in panels:
        axes.set_xlim(-0.5, found.rig.left.width - 0.5)
        axes.set_ylim(found.rig.left.height - 0.5, -0.5)
        axes.set_aspect("equal")
        axes.set_xlabel("x [px]")
        axes.set_ylabel("y [px]")
    figure.suptitle(title)
    return figure, panels
