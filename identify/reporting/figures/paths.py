"""Figures of the motion of a run.

They show the motion over time and as a path in space, and the uncertainty of each measured pose.
"""

from itertools import combinations
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar
from mpl_toolkits.mplot3d import proj3d
from mpl_toolkits.mplot3d.axes3d import Axes3D
from numpy.typing import NDArray
from scipy.special import chdtri

from identify.arrays import Array
from identify.reporting.figures.style import (
    BLUE,
    COMPONENTS,
    GREY,
    INK,
    LINES,
    PAPER,
    RED,
    WIDTH,
    legend_above,
    moving,
)

# Parts of a pose: name, index of the first component, unit of motions and unit of errors.
PARTS = (("position", 0, "mm", "µm"), ("orientation", 3, "mrad", "µrad"))


def excitation_figure(time: Array, poses: Array) -> Figure:
    """Draw position and orientation of a trajectory over time, like figure 11 of the paper.

    ``time`` (N,) is in s, ``poses`` (N, 6) in m and rad. Components that do not move are omitted.
    """
    shown = moving(poses)
    parts = [part for part in PARTS if any(part[1] <= i < part[1] + 3 for i in shown)]
    figure = Figure(figsize=(WIDTH, 0.4 + 1.7 * len(parts)), layout="constrained")
    panels = figure.subplots(len(parts), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (name, first, unit, _) in zip(panels, parts, strict=True):
        for i in (i for i in shown if first <= i < first + 3):
            axes.plot(time, 1e3 * (poses[:, i] - poses[0, i]), label=COMPONENTS[i], **LINES[i])
        axes.set_ylabel(f"{name}\nfrom the start [{unit}]")
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, handlelength=3.0)
    panels[-1].set_xlabel("time [s]")
    return figure


MARKED = 10  # largest number of times that are marked along a path


def path_figure(time: Array, poses: Array) -> Figure:
    """Draw the path (N, 6) [m, rad] of the platform over the time (N,) [s].

    Position and orientation are side by side, with the same times marked. Components that do not
    move are omitted.
    """
    shown = moving(poses)
    parts = [
        ([i for i in shown if first <= i < first + 3], name, unit) for name, first, unit, _ in PARTS
    ]
    parts = [part for part in parts if part[0]]
    figure = Figure(figsize=(WIDTH if len(parts) > 1 else WIDTH / 1.6, 3.2))
    figure.subplots_adjust(left=0.02, right=0.94, bottom=0.06, top=0.94, wspace=0.12)
    elapsed = time - time[0]
    # Search slightly before the round time, so that rounding does not select the next frame.
    marks = np.searchsorted(
        elapsed, np.arange(0, elapsed[-1], _round_up(elapsed[-1] / MARKED)) - 1e-9
    )
    drawn: list[tuple[Any, Array]] = []
    for panel, (columns, name, unit) in enumerate(parts, start=1):
        spatial = len(columns) == 3
        axes: Any = figure.add_subplot(
            1, len(parts), panel, **({"projection": "3d"} if spatial else {})
        )
        path = 1e3 * (poses[:, columns] - poses[0, columns])
        if len(columns) == 1:
            path = np.column_stack([elapsed, path])
        _draw_path(axes, path, marks)
        labels = [f"{COMPONENTS[i]} [{unit}]" for i in columns]
        if len(columns) == 1:
            labels = ["time from the start [s]", *labels]
        for axis, label in zip("xyz", labels, strict=False):
            getattr(axes, f"set_{axis}label")(label)
        letter = f"({'ab'[panel - 1]}) " if len(parts) > 1 else ""
        axes.set_title(f"{letter}{name} from the start")
        if spatial:
            _plain_box(axes)
        else:
            figure.subplots_adjust(left=0.12, bottom=0.16)
            axes.set_aspect("equal" if len(columns) == 2 else "auto", adjustable="datalim")
        drawn.append((axes, path))
    for axes, path in drawn:
        _label_times(axes, path, marks, elapsed)
    return figure


def _draw_path(axes: Any, path: Array, marks: NDArray[np.int_]) -> None:
    """Draw a path (N, 2) or (N, 3) with dots at the indices `marks`, but a square at its start."""
    axes.plot(*path.T, color=BLUE, linewidth=1.0)
    axes.plot(
        *path[marks[1:]].T,
        linestyle="none",
        marker="o",
        color=INK,
        markersize=3,
        markerfacecolor=PAPER,
    )
    axes.plot(*path[:1].T, linestyle="none", marker="s", color=RED, markersize=6)


