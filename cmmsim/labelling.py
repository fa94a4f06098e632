"""Which measured point is which sticker: search for the rigid layout in a cloud of points, with no prior pose.

Three stickers far from each other are looked for by their three mutual distances; each find proposes a pose, which is
judged by how many stickers of the layout then have a measured point close by.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from .errors import LostError
from .pose import Array, apply
from .registration import rigid_start

SMALLEST_TRIANGLE = 0.002  # m² area
ENOUGH = 0.8  # share of the layout that ends the search


def find_layout(layout: Array, points: Array, tolerance: float, fewest: int,
                name: str) -> tuple[Array, NDArray[np.int_], NDArray[np.int_]]:
    """Pose of a layout in a cloud of points.

    Parameters: layout (n,3) m in body axes; points (m,3) m in the camera frame; tolerance in m of the layout's places;
    fewest stickers to be found.
    Returns camera_from_body (4,4), and the indices of the stickers (k,) and of their points (k,).
    Raises LostError when fewer are found, or two different poses explain the points about equally well.
    """
    gaps = np.linalg.norm(points[:, None] - points[None], axis=2)
    best: tuple[Array, NDArray[np.int_], NDArray[np.int_]] | None = None
    rival = 0
    for triple in _triangles(layout):
        for corners in _congruent(gaps, layout[list(triple)], 2.0 * tolerance):
            start = rigid_start(layout[list(triple)], points[corners])
            found = _assign(start, layout, points, tolerance)
            if len(found[1]) < 3:
                continue
            found = _assign(rigid_start(layout[found[1]], points[found[2]]), layout, points, tolerance)
            if best is None or len(found[1]) > len(best[1]):
                if best is not None and not _same(best[0], found[0], layout, tolerance):
                    rival = max(rival, len(best[1]))
                best = found
            elif not _same(best[0], found[0], layout, tolerance):
                rival = max(rival, len(found[1]))
        if best is not None and len(best[1]) >= ENOUGH * len(layout):
            break
    count = 0 if best is None else len(best[1])
    if best is None or count < fewest:
        raise LostError(f"{name}: {count} of {len(layout)} stickers recognised among {len(points)} points, "
                        f"at least {fewest} needed")
    if rival > count - 2:
        raise LostError(f"{name}: two poses explain the points, with {count} and {rival} stickers")
    return best


def _triangles(layout: Array) -> list[tuple[int, int, int]]:
    """Triples of stickers with a large triangle, in a fixed mixed order."""
    triples = [t for t in combinations(range(len(layout)), 3)
               if np.linalg.norm(np.cross(layout[t[1]] - layout[t[0]], layout[t[2]] - layout[t[0]]))
               > 2.0 * SMALLEST_TRIANGLE]
    order = np.random.default_rng(0).permutation(len(triples))
    return [triples[k] for k in order]


def _congruent(gaps: Array, corners: Array, tolerance: float) -> list[list[int]]:
    """All ordered triples of points whose distances (``gaps``, (m,m)) are those of three corners (3,3)."""
    d01, d02, d12 = (np.linalg.norm(corners[a] - corners[b]) for a, b in ((0, 1), (0, 2), (1, 2)))
    first, second = np.nonzero(np.abs(gaps - d01) < tolerance)
    fits = (np.abs(gaps[first] - d02) < tolerance) & (np.abs(gaps[second] - d12) < tolerance)
    pair, third = np.nonzero(fits)
    return np.column_stack([first[pair], second[pair], third]).tolist()


def _assign(transform: Array, layout: Array, points: Array,
            tolerance: float) -> tuple[Array, NDArray[np.int_], NDArray[np.int_]]:
    """Stickers with a measured point within the tolerance, each point used once."""
    distance = np.linalg.norm(apply(transform, layout)[:, None] - points[None], axis=2)
    nearest = distance.argmin(axis=1)
    mutual = distance.argmin(axis=0)[nearest] == np.arange(len(layout))
    stickers = np.flatnonzero(mutual & (distance.min(axis=1) < 1.5 * tolerance))
    return transform, stickers, nearest[stickers]


def _same(first: Array, second: Array, layout: Array, tolerance: float) -> bool:
    """Whether two poses put the layout in the same place."""
    return bool(np.linalg.norm(apply(first, layout) - apply(second, layout), axis=1).max() < 4.0 * tolerance)
