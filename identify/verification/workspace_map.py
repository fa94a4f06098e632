"""Maps of a robot's workspace, as figures and as numbers.

A map shows the used travel, the reach and the conditioning over a plane of poses around home.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from dynamics import Robot, workspace
from identify.arrays import Array
from identify.progress import Progress, SilentProgress
from identify.reporting.figures import COMPONENTS

POINTS = 101  # number of grid points along each side of a map
JOINT_SAMPLES = 20_000  # number of random joint vectors for the extremes over the travel
COLUMNS = 3  # number of maps side by side in a figure

AXES = ("x_m", "y_m", "z_m", "alpha_rad", "beta_rad", "gamma_rad")


@dataclass(frozen=True)
class WorkspacePlane:
    """Map in which two pose components vary and a third is fixed.

    across, up, fixed        Indices 0..5 of the components.
    value                    Value of the fixed component [m or rad].
    horizontal, vertical     Grid lines (n,) [m or rad].
    travel_share, condition  Used fraction of the travel limit, and condition number of the joint
                             Jacobian, each (n, n), with a row for each entry of ``vertical``. They
                             are NaN out of reach.
    reach_margin             Margin (n, n) of the worst leg, negative out of reach.
    """

    across: int
    up: int
    fixed: int
    value: float
    horizontal: Array
    vertical: Array
    travel_share: Array
    condition: Array
    reach_margin: Array

    @property
    def allowed(self) -> Array:
        """True (n, n) for poses that all legs reach with their joints within the travel limit."""
        return np.asarray(self.travel_share <= 1)


@dataclass(frozen=True)
class WorkspaceMap:
    """Maps of a robot's workspace.

    ``ranges`` (m, 2) [m, rad from home] is the range of each coordinate of the platform, with the
    other coordinates at home. ``home`` holds the measures at home. ``travel`` holds the measures at
    JOINT_SAMPLES random joint vectors within the travel, without vectors that have no pose.
    ``unit`` is the unit of the joints.
    """

    robot: str
    unit: str
    axes: tuple[int, ...]
    characteristic_length_m: float
    planes: tuple[WorkspacePlane, ...]
    ranges: Array
    home: workspace.WorkspaceMeasures
    travel: workspace.WorkspaceMeasures

    def summary(self) -> dict[str, Any]:
        """Return the extremes of the maps for JSON. Units are in the names."""
        return {
            "robot": self.robot,
            f"travel_limit_{self.unit}": self.home.travel_limit,
            "characteristic_length_m": self.characteristic_length_m,
            "home": _extremes(self.home, self.unit),
            "whole_travel": {
                "joint_vectors": JOINT_SAMPLES,
                "without_pose": JOINT_SAMPLES - len(self.travel.theta),
                **_extremes(self.travel, self.unit),
            },
            "range_from_home": {
                AXES[k]: list(pair) for k, pair in zip(self.axes, self.ranges.tolist(), strict=True)
            },
            "planes": [_plane_summary(plane) for plane in self.planes],
        }


def map_workspace(
    robot: Robot, progress: Progress | None = None, points: int = POINTS
) -> WorkspaceMap:
    """Map planes of poses around home.

    The planes are x-y at three heights, or at three angles for a planar platform, and alpha-beta at
    three gamma. Planes for which the platform lacks a freedom are left out. The other components
    have their values at home.

    The half side of a plane is the displacement at which the most sensitive joint reaches its
    travel limit, according to the Jacobian at home. For angles it is 1.3 times this displacement
    divided by the characteristic length. The fixed component is at home, and 0.4 half sides to both
    sides.
    """
    progress = progress or SilentProgress()
    length = robot.geometry.characteristic_length
    axes = robot.geometry.chart.freedoms
    step = robot.travel_limit / float(np.abs(robot.pose_jacobian(robot.home_pose)[:, :3]).max())
    turn = 1.3 * step / length
    layout = [shown for shown in ((0, 1, 2), (0, 1, 5), (3, 4, 5)) if set(shown) <= set(axes)]
    # The x-y plane at three angles is for planar platforms, which have no height to vary.
    if (0, 1, 2) in layout and (0, 1, 5) in layout:
        layout.remove((0, 1, 5))
    planes = []
    with progress.stage("workspace", 3 * len(layout) + 2) as advance:
        for across, up, fixed in layout:
            for offset in (-0.4, 0.0, 0.4):
                side = step if across < 3 else turn
                beyond = step if fixed < 3 else turn
                planes.append(_plane(robot, (across, up, fixed), side, offset * beyond, points))
                advance()
        ranges = np.array([_range(robot, axis, step if axis < 3 else turn) for axis in axes])
        advance()
        travel = workspace.measure_travel(robot, JOINT_SAMPLES)
        advance()
    unit = robot.layout.joint_unit
    home = workspace.measure(robot, robot.home_pose)
    return WorkspaceMap(robot.name, unit, axes, length, tuple(planes), ranges, home, travel)


def _plane(
    robot: Robot, axes: tuple[int, int, int], side: float, offset: float, points: int
) -> WorkspacePlane:
    across, up, fixed = axes
    steps = np.linspace(-side, side, points)
    poses = np.tile(robot.home_pose, (points, points, 1))
    poses[..., across] += steps[None, :]
    poses[..., up] += steps[:, None]
    poses[..., fixed] += offset
    measures = workspace.measure(robot, poses.reshape(-1, 6))
    grid = (points, points)
    return WorkspacePlane(
        *axes,
        float(robot.home_pose[fixed] + offset),
        robot.home_pose[across] + steps,
        robot.home_pose[up] + steps,
        measures.travel_share.reshape(grid),
        measures.joint_condition.reshape(grid),
        measures.reach_margin.min(axis=1).reshape(grid),
    )


def _range(robot: Robot, axis: int, side: float, points: int = 4001) -> tuple[float, float]:
    """Return the largest negative and positive change of a pose component from home.

    The change ends at the travel limit or the reach, and is at most three times `side`.
    """
    steps = np.linspace(0, 3 * side, points)
    ends = []
    for sign in (-1.0, 1.0):
        poses = robot.home_pose + sign * steps[:, None] * np.eye(6)[axis]
        used = workspace.measure(robot, poses).travel_share
        # NaN means out of reach, and counts as outside.
        outside = ~(used <= 1)
        farthest = max(int(np.argmax(outside)) - 1, 0) if outside.any() else -1
        ends.append(sign * float(steps[farthest]))
    return ends[0], ends[1]


def _extremes(measures: workspace.WorkspaceMeasures, unit: str) -> dict[str, float]:
    name = "largest_angle_rad" if unit == "rad" else "largest_length_m"
    return {
        name: float(np.abs(measures.theta).max()),
        "least_reach_margin": float(measures.reach_margin.min()),
        "least_leverage_J_a1": float(measures.leverage.min()),
        "largest_condition_J_a2": float(measures.platform_condition.max()),
        "largest_condition_J_ad": float(measures.joint_condition.max()),
    }


def _plane_summary(plane: WorkspacePlane) -> dict[str, Any]:
    inside = plane.condition[plane.allowed]
    return {
        "axes": [AXES[plane.across], AXES[plane.up]],
        AXES[plane.fixed]: plane.value,
        "from": [float(plane.horizontal[0]), float(plane.vertical[0])],
        "to": [float(plane.horizontal[-1]), float(plane.vertical[-1])],
        "share_in_reach": float((plane.reach_margin > 0).mean()),
        "share_within_travel": float(plane.allowed.mean()),
        "largest_condition_J_ad_within_travel": float(inside.max()) if inside.size else None,
    }


def travel_figure(workspace: WorkspaceMap) -> Figure:
    """Draw the largest joint coordinate as a fraction of the travel limit."""
    title = (
        f"{workspace.robot}: travel used, largest |θ| / {workspace.home.travel_limit:.4f} "
        f"{workspace.unit}"
    )
    return _maps(workspace, "travel_share", title, "largest |θ| / travel limit", Normalize(0, 1.5))


def conditioning_figure(workspace: WorkspaceMap) -> Figure:
    """Draw the condition number of the joint Jacobian.

    Rotations are scaled by the characteristic length.
    """
    length = f"rotations × {workspace.characteristic_length_m:.3g} m"
    title = f"{workspace.robot}: condition of the joint Jacobian J_ad ({length})"
    return _maps(workspace, "condition", title, "condition of J_ad", LogNorm(1, 30))


def _maps(
    workspace: WorkspaceMap, quantity: str, title: str, label: str, norm: Normalize
) -> Figure:
    """Draw a panel for each plane: the quantity as colour, travel limit and reach as lines."""
    figure = Figure(figsize=(12, 8), layout="constrained")
    panels = figure.subplots(-(-len(workspace.planes) // COLUMNS), COLUMNS, squeeze=False)
    for axes, plane in zip(panels.flat, workspace.planes, strict=False):
        shown = _panel(axes, plane, getattr(plane, quantity), norm)
    figure.colorbar(shown, ax=panels, label=label, extend="max")
    figure.suptitle(f"{title}\nsolid: travel limit, dashed: reach of a leg (blank beyond)")
    return figure


def _panel(axes: Axes, plane: WorkspacePlane, values: np.ndarray, norm: Normalize) -> QuadMesh:
    across = 1e3 * plane.horizontal
    up = 1e3 * plane.vertical
    shown = axes.pcolormesh(
        across, up, values, norm=norm, cmap="viridis", shading="nearest", rasterized=True
    )
    for field, level, style, colour in (
        (plane.travel_share, 1.0, "-", "white"),
        (plane.reach_margin, 0.0, "--", "k"),
    ):
        finite = field[np.isfinite(field)]
        # Matplotlib would warn about a level without a contour.
        if finite.size and finite.min() < level < finite.max():
            axes.contour(
                across, up, field, [level], linestyles=style, colors=colour, linewidths=1.5
            )
    axes.set(
        xlabel=f"{COMPONENTS[plane.across]} [{_unit(plane.across)}]",
        ylabel=f"{COMPONENTS[plane.up]} [{_unit(plane.up)}]",
        title=f"{COMPONENTS[plane.fixed]} = {1e3 * plane.value:.4g} {_unit(plane.fixed)}",
        aspect="equal",
    )
    return shown


def _unit(component: int) -> str:
    return "mm" if component < 3 else "mrad"
