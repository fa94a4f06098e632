"""Figure 1 of the paper: the robot, and one of its legs with the vectors of the text."""

from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cmmsim.geometry.pose import apply, invert, pose_to_transform
from dynamics import Robot
from dynamics.bodies import parts_of
from identify.arrays import Array
from identify.paper.exhibit import Exhibit
from identify.reporting.figures.style import BLUE, GREEN, GREY, INK, RED, WIDTH

LEG = 3  # index of the leg that is drawn alone


def leg_points(robot: Robot) -> Array:
    """Return the points B, T and A (legs, 3, 3) of the legs at home, m.

    B lies on the axis of the crank, T joins crank and link, and A joins link and platform.
    """
    rods = parts_of(robot.geometry).rods(robot, robot.home_pose).reshape(-1, 2, 2, 3)
    return np.stack([rods[:, 0, 0], rods[:, 0, 1], rods[:, 1, 1]], axis=1)


def draw(robot: Robot) -> Figure:
    """Draw the robot at home, and one leg of it."""
    points = 1e3 * leg_points(robot)
    home = 1e3 * robot.home_pose[:3]
    figure = Figure(figsize=(WIDTH, 3.5))
    whole: Any = figure.add_axes((-0.1, -0.3, 0.72, 1.5), projection="3d")
    alone: Any = figure.add_axes((0.5, -0.1, 0.55, 1.1), projection="3d")
    for corner, colour in ((0, GREY), (2, INK)):
        outline = np.vstack([points[:, corner], points[:1, corner]])
        whole.plot(*outline.T, color=colour, linewidth=1.6)
    for number, leg in enumerate(points, start=1):
        _leg(whole, leg)
        for name, point in zip("BTA", leg, strict=True):
            whole.text(*point, f" {name}{number}", fontsize=5.5)
    for name, origin in (("O", np.zeros(3)), ("E", home)):
        for axis, direction in zip("xyz", np.eye(3), strict=True):
            whole.quiver(*origin, *(70 * direction), color=INK, linewidth=0.8)
            whole.text(*(origin + 80 * direction), axis, fontsize=6)
        whole.text(*(origin - np.array([12, 12, 0])), name, fontsize=8)
    _one(alone, points[LEG], home)
    figure.text(0.02, 0.94, "(a) the robot at home")
    figure.text(0.58, 0.94, f"(b) leg {LEG + 1}")
    for axes in (whole, alone):
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_axis_off()
    # The view is along the normal of the leg's plane, so that both rods have their full length.
    base, tip, joint = points[LEG]
    normal = np.cross(joint - tip, tip - base)
    normal *= np.sign(normal[2]) / np.linalg.norm(normal)
    azimuth = np.degrees(np.arctan2(normal[1], normal[0]))
    alone.view_init(elev=np.degrees(np.arcsin(normal[2])), azim=azimuth)
    return figure


def _leg(axes: Any, leg: Array) -> None:
    """Draw crank and link between the points B, T and A of a leg."""
    axes.plot(*leg[:2].T, color=RED, linewidth=2.2)
    axes.plot(*leg[1:].T, color=BLUE, linewidth=1.4)
    axes.scatter(*leg[1:].T, color=INK, s=6, depthshade=False)


def _one(axes: Any, leg: Array, home: Array) -> None:
    """Draw one leg with the points and vectors of the text, and the middles of its rods."""
    _leg(axes, leg)
    base, tip, joint = leg
    for name, point in zip(("Bᵢ", "Tᵢ", "Aᵢ"), leg, strict=True):
        axes.text(*point, f"  {name}", fontsize=8)
    vectors = {"wᵢ": (base, tip), "lᵢ": (tip, joint), "aᵢ": (home, joint)}
    axes.plot(*np.array([home, joint]).T, color=GREEN, linestyle="--", linewidth=1.0)
    for name, ends in vectors.items():
        axes.text(*np.mean(ends, axis=0), f"  {name}", fontsize=8, fontweight="bold")
    for name, ends in (("c_w", (base, tip)), ("c_l", (tip, joint))):
        axes.scatter(*np.mean(ends, axis=0), marker="x", color=INK, s=16)
        axes.text(*(np.mean(ends, axis=0) - np.array([0, 0, 16])), name, fontsize=6, ha="right")
    axes.quiver(*base, 0, 0, 60, color=INK, linewidth=0.9)
    axes.text(*(base + np.array([0, 0, 66])), "ŝ, θᵢ", fontsize=7)
    axes.text(*home, " E", fontsize=8)


def exhibit(robot: Robot) -> Exhibit:
    """Return figure 1, with the positions of all legs' joints at home as its numbers."""
    points = 1e3 * leg_points(robot)
    in_platform = apply(invert(pose_to_transform(robot.home_pose)), points[:, 2] / 1e3)
    columns: dict[str, Any] = {"leg": range(1, len(points) + 1)}
    for k, name in enumerate(("B crank axis", "T crank to link", "A platform joint")):
        for i, axis in enumerate("xyz"):
            columns[f"{name} {axis} [mm]"] = points[:, k, i]
    for i, axis in enumerate("xyz"):
        columns[f"a in the platform frame {axis} [mm]"] = 1e3 * in_platform[:, i]
    return Exhibit(
        "Figure 1",
        "Sketch of the 6-RSS robot, and of one leg",
        "Six legs, each with a wrench (here: crank) that turns about a vertical axis, and a link "
        "between two ball joints. No lengths are given.",
        "The robot rss6, whose geometry was chosen to fit the paper's gains, limit of travel and "
        "masses. These numbers are therefore not those of the paper's robot.",
        columns,
        partial(draw, robot),
    )
