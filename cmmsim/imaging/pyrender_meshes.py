"""Meshes for pyrender: stickers with soft rims, and windows that are drawn without depth tests.

**Soft discs.** A sharp rim would show aliasing, because a pixel has few drawn samples. Therefore
the level of the uppermost disc changes gradually to the level around it, over a band that is
RIM_SAMPLES sample distances wide. This band changes neither the disc's centre nor its total light.
Such a soft rim needs fewer samples than a sharp rim for the same accuracy.

**Painter's order.** A window needs no depth test if it shows one solid and at most one stack of
discs that lies on the solid. The solid is drawn first, then the discs. If the camera stands in
front of the plane of a disc, it sees the disc, because the whole solid lies behind that plane.

If the solid fills the window, the background is not visible, and the dark ring of a sticker often
fills most of the window. Such a window is cleared to the ring's level, and only a band of the solid
around the ring is drawn. The image is the same, but far fewer pixels are drawn.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from cmmsim.geometry.pose import Array, frozen
from cmmsim.imaging.renderer import FAR, NEAR, Drawable, Exposure, Views
from cmmsim.imaging.scene_bodies import ConvexSolid, Disc, DiscStack, Mesh

RIM_SAMPLES = 1.8
# Largest distance between a side of the polygon and the rim, in samples.
LARGEST_SAG = 0.08
# Smallest number of sides of the uppermost disc, and number of sides of the discs below it.
FEWEST_SIDES = 16
GROUND_SIDES = 16
# Ratio of the outer radius of a band to the radius of the ring inside it.
BAND_REACH = 5.0
# px: margin around a window that the solid must fill as well, to be safe against rounding.
RIM_PX = 0.5
# m: smallest height of a disc above what lies below it, and of the camera above a disc's plane, for
# drawing without a depth test.
CLEARANCE = 1e-6
# Smallest ratio of a solid's volume to that of a cube with the solid's longest side. Flatter solids
# are drawn with a depth test.
FLATTEST = 1e-6
# Smallest slope between a ray and a disc's plane. Flatter rays count as parallel to the plane.
SMALLEST_SLOPE = 1e-3
# Signs that enlarge bounds (lowest x, y, highest x, y), and indices of the corners into bounds.
OUTWARDS = frozen([-1.0, -1.0, 1.0, 1.0])
CORNERS = [[0, 1], [2, 1], [0, 3], [2, 3]]


def disc_mesh(stack: DiscStack, sample: float) -> Mesh:
    """Return the triangles of a stack of discs for drawing with samples ``sample`` m apart.

    The upper discs come first. The uppermost disc has a soft rim if another disc lies below it. The
    lower discs are polygons with few sides and sharp rims.
    """
    *grounds, top = stack.discs
    uppermost = (
        _soft_disc(top, grounds[-1].level, sample)
        if grounds
        else _sharp_disc(top, _sides(top.radius, sample))
    )
    return _joined([uppermost, *(_sharp_disc(disc, GROUND_SIDES) for disc in reversed(grounds))])


def ringed_mesh(stack: DiscStack, sample: float, level: float) -> Mesh:
    """Return the triangles of a stack for a window that is cleared to the lowest disc's level.

    The triangles are as in ``disc_mesh``, but a band around the lowest disc replaces this disc. The
    band has the ``level`` of the solid. The stack must have at least two discs.
    """
    lowest, *grounds = stack.discs[:-1]
    corners = [_corners(lowest, reach * lowest.radius, GROUND_SIDES) for reach in (1.0, BAND_REACH)]
    band = Mesh(
        np.concatenate(corners), _band_triangles(GROUND_SIDES), np.full(2 * GROUND_SIDES, level)
    )
    around = (grounds[-1] if grounds else lowest).level
    uppermost = _soft_disc(stack.discs[-1], around, sample)
    return _joined(
        [uppermost, *(_sharp_disc(disc, GROUND_SIDES) for disc in reversed(grounds)), band]
    )


def _joined(pieces: Sequence[Mesh]) -> Mesh:
    first = np.cumsum([0, *(len(p.vertices) for p in pieces)])
    return Mesh(
        np.concatenate([p.vertices for p in pieces]),
        np.concatenate([p.faces + start for p, start in zip(pieces, first, strict=False)]),
        np.concatenate([p.levels for p in pieces]),
    )


def _soft_disc(disc: Disc, around: float, sample: float) -> Mesh:
    """Return a disc whose level changes to the level ``around`` within a band at its rim."""
    width = min(RIM_SAMPLES * sample, disc.radius)
    middle = np.sqrt(disc.radius**2 - width**2 / 12.0)  # same total light as the sharp disc
    sides = _sides(disc.radius, sample)
    corners = np.concatenate(
        [_corners(disc, middle - 0.5 * width, sides), _corners(disc, middle + 0.5 * width, sides)]
    )
    triangles = np.concatenate([_balanced_triangles(sides), _band_triangles(sides)])
    return Mesh(
        corners, triangles, np.concatenate([np.full(sides, disc.level), np.full(sides, around)])
    )


def _sharp_disc(disc: Disc, sides: int) -> Mesh:
    return Mesh(
        _corners(disc, disc.radius, sides), _balanced_triangles(sides), np.full(sides, disc.level)
    )


def _sides(radius: float, sample: float) -> int:
    """Return the number of sides of a polygon within LARGEST_SAG samples of a circle."""
    return max(FEWEST_SIDES, int(np.ceil(np.pi * np.sqrt(radius / (2.0 * LARGEST_SAG * sample)))))


def _corners(disc: Disc, radius: float, sides: int) -> Array:
    """Return corners (sides, 3) of a polygon in a disc's plane that has the area of a circle."""
    u, v = np.linalg.svd(disc.normal[None])[2][1:]
    angles = 2.0 * np.pi * (np.arange(sides) + 0.5) / sides
    # With the same area, polygon and circle have the same total light.
    fill = np.sqrt(2.0 * np.pi / (sides * np.sin(2.0 * np.pi / sides)))
    return disc.centre + fill * radius * (np.cos(angles)[:, None] * u + np.sin(angles)[:, None] * v)


