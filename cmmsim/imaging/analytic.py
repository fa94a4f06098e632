"""Drawing without OpenGL: each disc covers exactly its share of each pixel.

Layers are laid over each other: background, solids from far to near, discs. A disc turned away is not drawn. Where a
solid stands before any of a disc's probed points, the disc shows only outside of that solid's outline. Simplified
against `pyrender`: solids are convex hulls, ordered by the depth of their middles, and their edges are sampled by scan
lines; in a pixel with the edges of two layers the covered shares are taken as independent.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.disc_image import project_discs
from cmmsim.geometry.pose import Array
from cmmsim.imaging.renderer import NEAR, Drawable, Renderer, View, same_exposure
from cmmsim.imaging.scene import ConvexSolid, DiscStack, Mesh

if TYPE_CHECKING:
    from cmmsim.imaging.kernels import Discs, Solids

PROBES = 8  # points on a disc's rim, asked with its middle whether a solid hides them


def draw_windows(
    drawable: Drawable, views: Sequence[View], supersampling: int, background: float = 0.0
) -> NDArray[np.float32]:
    """Radiance (n, h, w) float32, 0 to 1, of n windows of one size; ``supersampling``: scan lines a pixel at edges."""
    if drawable not in _SCENES:
        _SCENES[drawable] = _AnalyticScene(drawable)
    scene = _SCENES[drawable]
    width, height = views[0].size
    images = np.full((len(views), height, width), background, dtype=np.float32)
    for group in same_exposure(views):
        scene.draw(images, views, group, supersampling)
    return images


ANALYTIC = Renderer("analytic", draw_windows)


class _AnalyticScene:
    """Discs, in the axes of their bodies, and solids of a drawable."""

    def __init__(self, drawable: Drawable) -> None:
        rows = [
            (disc, body)
            for patch, body in zip(drawable.patches, drawable.body_index, strict=True)
            if isinstance(patch, DiscStack)
            for disc in patch.discs
        ]
        self._places = np.array([d.centre for d, _ in rows]).reshape(-1, 3)
        self._normals = np.array([d.normal for d, _ in rows]).reshape(-1, 3)
        self._radii = np.array([d.radius for d, _ in rows])
        self._disc_levels = np.array([d.level for d, _ in rows])
        self._owners = np.array([body for _, body in rows], dtype=int)
        solids = {k: p for k, p in enumerate(drawable.patches) if isinstance(p, Mesh)}
        self._solids = [ConvexSolid(mesh.vertices) for mesh in solids.values()]
        self._bodies = drawable.body_index[list(solids)]
        self._levels = [float(mesh.levels[0]) for mesh in solids.values()]

    def draw(self, images: NDArray[np.float32], views: Sequence[View], group: list[int], lines: int) -> None:
        """Draw the views ``group``, which share a camera and an exposure, into ``images`` (n, h, w)."""
        from cmmsim.imaging.kernels import lay_layers  # compiles, so it is loaded where it is first needed

        view = views[group[0]]
        discs, hiding = self._discs(view)
        corners = np.array([views[k].corner for k in group], dtype=float)
        lay_layers(images, np.array(group), corners, self._outlined(view, hiding), lines, discs)

    def _discs(self, view: View) -> "tuple[Discs, list[int]]":
        """The discs turned towards a view's camera, far to near and outer before inner; and the solids before them."""
        from cmmsim.geometry.disc_kernels import place_discs, probe_discs
        from cmmsim.imaging.kernels import Discs

        centres, normals = np.empty_like(self._places), np.empty_like(self._places)
        place_discs(view.camera_from_bodies, self._owners, self._places, self._normals, centres, normals)
        facing = (np.einsum("ni,ni->n", centres, normals) < 0.0) & (centres[:, 2] - self._radii > NEAR)
        kept = np.flatnonzero(facing)
        kept = kept[np.lexsort((-self._radii[kept], -np.round(centres[kept, 2], 3)))]
        centres, normals, radii = centres[kept], normals[kept], self._radii[kept]
        pixels, shapes = project_discs(view.camera, centres, normals, radii)
        probes = np.empty((len(kept), PROBES + 1, 3))
        probe_discs(centres, normals, radii, probes)
        hidden_by = self._hiding(view, probes, self._owners[kept])
        nowhere = np.zeros((len(kept), 0), dtype=bool)
        behind = np.stack(list(hidden_by.values()), axis=1) if hidden_by else nowhere
        extents = np.linalg.norm(shapes, axis=2)
        return Discs(pixels, shapes, extents, self._disc_levels[kept], behind), list(hidden_by)

    def _outlined(self, view: View, hiding: list[int]) -> "Solids":
        """The solids in view from far to near; ``hiding``: those whose cover is kept, in the order of their slots."""
        from cmmsim.imaging.kernels import Solids

        moves = [view.camera_from_bodies[b] for b in self._bodies]
        depth = [float(m[2, :3] @ s.middle + m[2, 3]) for m, s in zip(moves, self._solids, strict=True)]
        outlines = {k: self._solids[k].outline(view.camera, moves[k]) for k in np.argsort(depth)[::-1].tolist()}
        shown = {k: outline for k, outline in outlines.items() if outline is not None}
        starts = np.cumsum([0, *(len(outline.half_planes) for outline in shown.values())])
        return Solids(
            np.concatenate([np.zeros((0, 3)), *(outline.half_planes for outline in shown.values())]),
            starts,
            np.array([outline.box for outline in shown.values()]).reshape(-1, 4),
            np.array([self._levels[k] for k in shown]),
            np.array([hiding.index(k) if k in hiding else -1 for k in shown], dtype=int),
        )

    def _hiding(self, view: View, probes: Array, owners: NDArray[np.int_]) -> dict[int, NDArray[np.bool_]]:
        """Solids that stand before one of the discs' ``probes`` (m,k,3), and before which (m,) of other bodies."""
        hiding = {}
        for k, (solid, body) in enumerate(zip(self._solids, self._bodies, strict=True)):
            move = view.camera_from_bodies[body]
            if move[2, 3] < -NEAR:
                continue
            behind = solid.hides(move, probes).any(axis=1) & (owners != body)
            if behind.any():
                hiding[k] = behind
        return hiding


_SCENES: WeakKeyDictionary[Drawable, _AnalyticScene] = WeakKeyDictionary()
