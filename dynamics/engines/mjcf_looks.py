"""What the exported robot looks like: geoms without mass or contact, so that a viewer shows a 6-RSS robot."""

from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import ArrayLike

from dynamics.kinematics.geometry import Rss6Geometry

CRANK_RADIUS, LINK_RADIUS, BALL_RADIUS = 0.010, 0.006, 0.009
PLATE_THICKNESS = 0.012
COLOURS = {
    "base": "0.35 0.37 0.40 1",
    "crank": "0.85 0.45 0.15 1",
    "link": "0.75 0.77 0.80 1",
    "plate": "0.2 0.45 0.7 1",
}


def add_assets(root: Xml.Element) -> None:
    """Sky, light and view, and the colours of the bodies."""
    visual = Xml.SubElement(root, "visual")
    Xml.SubElement(visual, "headlight", ambient="0.4 0.4 0.4", diffuse="0.5 0.5 0.5")
    Xml.SubElement(root, "statistic", center="0 0 0.1", extent="0.6")
    asset = Xml.SubElement(root, "asset")
    sky = {"type": "skybox", "builtin": "gradient", "rgb1": "0.9 0.93 0.97", "rgb2": "0.5 0.55 0.6"}
    Xml.SubElement(asset, "texture", sky, width="64", height="384")
    for name, colour in COLOURS.items():
        Xml.SubElement(asset, "material", name=name, rgba=colour)


def add_base_looks(world: Xml.Element, geometry: Rss6Geometry) -> None:
    """A plate below the cranks and a motor on each crank axis."""
    centre, radius = _disc(geometry.base_joints)
    drop = np.array([0.0, 0.0, 0.05])
    _rod(world, "cylinder", centre - drop, centre - drop - [0, 0, 0.01], radius + 0.04, "base")
    for foot, axis in zip(geometry.base_joints, geometry.crank_axes, strict=True):
        _rod(world, "cylinder", foot - 0.04 * axis, foot + 0.012 * axis, 0.022, "base")


def add_platform_looks(body: Xml.Element, geometry: Rss6Geometry) -> None:
    """A plate through the platform's joints and a ball on each."""
    centre, radius = _disc(geometry.platform_joints)
    half = np.array([0.0, 0.0, PLATE_THICKNESS / 2])
    _rod(body, "cylinder", centre - half, centre + half, radius, "plate")
    for joint in geometry.platform_joints:
        Xml.SubElement(body, "geom", type="sphere", pos=_text(joint), size=_text([BALL_RADIUS]), material="link")


def add_crank_looks(body: Xml.Element, geometry: Rss6Geometry) -> None:
    """A rod along x from the axis to the tip."""
    _rod(body, "capsule", [0, 0, 0], [geometry.crank_length, 0, 0], CRANK_RADIUS, "crank")


def add_link_looks(body: Xml.Element, geometry: Rss6Geometry) -> None:
    """A rod along z from the tip to the platform, with a ball at the tip."""
    _rod(body, "capsule", [0, 0, 0], [0, 0, geometry.link_length], LINK_RADIUS, "link")
    Xml.SubElement(body, "geom", type="sphere", pos="0 0 0", size=_text([BALL_RADIUS]), material="link")


def _disc(points: np.ndarray) -> tuple[np.ndarray, float]:
    centre = points.mean(axis=0)
    return centre, float(np.linalg.norm(points - centre, axis=1).max())


def _rod(parent: Xml.Element, kind: str, start: ArrayLike, end: ArrayLike, radius: float, material: str) -> None:
    ends = np.concatenate([np.asarray(start, dtype=float), np.asarray(end, dtype=float)])
    Xml.SubElement(parent, "geom", type=kind, fromto=_text(ends), size=_text([radius]), material=material)


def _text(values: ArrayLike) -> str:
    return " ".join(f"{value:.6g}" for value in np.asarray(values, dtype=float))
