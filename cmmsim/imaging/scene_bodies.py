"""Solid bodies in front of the cameras, with the true positions of stickers.

Only renderers use these true positions, never the estimator.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from cmmsim.checks import finite_array
from cmmsim.errors import CmmError, SensorFileError
from cmmsim.files.body_meshes import read_mesh
from cmmsim.files.rig_and_bodies import MarkedBody
from cmmsim.files.schema import Body, Stickers, unit
from cmmsim.geometry.plane_frame import PLANE_NAMES
from cmmsim.geometry.pose import Array, invert

# m: depth of the solid's surface below the stickers, and of a dark ring below its sticker.
SUNK = 0.0003
RING_SUNK = 0.0001
# m: shorter rods are refused, because rounding errors would dominate their direction.
SHORTEST_ROD = 1e-9
# A point counts as lying on a solid, and not behind it, if the line of sight enters the solid
# within this final fraction of the line's length.
TOUCHING = 1e-6


class ConvexSolid:
    """Convex hull of vertices (n, 3), m."""

    def __init__(self, vertices: Array) -> None:
        hull = ConvexHull(vertices)
        self.vertices = vertices[hull.vertices]
        self.middle = self.vertices.mean(axis=0)
        faces = np.unique(np.round(hull.equations, 12), axis=0)
        self._normals = np.ascontiguousarray(faces[:, :3])
        self._offsets = np.ascontiguousarray(faces[:, 3])

    @property
    def faces(self) -> tuple[Array, Array]:
        """Outward normals (f, 3) and offsets (f,) of the faces: normal . x + offset <= 0 inside."""
        return self._normals, self._offsets

    def hides(self, camera_from_body: Array, points: Array) -> NDArray[np.bool_]:
        """Tell whether the solid stands between the camera and points (..., 3) in camera axes."""
        # Imported late, because importing numba takes time.
        from cmmsim.imaging.layer_kernels import occluded_points

        flat = np.ascontiguousarray(points, dtype=float).reshape(-1, 3)
        hidden = np.empty(len(flat), dtype=bool)
        occluded_points(
            invert(camera_from_body), flat, self._normals, self._offsets, TOUCHING, hidden
        )
        return hidden.reshape(points.shape[:-1])


@dataclass(frozen=True)
class Disc:
    """Flat disc: centre (3,) and radius in m, outward unit normal (3,), level 0 to 1."""

    centre: Array
    normal: Array
    radius: float
    level: float


@dataclass(frozen=True)
class DiscStack:
    """Discs that lie over each other; the first is the largest and lowest."""

    discs: tuple[Disc, ...]

    @property
    def bounds(self) -> Array:
        """Smallest and largest coordinates (2,3), m."""
        centres = np.array([d.centre for d in self.discs])
        reach = np.array(
            [d.radius * np.sqrt(np.maximum(1.0 - d.normal**2, 0.0)) for d in self.discs]
        )
        return np.stack([(centres - reach).min(axis=0), (centres + reach).max(axis=0)])


@dataclass(frozen=True)
class Mesh:
    """Triangle mesh with vertices (n, 3) in m, faces (m, 3) and levels (n,) 0 to 1 of the vertices.

    All vertices of a solid have the same level.
    """

    vertices: Array
    faces: NDArray[np.int_]
    levels: Array

    @property
    def bounds(self) -> Array:
        """Smallest and largest coordinates (2,3), m."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])


Patch = DiscStack | Mesh  # piece of a body that is drawn by one call


@dataclass(frozen=True)
class SceneBody:
    """Rigid body for drawing: its solid and one stack of discs per sticker.

    ``sticker_places`` (n, 3) are the true positions, m, in the axes of the body.
    """

    solid: Mesh
    stickers: tuple[DiscStack, ...]
    sticker_places: Array


