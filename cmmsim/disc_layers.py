"""Discs of a scene in one camera, and how they are laid over its windows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .ellipse_coverage import covered_area
from .pose import Array
from .projected_disc import project_discs
from .views import NEAR, Drawable, View

PROBES = 8  # points on a disc's rim, asked with its middle whether a solid hides them


@dataclass(frozen=True)
class DiscsInView:
    """Discs turned towards one camera, far to near and outer before inner.

    centres (m,2) and shapes (m,2,2) of their ellipses, px; reach (m,2) half extents along x and y, px; levels (m,);
    owners (m,) body index; probes (m,k,3) points of each in camera axes, m.
    """

    centres: Array
    shapes: Array
    reach: Array
    levels: Array
    owners: NDArray[np.int_]
    probes: Array


class DiscTable:
    """All discs of a drawable in the axes of their bodies."""

    def __init__(self, drawable: Drawable) -> None:
        rows = [(disc, body) for patch, body in zip(drawable.patches, drawable.body_index, strict=True)
                for disc in patch.discs]
        self._places = np.array([d.centre for d, _ in rows]).reshape(-1, 3)
        self._normals = np.array([d.normal for d, _ in rows]).reshape(-1, 3)
        self._radii = np.array([d.radius for d, _ in rows])
        self._levels = np.array([d.level for d, _ in rows])
        self._owners = np.array([body for _, body in rows], dtype=int)

    def seen(self, view: View) -> DiscsInView:
        """The discs that face a view's camera."""
        moves = view.camera_from_bodies[self._owners]
        centres = np.einsum("nij,nj->ni", moves[:, :3, :3], self._places) + moves[:, :3, 3]
        normals = np.einsum("nij,nj->ni", moves[:, :3, :3], self._normals)
        facing = (np.einsum("ni,ni->n", centres, normals) < 0.0) & (centres[:, 2] - self._radii > NEAR)
        kept = np.flatnonzero(facing)
        kept = kept[np.lexsort((-self._radii[kept], -np.round(centres[kept, 2], 3)))]
        centres, normals, radii = centres[kept], normals[kept], self._radii[kept]
        pixels, shapes = project_discs(view.camera, centres, normals, radii)
        across = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        angles = 2.0 * np.pi * np.arange(PROBES) / PROBES
        rim = (np.cos(angles)[:, None] * across[:, None] + np.sin(angles)[:, None] * np.cross(normals, across)[:, None])
        probes = centres[:, None] + radii[:, None, None] * np.concatenate([np.zeros_like(rim[:, :1]), rim], axis=1)
        return DiscsInView(pixels, shapes, np.linalg.norm(shapes, axis=2), self._levels[kept], self._owners[kept],
                           probes)


def lay_discs(images: NDArray[np.float32], group: NDArray[np.int_], corners: Array, discs: DiscsInView,
              behind: list[list[int]], covers: Mapping[tuple[int, int], NDArray[np.float32]]) -> None:
    """Lay discs over the windows ``images[group]`` (n, h, w) with first pixels ``corners`` (len(group), 2).

    behind: for each disc the solids before it; covers: (view, solid) -> share (h, w) of its window.
    """
    size = np.array(images.shape[:0:-1])
    gap = discs.centres - corners[:, None]
    views, which = np.nonzero(np.all((gap + discs.reach > -0.5) & (gap - discs.reach < size - 0.5), axis=2))
    side = np.minimum(2 * np.ceil(discs.reach.max(axis=1)).astype(int) + 2, size.min())[which]
    centres = gap[views, which]
    first = np.clip(np.rint(centres - 0.5 * (side[:, None] - 1)).astype(int), 0, size - side[:, None])
    rank = np.arange(len(views)) - np.searchsorted(views, views)
    for turn, cell in sorted(set(zip(rank.tolist(), side.tolist(), strict=True))):
        now = np.flatnonzero((rank == turn) & (side == cell))
        share = covered_area(centres[now] - first[now], discs.shapes[which[now]], cell).astype(np.float32)
        ticks = np.arange(cell)
        rows, columns = first[now, 1, None] + ticks, first[now, 0, None] + ticks
        for k, pair in enumerate(now):
            for solid in behind[which[pair]]:
                if (group[views[pair]], solid) in covers:
                    share[k] *= 1.0 - covers[group[views[pair]], solid][np.ix_(rows[k], columns[k])]
        at = group[views[now], None, None], rows[:, :, None], columns[:, None, :]
        images[at] += share * (discs.levels[which[now], None, None].astype(np.float32) - images[at])
