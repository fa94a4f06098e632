"""Drawing without OpenGL: each disc covers exactly its share of each pixel.

Layers are laid over each other: background, solids from far to near, discs. A disc turned away is not drawn. Where a
solid stands before any of a disc's probed points, the disc shows only outside of that solid's outline. Simplified
against `pyrender`: solids are convex hulls, ordered by the depth of their middles, and their edges are sampled by scan
lines; in a pixel with the edges of two layers the covered shares are taken as independent.
"""

from __future__ import annotations

from collections.abc import Sequence
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from .convex_solid import ConvexSolid
from .disc_layers import DiscsInView, DiscTable, lay_discs
from .views import NEAR, Drawable, View

Covers = dict[tuple[int, int], NDArray[np.float32]]


def draw_windows(drawable: Drawable, views: Sequence[View], supersampling: int,
                 background: float = 0.0) -> NDArray[np.float32]:
    """Radiance (n, h, w) float32, 0 to 1, of n windows of one size; ``supersampling``: scan lines a pixel at edges."""
    if drawable not in _SCENES:
        _SCENES[drawable] = _AnalyticScene(drawable)
    scene = _SCENES[drawable]
    width, height = views[0].size
    images = np.full((len(views), height, width), background, dtype=np.float32)
    for group in _same_exposure(views):
        scene.draw(images, views, group, supersampling)
    return images


class _AnalyticScene:
    """Discs and solids of a drawable."""

    def __init__(self, drawable: Drawable) -> None:
        solids = [k for k, p in enumerate(drawable.patches) if not p.discs]
        self._discs = DiscTable(drawable)
        self._solids = [ConvexSolid(drawable.patches[k].vertices) for k in solids]
        self._bodies = drawable.body_index[solids]
        self._levels = [float(drawable.patches[k].levels[0]) for k in solids]

    def draw(self, images: NDArray[np.float32], views: Sequence[View], group: list[int], lines: int) -> None:
        """Draw the views ``group``, which share a camera and an exposure, into ``images`` (n, h, w)."""
        view = views[group[0]]
        seen = self._discs.seen(view)
        covers: Covers = {}
        middles = [view.camera_from_bodies[b] @ [*s.vertices.mean(axis=0), 1.0]
                   for b, s in zip(self._bodies, self._solids, strict=True)]
        corners = np.array([views[k].corner for k in group], dtype=float)
        for k in sorted(range(len(self._solids)), key=lambda k: -middles[k][2]):
            self._draw_solid(k, images, view, group, corners, lines, covers)
        behind = self._hidden(view, seen)
        lay_discs(images, np.array(group), corners, seen, behind, covers)

    def _draw_solid(self, k: int, images: NDArray[np.float32], view: View, group: list[int], corners: NDArray,
                    lines: int, covers: Covers) -> None:
        """Lay solid ``k`` over the images, and note its share of each window that it reaches."""
        outline = self._solids[k].outline(view.camera, view.camera_from_bodies[self._bodies[k]])
        if outline is None:
            return
        near = (outline.highest > corners - 0.5) & (outline.lowest < corners - 0.5 + view.size)
        for place in np.flatnonzero(near.all(axis=1)):
            image = images[group[place]]
            if outline.holds(corners[place], view.size):
                share = np.ones_like(image)
                image[:] = self._levels[k]
            else:
                share = outline.cover(corners[place], view.size, lines)
                image += share * (np.float32(self._levels[k]) - image)
            covers[group[place], k] = share

    def _hidden(self, view: View, seen: DiscsInView) -> list[list[int]]:
        """For each seen disc the solids that stand before one of its probed points."""
        behind: list[list[int]] = [[] for _ in seen.owners]
        for k, (solid, body) in enumerate(zip(self._solids, self._bodies, strict=True)):
            move = view.camera_from_bodies[body]
            if move[2, 3] < -NEAR:
                continue
            asked = np.flatnonzero(seen.owners != body)
            hidden = solid.hides(move, seen.probes[asked]).any(axis=1)
            for d in asked[hidden]:
                behind[d].append(k)
        return behind


_SCENES: WeakKeyDictionary[Drawable, _AnalyticScene] = WeakKeyDictionary()


def _same_exposure(views: Sequence[View]) -> list[list[int]]:
    """Indices of the views, grouped by camera and exposure."""
    groups: dict[tuple[int, int], list[int]] = {}
    for k, view in enumerate(views):
        groups.setdefault((id(view.camera), id(view.camera_from_bodies)), []).append(k)
    return list(groups.values())