def _band_triangles(sides: int) -> NDArray[np.int_]:
    """Return triangles (2 sides, 3) between an inner and an outer polygon of ``sides`` corners."""
    here = np.arange(sides)
    there = np.roll(np.arange(sides), -1)
    return np.concatenate(
        [
            np.column_stack([here, there, sides + here]),
            np.column_stack([there, sides + there, sides + here]),
        ]
    )


def _balanced_triangles(sides: int) -> NDArray[np.int_]:
    """Return triangles (sides - 2, 3) of a convex polygon, with large triangles in the middle.

    Large triangles are faster to draw than a fan of thin triangles.
    """
    triangles: list[tuple[int, int, int]] = []
    arcs = [(0, sides - 1)]
    while arcs:
        start, end = arcs.pop()
        if end - start >= 2:
            middle = (start + end) // 2
            triangles.append((start, middle, end))
            arcs += [(start, middle), (middle, end)]
    return np.array(triangles)


@dataclass(frozen=True)
class PaintedWindows:
    """Windows that can be drawn in painter's order, without a depth test.

    ``solid`` (n,) is the index of the only solid in a window, or -1 if a depth test is needed.
    ``filled`` (n,) is True if this solid fills the window. ``ringed`` (n,) is the index of a stack
    of discs if the window can be cleared to the level of the lowest disc, and otherwise -1. The
    indices are those of the drawable's patches.
    """

    solid: NDArray[np.int_]
    filled: NDArray[np.bool_]
    ringed: NDArray[np.int_]


