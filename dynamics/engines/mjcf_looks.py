"""Appearance of a robot in MJCF: geoms that have neither mass nor contact."""

from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import ArrayLike

from dynamics.geometry import RobotGeometry

BALL_RADIUS = 0.009  # m
PLATE_THICKNESS = 0.012  # m
COLOURS = {
    "base": "0.35 0.37 0.40 1",
    "crank": "0.85 0.45 0.15 1",
    "link": "0.75 0.77 0.80 1",
    "plate": "0.2 0.45 0.7 1",
}


def add_assets(root: Xml.Element, geometry: RobotGeometry) -> None:
    """Add sky, light, the size of the view, and the colours of the bodies."""
    points = np.concatenate([geometry.base_joints, geometry.joints_at(geometry.home_pose)])
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    extent = 1.6 * np.linalg.norm(points - centre, axis=1).max()
    visual = Xml.SubElement(root, "visual")
    Xml.SubElement(visual, "headlight", ambient="0.4 0.4 0.4", diffuse="0.5 0.5 0.5")
    Xml.SubElement(root, "statistic", center=numbers_text(centre), extent=numbers_text(extent))
    asset = Xml.SubElement(root, "asset")
    sky = {"type": "skybox", "builtin": "gradient", "rgb1": "0.9 0.93 0.97", "rgb2": "0.5 0.55 0.6"}
    Xml.SubElement(asset, "texture", sky, width="64", height="384")
    for name, colour in COLOURS.items():
        Xml.SubElement(asset, "material", name=name, rgba=colour)


def add_base_looks(world: Xml.Element, geometry: RobotGeometry) -> None:
    """Add geoms that show the base.

    The geoms are a plate behind the legs, as seen from the platform, and one at the foot of each
    leg: a motor on a hinge, a rail along a slide, or a ball in a universal joint.
    """
    centre, radius = disc(geometry.base_joints)
    behind = np.array([0.0, 0.0, -1.0 if geometry.home_pose[2] >= centre[2] else 1.0])
    add_rod(
        world, "cylinder", centre + 0.05 * behind, centre + 0.06 * behind, radius + 0.04, "base"
    )
    for leg in geometry.legs:
        foot = leg.base_joint
        segment = leg.segments()[0]
        if segment.joint == "universal":
            add_ball(world, foot, 0.022)
            continue
        sliding = segment.joint == "slide"
        low, high = (geometry.travel_limit,) * 2 if sliding else (0.04, 0.012)
        ends = foot - low * segment.axis, foot + high * segment.axis
        add_rod(world, "cylinder", *ends, segment.radius if sliding else 0.022, "base")


def disc(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Mean (3,) of points (N, 3), and the largest distance of a point from it, m."""
    centre = points.mean(axis=0)
    return centre, float(np.linalg.norm(points - centre, axis=1).max())


def add_rod(
    parent: Xml.Element, kind: str, start: ArrayLike, end: ArrayLike, radius: float, material: str
) -> None:
    """Add a geom of a kind, such as a capsule, with a radius, m, between two points (3,), m."""
    ends = numbers_text(np.concatenate([start, end]))
    Xml.SubElement(
        parent, "geom", type=kind, fromto=ends, size=numbers_text(radius), material=material
    )


def add_ball(parent: Xml.Element, centre: np.ndarray, radius: float) -> None:
    """Add a sphere."""
    Xml.SubElement(
        parent,
        "geom",
        type="sphere",
        pos=numbers_text(centre),
        size=numbers_text(radius),
        material="link",
    )


def numbers_text(values: ArrayLike) -> str:
    """Numbers as text in the form of MJCF, with all their digits."""
    return " ".join(repr(float(value)) for value in np.atleast_1d(np.asarray(values, dtype=float)))
