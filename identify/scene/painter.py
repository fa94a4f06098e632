"""Painter of bodies as shaded polygons in perspective, for vector graphics without OpenGL.

The polygons are drawn from far to near. Large faces and long lines are cut into small pieces, so
that sorting by the distance of their centres is correct. If two bodies intersect, the result is
correct to the size of a piece.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb, to_rgba
from numpy.typing import NDArray

from cmmsim.geometry.pose import Array

PIECE = 1 / 60  # longest edge of a piece, as a fraction of the size of the scene
# Direction from the scene to the light, in the base frame. Its length does not matter.
LIGHT = np.array([0.35, -0.55, 0.76])
SHADE = 0.62  # brightness of a face without light. A face towards the light has the brightness one.


@dataclass(frozen=True)
class Viewpoint:
    """Direction and distance from which a scene is seen.

    The azimuth is the angle from the x axis about z. The distance is measured from the middle of
    the scene, as a multiple of the size of the scene.
    """

    azimuth_deg: float = -105.0
    elevation_deg: float = 16.0
    distance: float = 3.0


class Painter:
    """Painter that collects shapes and draws them into axes.

    Centre (3,) and size of the scene are in m. A shape is drawn as if it were nearer by
    ``towards``, in m.
    """

    def __init__(self, viewpoint: Viewpoint, centre: Array, size: float) -> None:
        azimuth, elevation = np.deg2rad([viewpoint.azimuth_deg, viewpoint.elevation_deg])
        level = np.cos(elevation)
        back = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
        across = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        self._eye = centre + viewpoint.distance * size * back
        self._axes = np.column_stack([across, np.cross(back, across), back])
        self._far = viewpoint.distance * size
        self._piece = PIECE * size
        self._pieces: list[tuple[float, Array, tuple, tuple, float]] = []

    def pixels(self, points: Array) -> Array:
        """Project points (..., 3) to positions (..., 2) on the paper.

        The positions are in m, to scale at the distance of the middle of the scene.
        """
        seen = (points - self._eye) @ self._axes
        return np.asarray(self._far * seen[..., :2] / -seen[..., 2:], dtype=float)

    def faces(
        self, vertices: Array, faces: NDArray[np.int_], colour: str, towards: float = 0.0
    ) -> None:
        """Add the triangles (m, 3) of a closed body that face the viewer, shaded by the light.

        The corners of a triangle run counter-clockwise, seen from outside.
        """
        # Large faces are divided, because they cannot be sorted by a single distance.
        corners, pieces = trimesh.remesh.subdivide_to_size(vertices, faces, self._piece)
        triangles = np.asarray(corners)[np.asarray(pieces)]
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        middles = triangles.mean(axis=1)
        facing = np.einsum("ni,ni->n", normals, self._eye - middles) > 0
        lengths = np.linalg.norm(normals[facing], axis=1) * np.linalg.norm(LIGHT)
        lit = normals[facing] @ LIGHT / lengths
        bright = SHADE + (1 - SHADE) * np.maximum(lit, 0.0)
        base = np.array(to_rgb(colour))
        # The outline of a closed triangle fills the seams between pieces.
        closed = self.pixels(triangles[facing])[:, [0, 1, 2, 0]]
        for flat, middle, brightness in zip(closed, middles[facing], bright, strict=True):
            self._add(middle, flat, (*(brightness * base), 1.0), None, 0.5, towards)

    def edges(
        self, vertices: Array, faces: NDArray[np.int_], colour: str, width: float = 0.7
    ) -> None:
        """Add the edges of a convex body that belong to its visible faces."""
        body = trimesh.Trimesh(vertices, faces, process=True)
        # Edges between triangles in the same plane are not edges of the body.
        sharp = body.face_adjacency_angles > 1e-3
        normals = body.face_normals
        middles = body.triangles_center
        facing = np.einsum("ni,ni->n", normals, self._eye - middles) > 0
        shown = sharp & facing[body.face_adjacency].any(axis=1)
        for ends in np.asarray(body.vertices)[body.face_adjacency_edges[shown]]:
            self.line(ends, colour, width, towards=0.5 * self._piece)

    def disc(
        self, centre: Array, normal: Array, radius: float, colour: str, towards: float
    ) -> None:
        """Add a flat disc, if its outward normal (3,) points towards the viewer."""
        if normal @ (self._eye - centre) <= 0:
            return
        # The coordinate axis with the largest angle to the normal gives the best conditioning.
        first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
        first /= np.linalg.norm(first)
        turn = np.linspace(0, 2 * np.pi, 20, endpoint=False)[:, None]
        rim = centre + radius * (np.cos(turn) * first + np.sin(turn) * np.cross(normal, first))
        self._add(centre, self.pixels(rim), to_rgba(colour), None, 0.2, towards)

    def line(
        self, ends: Array, colour: str, width: float, alpha: float = 1.0, towards: float = 0.0
    ) -> None:
        """Add a straight line between two points (2, 3)."""
        count = int(np.ceil(np.linalg.norm(ends[1] - ends[0]) / self._piece)) + 1
        samples = ends[0] + np.linspace(0, 1, count)[:, None] * (ends[1] - ends[0])
        flat = self.pixels(samples)
        for k in range(count - 1):
            middle = 0.5 * (samples[k] + samples[k + 1])
            self._add(middle, flat[k : k + 2], None, to_rgba(colour, alpha), width, towards)

    def paint(self, axes: Axes) -> None:
        """Draw all added shapes into axes of equal scale, without a frame."""
        # The painter's algorithm: near pieces are drawn over far ones.
        self._pieces.sort(key=lambda piece: -piece[0])
        polygons, filled, lines, widths = zip(*(piece[1:] for piece in self._pieces), strict=True)
        drawn = PolyCollection(
            polygons,
            closed=False,
            facecolors=filled,
            edgecolors=lines,
            linewidths=widths,
            capstyle="round",
        )
        axes.add_collection(drawn)
        axes.set_aspect("equal")
        axes.set_axis_off()
        axes.autoscale_view()

    def _add(
        self,
        middle: Array,
        flat: Array,
        fill: tuple | None,
        stroke: tuple | None,
        width: float,
        towards: float,
    ) -> None:
        depth = float(np.linalg.norm(middle - self._eye)) - towards
        nothing = (0.0, 0.0, 0.0, 0.0)
        self._pieces.append((depth, flat, fill or nothing, stroke or fill or nothing, width))


def tube(ends: Array, radius: float, sides: int = 14) -> tuple[Array, NDArray[np.int_]]:
    """Return a closed cylinder between two points (2, 3).

    It has vertices (n, 3) and faces (m, 3), counter-clockwise from outside.
    """
    body = trimesh.creation.cylinder(radius=radius, segment=ends, sections=sides)
    return np.asarray(body.vertices), np.asarray(body.faces)


def extent(points: Sequence[Array]) -> tuple[Array, float]:
    """Return the middle (3,) and the diagonal of the box around points (n, 3) of several bodies.

    Both are in m.
    """
    every = np.vstack(points)
    low = every.min(axis=0)
    high = every.max(axis=0)
    return 0.5 * (low + high), float(np.linalg.norm(high - low))