LABEL = 6.5  # size of the font of the label of a time, points
# Directions from a mark in which its label is tried.
AROUND = np.array([[1, 1], [-1, 1], [1, -1], [-1, -1], [1, 0], [-1, 0], [0, 1], [0, -1]])


def _label_times(axes: Any, path: Array, marks: NDArray[np.int_], time: Array) -> None:
    """Write the time beside each mark of a path, unless other labels and marks leave no room.

    A label is on the path only where there is no place beside it.
    """
    axes.figure.draw_without_rendering()
    flat = path
    if path.shape[1] == 3:
        flat = np.column_stack(proj3d.proj_transform(*path.T, axes.get_proj())[:2])
    points = axes.transData.transform(flat) * 72 / axes.figure.dpi
    taken = [(point - 2.0, point + 2.0) for point in points[marks]]
    for k, point, anchor in zip(marks, points[marks], flat[marks], strict=True):
        label = "start" if k == marks[0] else f"{time[k]:.3g} s"
        half = np.array([0.31 * LABEL * len(label), 0.6 * LABEL])
        steps = [step for far in (3.0, 9.0, 15.0) for step in AROUND * (far + half)]
        # The sort is stable: of places that are equally good, the nearest comes first.
        for step in sorted(steps, key=lambda step: _faults(point + step, half, points, marks, k)):
            low, high = point + step - half, point + step + half
            if all((low > top).any() or (high < bottom).any() for bottom, top in taken):
                taken.append((low, high))
                axes.annotate(
                    label,
                    anchor,
                    step,
                    textcoords="offset points",
                    ha="center",
                    va="center",
                    fontsize=LABEL,
                    color=RED if k == marks[0] else INK,
                )
                break


def _faults(
    middle: Array, half: Array, points: Array, marks: NDArray[np.int_], mark: int
) -> tuple[bool, bool]:
    """Tell whether a label is nearer to another mark than its own, and whether it hides the path.

    middle, half (2,)  Middle and half size of the label.
    points (N, 2)      Points of the path, of which `marks` and `mark` are indices.
    """
    away = np.linalg.norm(points[marks] - middle, axis=1)
    own = np.linalg.norm(points[mark] - middle)
    covered = (np.abs(points - middle) < half).all(axis=1)
    return bool(away.min() < own), bool(covered.any())


def _plain_box(axes: Axes3D) -> None:
    """Give a 3D box transparent panes, and the same scale on all axes."""
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.pane.set_facecolor((1, 1, 1, 0))
        axis.pane.set_edgecolor(GREY)
        axis.set_major_locator(MaxNLocator(4))
    axes.set_aspect("equal")
    axes.set_box_aspect(None, zoom=0.92)
    axes.view_init(elev=22, azim=-55)
    axes.tick_params(labelsize=6.5, pad=0)


COVERED = 0.95  # probability that an ellipse covers the true pose
ELLIPSES = 12  # largest number of poses whose ellipses are drawn
SHARE = 0.15  # largest half axis of a drawn ellipse, as a fraction of the size of the path