def placed_stickers(body: MarkedBody, stickers: Stickers, stream: int) -> Array:
    """Return the true sticker positions (n, 3), m.

    They are the nominal positions, moved within their planes by random distances in random
    directions. The random numbers follow from ``placement_seed`` and ``stream``.
    """
    rng = np.random.default_rng([stickers.placement_seed, stream])
    distance = rng.uniform(*stickers.placement, len(body.nominal))
    angle = rng.uniform(0.0, 2.0 * np.pi, len(body.nominal))
    shifts = distance[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return body.nominal + np.einsum("nij,nj->ni", body.in_plane, shifts)


def scene_body(body: MarkedBody, section: Body, stickers: Stickers, stream: int) -> SceneBody:
    """Return the body for drawing that a section of a sensor file describes.

    Raises SensorFileError if the section describes no solid, or its mesh cannot be used.
    """
    places = placed_stickers(body, stickers, stream)
    drawn = tuple(
        _sticker(place, axes, stickers) for place, axes in zip(places, body.in_plane, strict=True)
    )
    surface = (
        _solid(body, section) if section.mesh is None else _sunk(read_mesh(section, body.name))
    )
    return SceneBody(solid_mesh(surface, stickers.body_level / 255.0), drawn, places)


def require_convex_near_stickers(
    body: SceneBody, marked: MarkedBody, mesh: str, renderer: str
) -> None:
    """Raise SensorFileError if a sticker lies in a hollow of a body.

    The ``renderer`` draws the convex hull of the body, which hides the sticker. The message names
    it and the file ``mesh``.
    """
    normals, offsets = ConvexSolid(body.solid.vertices).faces
    heights = (body.sticker_places @ normals.T + offsets).max(axis=1)
    hollow = marked.sticker_ids[heights <= RING_SUNK]
    if len(hollow):
        which = f"sticker {hollow[0]} lies"
        if len(hollow) > 1:
            which = f"stickers {', '.join(hollow)} lie"
        raise SensorFileError(
            f"{marked.name}.mesh {mesh}: {which} in a hollow of the mesh, and the renderer "
            f"{renderer!r} sees the convex hull of a mesh; choose 'pyrender' or 'scene'"
        )


def solid_mesh(mesh: trimesh.Trimesh, level: float) -> Mesh:
    """Return a solid of a single level, 0 to 1."""
    vertices = np.asarray(mesh.vertices, dtype=float)
    return Mesh(vertices, np.asarray(mesh.faces), np.full(len(vertices), level))


def rod(length: float, radius: float) -> trimesh.Trimesh:
    """Return a cylinder from the origin to (0, 0, length), such as a crank or a link of a robot.

    Parameters
    ----------
    length, radius : float
        Sizes in m.

    Returns
    -------
    trimesh.Trimesh

    Raises
    ------
    ShapeError
        If a size is not a finite number.
    CmmError
        If a size is not above zero.

    Examples
    --------
    >>> rod(0.4, 0.02).extents.round(3).tolist()
    [0.04, 0.04, 0.4]
    """
    sizes = finite_array(
        (length, radius), (2,), "length and radius of a rod are two finite numbers, m"
    )
    if sizes.min() <= 0.0:
        raise CmmError(
            f"length and radius of a rod must be above 0 m, got {length:g} and {radius:g}"
        )
    mesh = trimesh.creation.cylinder(radius=radius, height=length, sections=24)
    mesh.apply_translation([0.0, 0.0, 0.5 * length])
    return mesh


def rod_transform(start: ArrayLike, end: ArrayLike) -> Array:
    """Return the transform that places a rod between two points.

    Parameters
    ----------
    start, end : array_like, shape (3,)
        First and last point of the rod's axis in the base frame, m.

    Returns
    -------
    ndarray, shape (4, 4)
        base_from_body, with the rod along its z axis.

    Raises
    ------
    ShapeError
        If a point is not three finite numbers.
    CmmError
        If the points are closer than SHORTEST_ROD.

    Examples
    --------
    >>> rod_transform([0.0, 0.0, 0.0], [0.3, 0.0, 0.0])[:3, 2].tolist()
    [1.0, 0.0, 0.0]
    """
    begin = finite_array(start, (3,), "the start of a rod is three finite numbers, m")
    return rod_transforms(
        begin[None], finite_array(end, (3,), "the end of a rod is three finite numbers, m")[None]
    )[0]


def rod_transforms(starts: Array, ends: Array) -> Array:
    """Return ``rod_transform`` (k, 4, 4) of k rods at once, from starts and ends (k, 3).

    Raises CmmError for a rod whose length is below SHORTEST_ROD or NaN.
    """
    # Imported late, because importing numba takes time.
    from cmmsim.imaging.view_kernels import place_rods

    transforms = np.zeros((len(starts), 4, 4))
    lengths = np.empty(len(starts))
    place_rods(np.ascontiguousarray(starts), np.ascontiguousarray(ends), transforms, lengths)
    if not lengths.min(initial=np.inf) >= SHORTEST_ROD:
        k = np.flatnonzero(~(lengths >= SHORTEST_ROD))[0]
        raise CmmError(
            f"a rod of {lengths[k]:g} m from {starts[k].tolist()} m has no direction: its length "
            f"must be at least {SHORTEST_ROD:g} m"
        )
    return transforms


class PlacedBodies(Mapping[str, Array]):
    """Mapping of names of bodies to base_from_body, stored in one array ``together`` (k, 4, 4).

    Thanks to the array, a sensor need not join the matrices again in every frame.
    """

    def __init__(self, names: tuple[str, ...], together: Array) -> None:
        self.names = names
        self.together = together

    def __getitem__(self, name: str) -> Array:
        try:
            return np.asarray(self.together[self.names.index(name)])
        except ValueError:
            raise KeyError(name) from None

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)


