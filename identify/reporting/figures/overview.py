"""Figures of the experiment.

One shows the scene above both camera images. The other shows the images with their residuals.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from identify.arrays import Array
from identify.reporting.figures.paths import round_down
from identify.reporting.figures.style import WIDTH
from identify.scene import StereoView, Viewpoint, Workcell, stereo_figure
from identify.scene.drawings import FOUND, SIDES, draw_scene, show_image

OVERVIEW = (4.8, 4.9)  # width and height of the overview, in inches
BENEATH = 0.4  # fraction of the overview's height for the images


def overview_figure(cell: Workcell, pose: Array, view: StereoView | None = None) -> Figure:
    """Draw robot, stickers and cameras with the platform at a pose (6,).

    If there is a view, both camera images are drawn below, and the figure is higher than wide, to
    fit on the screen of a phone. Raises dynamics.UnreachablePoseError or dynamics.ChartError if the
    robot cannot have the pose.
    """
    width, height = OVERVIEW
    beneath = 0.0 if view is None else BENEATH
    figure = Figure(figsize=(width, height * (1 - BENEATH + beneath)))
    # The name of the upper camera is above the scene.
    axes = figure.add_axes((0.08, beneath, 0.87, 0.97 - beneath))
    draw_scene(axes, cell, pose, Viewpoint(), rays=True, labels=True)
    if view is not None:
        # The images are square, but the figure, whose fractions are the coordinates, is not.
        side = (beneath - 0.05) * height / width
        for number, name in enumerate(SIDES):
            axes = figure.add_axes(
                (0.5 + (number - 1) * side + (number - 0.5) * 0.04, 0.0, side, beneath - 0.05)
            )
            show_image(axes, view, number)
            for body, found in view.found.items():
                x, y = found.centres[number].T
                axes.scatter(x, y, s=9, facecolors="none", edgecolors=FOUND[body], linewidths=0.5)
            axes.set(xticks=[], yticks=[], xlabel="", ylabel="")
            axes.set_title(f"seen by the {name} camera", fontsize=8, pad=2)
    return figure


ARROW = 0.12  # largest length of an arrow, as a fraction of the image's width


def residual_figure(view: StereoView) -> Figure:
    """Draw both camera images with the detected ellipses and the errors of their centres.

    The errors are drawn as enlarged arrows. A reference arrow is labelled with its length in px.
    """
    errors = np.concatenate(
        [(found.centres - found.expected).reshape(-1, 2) for found in view.found.values()]
    )
    longest = float(np.linalg.norm(errors, axis=1).max(initial=1e-6))
    width = view.images.shape[2]
    factor = round_down(ARROW * width / longest)
    figure = stereo_figure(view, size=(WIDTH, 0.66 * WIDTH), arrows=factor)
    for axes in figure.axes:
        axes.grid(visible=False)
    _scale_arrow(figure.axes[0], width, factor, round_down(ARROW * width / factor))
    return figure


def _scale_arrow(axes: Axes, width: int, factor: float, length: float) -> None:
    """Draw a reference arrow for a length in px in the lower left corner of an image."""
    left = axes.get_xlim()[0]
    low, high = axes.get_ylim()
    tail = left + 0.04 * width, low + 0.05 * (high - low)
    axes.quiver(
        *tail,
        factor * length,
        0.0,
        angles="xy",
        scale_units="xy",
        scale=1,
        color="white",
        width=0.004,
    )
    axes.annotate(
        f"{length:g} px",
        tail,
        xytext=(0, 4),
        textcoords="offset points",
        color="white",
        fontsize=7.5,
    )