def ellipse_figure(
    poses: Array, covariances: Array, shown: list[int], errors: Array | None = None
) -> Figure:
    """Draw 95 % ellipses of the measured poses along the path, enlarged.

    poses        Measured poses (N, 6) [m, rad], NaN for a lost pose.
    covariances  Covariances (N, 6, 6) of the poses according to the sensor.
    shown        Indices of the components that move. Any two of one part of a pose have a panel.
    errors       True minus measured poses (N, 6), if the truth is known. They are enlarged like the
                 ellipses.
    """
    # Lost frames have neither a pose nor a covariance.
    kept = np.flatnonzero(
        np.isfinite(poses).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
    )
    chosen = kept[np.linspace(0, len(kept) - 1, min(ELLIPSES, len(kept))).round().astype(int)]
    path = 1e3 * (poses - poses[kept[0]])
    views = []
    for part in PARTS:
        own = [i for i in shown if part[1] <= i < part[1] + 3]
        pairs = [list(pair) for pair in combinations(own, 2)]
        if pairs:
            views.append((part, pairs))
    figure = Figure(figsize=(WIDTH, 0.4 + 2.5 * max(len(views), 1)), layout="constrained")
    grid = figure.subplots(max(len(views), 1), 3, squeeze=False)
    for row, ((name, first, unit, fine), pairs) in zip(grid, views, strict=False):
        half = slice(first, first + 3)
        # The root of the largest eigenvalue bounds the half axes in every panel.
        largest = 1e3 * np.sqrt(REACH * np.linalg.eigvalsh(covariances[chosen, half, half]).max())
        factor = round_down(SHARE * float(np.ptp(path[kept, half], axis=0).max()) / largest)
        for axes, columns in zip(row, pairs, strict=False):
            axes.plot(*path[kept][:, columns].T, color=GREY, linewidth=0.5)
            _draw_ellipses(
                axes,
                path[chosen][:, columns],
                covariances[chosen][:, columns][:, :, columns],
                factor,
            )
            if errors is not None:
                ends = path[chosen][:, columns] + 1e3 * factor * errors[chosen][:, columns]
                axes.plot(
                    *ends.T,
                    linestyle="none",
                    marker=".",
                    color=RED,
                    label="true pose, enlarged equally",
                )
            axes.set_aspect("equal", adjustable="datalim")
            axes.set_xlabel(f"{COMPONENTS[columns[0]]} from the start [{unit}]")
            axes.set_ylabel(f"{COMPONENTS[columns[1]]} from the start [{unit}]")
        row[0].set_title(f"{name}, ellipses × {factor:g}")
        _scale_bar(row[0], factor, round_down(2e3 * largest), fine)
    for axes in (axes for axes in grid.ravel() if not axes.lines):
        axes.set_visible(False)
    if views:
        legend_above(figure, grid[0, 0], columns=3)
    # Axes of equal scale change their ticks after their layout.
    figure.draw_without_rendering()
    return figure


def _draw_ellipses(axes: Axes, centres: Array, covariances: Array, factor: float) -> None:
    """Draw enlarged ellipses of covariances (n, 2, 2) [SI] about centres (n, 2) [mm or mrad]."""
    # As one line with gaps, all ellipses have one entry in the legend, and are drawn faster.
    gap = np.full((1, 2), np.nan)
    rings = [
        c + 1e3 * factor * ellipse_outline(cov) for c, cov in zip(centres, covariances, strict=True)
    ]
    outline = np.concatenate([part for ring in rings for part in (ring, gap)])
    axes.plot(*outline.T, color=BLUE, linewidth=0.9, label=RING)
    axes.plot(*centres.T, linestyle="none", marker="+", color=BLUE, label="measured pose")


# Squared Mahalanobis distance within which two components lie with the probability `COVERED`.
REACH = float(chdtri(2, 1 - COVERED))

RING = f"contains {100 * COVERED:g} % of true poses"


def ellipse_outline(covariance: Array) -> Array:
    """Return the outline (n, 2), about zero, of the `COVERED` ellipse of a covariance (2, 2)."""
    angle = np.linspace(0, 2 * np.pi, 49)
    # With a small multiple of the identity, a singular covariance has a Cholesky factor.
    root = np.linalg.cholesky(covariance + 1e-12 * np.trace(covariance) * np.eye(2))
    return np.asarray(
        np.sqrt(REACH) * np.column_stack([np.cos(angle), np.sin(angle)]) @ root.T, dtype=float
    )


def _scale_bar(axes: Axes, factor: float, length: float, fine: str) -> None:
    """Draw a bar of a length in the fine unit, enlarged by `factor`, on axes in the coarse unit."""
    look: dict[str, Any] = {
        "frameon": True,
        "pad": 0.5,
        "sep": 4,
        "borderpad": 0.4,
        "color": BLUE,
        "label_top": True,
    }
    reach = 1e-3 * factor * length
    axes.add_artist(
        AnchoredSizeBar(axes.transData, reach, f"{length:g} {fine}", "lower right", **look)
    )


def _round_up(value: float) -> float:
    """Return the smallest of 1, 2 and 5 times powers of ten that is at least a positive value."""
    return 1.0 / round_down(1.0 / value)


def round_down(value: float) -> float:
    """Return the largest of 1, 2 and 5 times powers of ten that is at most a positive value."""
    power = 10.0 ** np.floor(np.log10(value))
    # The tolerance is for values that rounding has moved just below a step.
    return float(power * max(step for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)))
