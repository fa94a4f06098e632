"""Figure 10 of the paper: the frame of the platform from the planes of its stickers."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from cmmsim.geometry.plane_frame import PLANE_NAMES, FittedPlane, frames_of_points
from cmmsim.geometry.pose import apply, invert, pose_to_transform
from identify.arrays import Array
from identify.paper.exhibit import Exhibit
from identify.reporting.figures.style import BLUE, GREEN, INK, RED, WIDTH
from identify.scene import StereoView, Workcell

COLOURS = (BLUE, RED, GREEN)  # colours of the planes A, B and C


@dataclass(frozen=True)
class MarkedPlanes:
    """Planes fitted to measured stickers.

    ids                      Names (n,) of the stickers.
    plane (n,)               Plane of each sticker, 0 to 2.
    points (n, 3)            Measured positions in the frame of the planes, m.
    distances (n,)           Signed distances of the stickers from their planes, m.
    normals (3, 3)           Unit normals of the planes in the frame of the planes, one per row.
    base_from_planes (4, 4)  Frame of the planes in the base frame.
    """

    ids: tuple[str, ...]
    plane: NDArray[np.int_]
    points: Array
    distances: Array
    normals: Array
    base_from_planes: Array

    def corners(self, plane: int) -> Array:
        """Return the corners (m, 3), m, of the drawn part of a plane.

        This part is the convex hull of the stickers, projected onto the plane, and of the ends of
        the plane's intersections with the other planes.
        """
        own = self.points[self.plane == plane]
        normal = self.normals[plane]
        projected = own - np.outer(own @ normal, normal)
        ends = [self.edge(plane, other) for other in range(3) if other != plane]
        every = np.vstack([projected, *ends])
        in_plane = np.linalg.svd(np.eye(3) - np.outer(normal, normal))[2][:2]
        hull = ConvexHull(every @ in_plane.T)
        return np.asarray(every[hull.vertices])

    def edge(self, first: int, second: int) -> Array:
        """Return the ends (2, 3), m, of the intersection of two planes.

        The drawn part begins at the origin, where all planes intersect, and reaches as far as the
        farthest sticker of both planes.
        """
        along = np.cross(self.normals[first], self.normals[second])
        along /= np.linalg.norm(along)
        own = self.points[(self.plane == first) | (self.plane == second)] @ along
        far = own[np.argmax(np.abs(own))]
        return np.array([np.zeros(3), far * along])


def marked_planes(cell: Workcell, view: StereoView) -> MarkedPlanes:
    """Fit the planes to the platform's stickers in a view.

    Raises cmmsim.LostError if a plane has too few stickers in the view.
    """
    found = view.found["platform"]
    body = cell.marked("platform")
    plane_of = dict(zip(map(str, body.sticker_ids), body.plane_index, strict=True))
    plane = np.array([plane_of[name] for name in found.ids])
    # Nominal normals only decide to which side a fitted normal points.
    nominal = body.normals @ pose_to_transform(view.pose)[:3, :3].T
    frame, planes = frames_of_points(found.points, found.covariances, plane, nominal)
    normals = np.array([fitted.normal for fitted in planes]) @ frame[:3, :3]
    return MarkedPlanes(
        ids=found.ids,
        plane=plane,
        points=apply(invert(frame), found.points),
        distances=_distances(found.points, plane, planes),
        normals=normals,
        base_from_planes=frame,
    )


def _distances(points: Array, plane: NDArray[np.int_], planes: list[FittedPlane]) -> Array:
    normals = np.array([fitted.normal for fitted in planes])[plane]
    offsets = np.array([float(fitted.offset) for fitted in planes])[plane]
    return np.asarray(np.einsum("ni,ni->n", points, normals) - offsets)


def draw(marked: MarkedPlanes) -> Figure:
    """Draw stickers, planes, two of their intersections, and the frame of the planes, in mm."""
    figure = Figure(figsize=(WIDTH, 4.2))
    axes: Any = figure.add_axes((0.0, 0.0, 1.0, 1.0), projection="3d")
    for k, (name, colour) in enumerate(zip(PLANE_NAMES, COLOURS, strict=True)):
        corners = 1e3 * marked.corners(k)
        axes.add_collection3d(
            Poly3DCollection([corners], facecolor=colour, edgecolor=colour, alpha=0.18)
        )
        own = 1e3 * marked.points[marked.plane == k]
        axes.scatter(*own.T, color=colour, s=14, depthshade=False)
        axes.text(*corners.mean(axis=0), f"plane {name}", color=colour, fontsize=8)
    for label, (first, second) in {"l₁ = A ∩ B": (0, 1), "l₂ = A ∩ C": (0, 2)}.items():
        ends = 1e3 * marked.edge(first, second)
        axes.plot(*ends.T, color=INK, linewidth=1.4)
        axes.text(*ends[1], label, fontsize=8)
    length = 400 * np.ptp(marked.points, axis=0).max()
    for name, direction in zip("xyz", np.eye(3), strict=True):
        axes.quiver(
            0, 0, 0, *(length * direction), color=INK, linewidth=0.9, arrow_length_ratio=0.1
        )
        axes.text(*(1.08 * length * direction), name, fontsize=9, fontstyle="italic")
    for name, point in zip(marked.ids, 1e3 * marked.points, strict=True):
        axes.text(*point, f" {name}", fontsize=6)
    axes.set_aspect("equal")
    axes.set(xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]")
    # The planes B and C face the cameras.
    towards = marked.normals.sum(axis=0)
    azimuth = np.degrees(np.arctan2(towards[1], towards[0]))
    axes.view_init(elev=28, azim=azimuth + 8)
    return figure


def exhibit(cell: Workcell, view: StereoView) -> Exhibit:
    """Return figure 10 from the stickers that both cameras see."""
    marked = marked_planes(cell, view)
    rms = 1e6 * float(np.sqrt(np.mean(marked.distances**2)))
    axis_names = ("x", "y", "z")
    columns: dict[str, Any] = {
        "sticker": marked.ids,
        "plane": [PLANE_NAMES[k] for k in marked.plane],
        **{f"{axis} [mm]": 1e3 * marked.points[:, i] for i, axis in enumerate(axis_names)},
        "distance from the plane [um]": 1e6 * marked.distances,
    }
    return Exhibit(
        "Figure 10",
        "Frame of the platform from three planes of stickers",
        "At least three stickers on each of the planes A, B and C give the planes. Their "
        "intersections give the x axis and the origin, and the normal of A gives z.",
        f"The same from one pair of our images, with {len(marked.ids)} stickers. They lie "
        f"{rms:.2g} µm (RMS) from their planes. The paper solves three equations for a plane; here "
        "it is fitted with the covariances of the points. With pose_method=planes, every pose is "
        "measured in this way. Our default, registration, fits all stickers at once.",
        columns,
        partial(draw, marked),
    )