class PaintedSolids:
    """Convex solids of a drawable, each of one level, and the stacks of discs that lie on them.

    ``levels`` (patches,) has the level of each such solid, the level of the lowest disc of each
    stack, and NaN for other patches.
    """

    def __init__(self, drawable: Drawable) -> None:
        patches = drawable.patches
        self._body_index = drawable.body_index
        self._solids = {
            k: ConvexSolid(p.vertices)
            for k, p in enumerate(patches)
            if isinstance(p, Mesh) and _is_plain_convex(p)
        }
        self.levels = np.array(
            [
                p.discs[0].level
                if isinstance(p, DiscStack)
                else p.levels[0]
                if k in self._solids
                else np.nan
                for k, p in enumerate(patches)
            ]
        )
        lowest = [
            p.discs[0] if isinstance(p, DiscStack) and len(p.discs) > 1 else None for p in patches
        ]
        self._ring_centres = np.array(
            [np.zeros(3) if ring is None else ring.centre for ring in lowest]
        )
        # Radius of the circle that the outer polygon of a band encloses, in radii of the ring.
        inside = BAND_REACH * np.cos(np.pi / GROUND_SIDES)
        self._ring_reach = np.array(
            [0.0 if ring is None else inside * ring.radius for ring in lowest]
        )
        self._normals = np.array(
            [p.discs[-1].normal if isinstance(p, DiscStack) else np.zeros(3) for p in patches]
        )
        self._heights = np.array(
            [
                p.discs[-1].centre @ p.discs[-1].normal if isinstance(p, DiscStack) else 0.0
                for p in patches
            ]
        )
        self._lying = {
            k: np.array(
                [
                    isinstance(p, DiscStack)
                    and body == self._body_index[k]
                    and _lies_over(p, solid.vertices)
                    for p, body in zip(patches, self._body_index, strict=True)
                ]
            )
            for k, solid in self._solids.items()
        }

    def painted(self, views: Views, reaching: NDArray[np.bool_]) -> PaintedWindows:
        """Tell which windows need no depth test; ``reaching`` comes from `Drawable.reaching`."""
        laid = PaintedWindows(
            np.full(len(views), -1), np.zeros(len(views), dtype=bool), np.full(len(views), -1)
        )
        # Windows into which at most two patches reach, such as a solid and a stack of discs.
        few = reaching.sum(axis=1) <= 2
        bounds = views.bounds
        for shown in views.exposures:
            group = shown.windows
            for k in self._solids:
                members = group[few[group] & reaching[group, k]]
                if len(members):
                    others = reaching[members] & ~self._seen_over(k, shown)
                    alone = members[~others.any(axis=1)]
                    laid.solid[alone] = k
                    rays = np.ones((len(alone), 4, 3))
                    corners = (bounds[alone] + RIM_PX * OUTWARDS)[:, CORNERS]
                    rays[..., :2] = (corners - shown.camera.centre) / shown.camera.focal_lengths
                    laid.filled[alone] = self._fills(k, shown, rays)
                    others = reaching[alone]
                    others[:, k] = False
                    stack = others.argmax(axis=1)
                    banded = (
                        laid.filled[alone]
                        & others.any(axis=1)
                        & self._banded(stack, k, shown, rays)
                    )
                    laid.ringed[alone[banded]] = stack[banded]
        return laid

    def carrier(self, stack: int) -> int | None:
        """Return the index of the solid on which a stack of two or more discs lies, or None."""
        return next(
            (k for k in self._solids if self._ring_reach[stack] > 0.0 and self._lying[k][stack]),
            None,
        )

    def _seen_over(self, solid: int, view: Exposure) -> NDArray[np.bool_]:
        """Return a mask of the patches that can be drawn over a solid without a depth test.

        They are the solid itself and the stacks on it that face the camera.
        """
        move = view.camera_from_bodies[self._body_index[solid]]
        eye = -move[:3, 3] @ move[:3, :3]
        seen = self._lying[solid] & (self._normals @ eye - self._heights > CLEARANCE)
        seen[solid] = True
        return seen

    def _fills(self, solid: int, view: Exposure, rays: Array) -> NDArray[np.bool_]:
        """Tell whether a solid fills windows, given the ``rays`` (n, 4, 3) to their corners.

        The solid is convex, so it fills a window if the rays to all corners meet it. A solid that
        is partly nearer than NEAR or farther than FAR fills no window.
        """
        move = view.camera_from_bodies[self._body_index[solid]]
        depths = self._solids[solid].vertices @ move[2, :3] + move[2, 3]
        if depths.min() <= NEAR or depths.max() >= FAR:
            return np.zeros(len(rays), dtype=bool)
        return np.asarray(self._solids[solid].hides(move, FAR * rays).all(axis=1))

    def _banded(
        self, stacks: NDArray[np.int_], solid: int, view: Exposure, rays: Array
    ) -> NDArray[np.bool_]:
        """Tell whether a band around each stack's lowest disc covers the corners of its window.

        The stacks (n,) lie on the solid. The corners lie on ``rays`` (n, 4, 3).
        """
        move = view.camera_from_bodies[self._body_index[solid]]
        # Vectors from the camera to the rings' centres, in the axes of the body.
        to_centres = self._ring_centres[stacks] + move[:3, 3] @ move[:3, :3]
        along = rays @ move[:3, :3]
        normals = self._normals[stacks]
        slopes = np.einsum("nci,ni->nc", along, normals)
        scales = np.einsum("ni,ni->n", normals, to_centres)[:, None] / np.minimum(
            slopes, -SMALLEST_SLOPE
        )
        beside = scales[..., None] * along - to_centres[:, None]
        within = np.einsum("nci,nci->nc", beside, beside) < self._ring_reach[stacks, None] ** 2
        return np.asarray((within & (slopes < -SMALLEST_SLOPE)).all(axis=1))


def _is_plain_convex(mesh: Mesh) -> bool:
    """Tell whether a mesh is the closed surface of a convex solid and has a single level."""
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
    if not solid.is_watertight or np.ptp(mesh.levels) > 0.0:
        return False
    volume = abs(float(solid.volume))
    return (
        volume > FLATTEST * float(np.max(solid.extents)) ** 3
        and volume > (1.0 - 1e-9) * solid.convex_hull.volume
    )


def _lies_over(stack: DiscStack, vertices: Array) -> bool:
    """Tell whether the discs are parallel, in rising order, and all above the vertices (n, 3)."""
    normal = stack.discs[0].normal
    heights = np.array([disc.centre @ normal for disc in stack.discs])
    parallel = all(np.allclose(disc.normal, normal, rtol=0.0, atol=1e-9) for disc in stack.discs)
    return parallel and bool(np.diff(heights, prepend=(vertices @ normal).max()).min() > CLEARANCE)
