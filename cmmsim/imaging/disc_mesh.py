"""Stickers as triangles, softened as far as they are sampled.

The rim of a sharp disc aliases between the samples that a pixel is drawn with. Here the uppermost disc's rim falls off
to the level around it over RIM_SAMPLES distances of samples, which leaves its centre and its light what they are, so
that what is drawn comes close to the disc faster with more samples than that of a sharp rim.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.pose import Array
from cmmsim.imaging.scene import Disc, DiscStack, Mesh

RIM_SAMPLES = 1.8
LARGEST_SAG = 0.08  # samples by which a side of the polygon may fall short of the rim
FEWEST_SIDES, GROUND_SIDES = 16, 16


def disc_mesh(stack: DiscStack, sample: float) -> Mesh:
    """Triangles of discs that are drawn with samples ``sample`` m apart.

    The uppermost disc has a soft rim where another one lies below it; the others are coarse and sharp.
    """
    *grounds, top = stack.discs
    pieces = [
        _soft_disc(top, grounds[-1].level, sample) if grounds else _sharp_disc(top, _sides(top.radius, sample)),
        *(_sharp_disc(disc, GROUND_SIDES) for disc in reversed(grounds)),
    ]
    first = np.cumsum([0, *(len(p.vertices) for p in pieces)])
    return Mesh(
        np.concatenate([p.vertices for p in pieces]),
        np.concatenate([p.faces + start for p, start in zip(pieces, first, strict=False)]),
        np.concatenate([p.levels for p in pieces]),
    )


def _soft_disc(disc: Disc, around: float, sample: float) -> Mesh:
    """A disc whose level falls to that ``around`` it within a band that is laid about its rim."""
    width = min(RIM_SAMPLES * sample, disc.radius)
    middle = np.sqrt(disc.radius**2 - width**2 / 12.0)  # as much light as the sharp disc
    sides = _sides(disc.radius, sample)
    corners = np.concatenate([_corners(disc, middle - 0.5 * width, sides), _corners(disc, middle + 0.5 * width, sides)])
    triangles = np.concatenate([_balanced_triangles(sides), _band_triangles(sides)])
    return Mesh(corners, triangles, np.concatenate([np.full(sides, disc.level), np.full(sides, around)]))


def _sharp_disc(disc: Disc, sides: int) -> Mesh:
    return Mesh(_corners(disc, disc.radius, sides), _balanced_triangles(sides), np.full(sides, disc.level))


def _sides(radius: float, sample: float) -> int:
    """Sides of a polygon that follows a circle to LARGEST_SAG."""
    return max(FEWEST_SIDES, int(np.ceil(np.pi * np.sqrt(radius / (2.0 * LARGEST_SAG * sample)))))


def _corners(disc: Disc, radius: float, sides: int) -> Array:
    """Corners (sides, 3) of the regular polygon in a disc's plane that has the area of the circle."""
    u, v = np.linalg.svd(disc.normal[None])[2][1:]
    angles = 2.0 * np.pi * (np.arange(sides) + 0.5) / sides
    fill = np.sqrt(2.0 * np.pi / (sides * np.sin(2.0 * np.pi / sides)))
    return disc.centre + fill * radius * (np.cos(angles)[:, None] * u + np.sin(angles)[:, None] * v)


def _band_triangles(sides: int) -> NDArray[np.int_]:
    """Triangles (2 sides, 3) between ``sides`` corners and as many around them."""
    here, there = np.arange(sides), np.roll(np.arange(sides), -1)
    return np.concatenate(
        [np.column_stack([here, there, sides + here]), np.column_stack([there, sides + there, sides + here])]
    )


def _balanced_triangles(sides: int) -> NDArray[np.int_]:
    """Triangles (sides - 2, 3) of a convex polygon, large ones inside: faster to draw than a fan of slivers."""
    triangles: list[tuple[int, int, int]] = []
    arcs = [(0, sides - 1)]
    while arcs:
        start, end = arcs.pop()
        if end - start >= 2:
            middle = (start + end) // 2
            triangles.append((start, middle, end))
            arcs += [(start, middle), (middle, end)]
    return np.array(triangles)