def _solid(body: MarkedBody, section: Body) -> trimesh.Trimesh:
    """Return the convex solid that a body's planes and cuts enclose.

    Sticker planes are lowered by SUNK. Raises SensorFileError if the sides enclose no solid.
    """
    normals = [*body.normals, *(unit(c.normal) for c in section.cuts)]
    points = [
        *(d * n - SUNK * n for n, d in zip(body.normals, body.offsets, strict=True)),
        *(np.array(c.point) for c in section.cuts),
    ]
    half_spaces = np.array([[*n, -(n @ p)] for n, p in zip(normals, points, strict=True)])
    # The middle of the stickers, moved inwards by 1 cm along the normal of each plane, must lie
    # inside all half spaces.
    inside = body.nominal.mean(axis=0) - 0.01 * body.normals.sum(axis=0)
    outside = half_spaces @ [*inside, 1.0]
    if outside.max() >= 0.0:
        side = [
            *(f"plane {name}" for name in PLANE_NAMES),
            *(f"cut {k + 1}" for k in range(len(section.cuts))),
        ]
        raise SensorFileError(
            f"{body.name}: the middle of its stickers, {np.round(inside, 4).tolist()} m, lies "
            f"{outside.max():.4f} m outside of {side[outside.argmax()]}: the stickers do not lie "
            "on the solid that its planes and cuts enclose"
        )
    try:
        corners = HalfspaceIntersection(half_spaces, inside).intersections
        if not np.isfinite(corners).all():
            raise SensorFileError(
                f"{body.name}: its planes and cuts enclose no solid, because one side is open"
            )
        return trimesh.convex.convex_hull(corners)
    except QhullError as error:
        reason = str(error).strip().splitlines()[0]
        raise SensorFileError(
            f"{body.name}: its planes and cuts enclose no solid: {reason}"
        ) from error


def _sunk(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a mesh whose faces lie about SUNK below those of the given mesh.

    Stickers on the surface of the given mesh then lie above the drawn one, as on convex solids.
    """
    moved = np.array(mesh.vertices)
    normals = np.asarray(mesh.face_normals)
    for k, faces in enumerate(mesh.vertex_faces):
        around = normals[faces[faces >= 0]]
        # Normals that hardly differ count as equal, so that the vertex does not move far.
        moved[k] -= SUNK * np.linalg.lstsq(around, np.ones(len(around)), rcond=0.1)[0]
    return trimesh.Trimesh(moved, mesh.faces, process=False)


def _sticker(place: Array, axes: Array, stickers: Stickers) -> DiscStack:
    """Return a bright disc and, RING_SUNK below it, a larger dark disc, which appears as a ring."""
    normal = np.cross(axes[:, 0], axes[:, 1])
    return DiscStack(
        (
            Disc(
                place - RING_SUNK * normal,
                normal,
                stickers.ring_radius,
                stickers.ring_level / 255.0,
            ),
            Disc(place, normal, stickers.radius, stickers.sticker_level / 255.0),
        )
    )
