"""Renderer ``analytic``, without OpenGL. The fraction of a pixel that a disc covers is exact.

Layers are drawn over each other: first the background, then solids from far to near, then discs. A
disc that faces away from the camera is not drawn. If a solid of another body hides the centre of a
disc, or one of some points on its rim, the disc is drawn only outside of this solid's outline.

Three things are simpler than in the renderer `pyrender`. Solids are convex hulls, ordered by the
depth of their middles. Their edges are sampled by scan lines. If a pixel contains edges of two
layers, the fractions that the layers cover are assumed to be independent.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.pose import Array
from cmmsim.imaging.renderer import NEAR, Drawable, Renderer, View, Views
from cmmsim.imaging.scene_bodies import TOUCHING, ConvexSolid, DiscStack, Mesh

if TYPE_CHECKING:
    from cmmsim.imaging.view_kernels import Scene


def draw_windows(
    drawable: Drawable, views: Sequence[View], supersampling: int, background: float = 0.0
) -> NDArray[np.float32]:
    """Draw the radiance (n, h, w) float32, 0 to 1, of n windows of one size.

    ``supersampling`` is the number of scan lines per pixel that sample edges of solids.
    """
    # Imported late, because importing numba takes time.
    from cmmsim.imaging.view_kernels import draw_view

    if drawable not in _SCENES:
        _SCENES[drawable] = scene_of(drawable)
    scene = _SCENES[drawable]
    views = Views.of(views)
    width, height = views.size
    images = np.full((len(views), height, width), background, dtype=np.float32)
    corners = np.asarray(views.corners, dtype=float)
    for shown in views.exposures:
        camera = shown.camera
        camera_from_bodies = np.ascontiguousarray(shown.camera_from_bodies)
        lens = camera.focal_lengths, camera.centre, NEAR, TOUCHING
        draw_view(
            scene,
            camera_from_bodies,
            *lens,
            images,
            shown.windows,
            corners[shown.windows],
            supersampling,
        )
    return images


ANALYTIC = Renderer("analytic", draw_windows)


def scene_of(drawable: Drawable) -> "Scene":
    """Return the discs and the solids of a drawable as arrays, in the axes of their bodies."""
    # Imported late, because importing numba takes time.
    from cmmsim.imaging.view_kernels import Scene

    rows = [
        (disc, body)
        for patch, body in zip(drawable.patches, drawable.body_index, strict=True)
        if isinstance(patch, DiscStack)
        for disc in patch.discs
    ]
    meshes = {k: patch for k, patch in enumerate(drawable.patches) if isinstance(patch, Mesh)}
    solids = [ConvexSolid(mesh.vertices) for mesh in meshes.values()]
    return Scene(
        np.array([disc.centre for disc, _ in rows]).reshape(-1, 3),
        np.array([disc.normal for disc, _ in rows]).reshape(-1, 3),
        np.array([disc.radius for disc, _ in rows], dtype=float),
        np.array([disc.level for disc, _ in rows], dtype=float),
        np.array([body for _, body in rows], dtype=int),
        drawable.body_index[list(meshes)],
        np.array([float(mesh.levels[0]) for mesh in meshes.values()], dtype=float),
        np.array([solid.middle for solid in solids]).reshape(-1, 3),
        *_joined([solid.vertices for solid in solids]),
        *_faces([solid.faces for solid in solids]),
    )


def _joined(parts: Sequence[Array]) -> tuple[Array, NDArray[np.int_]]:
    """Join s arrays (k, 3), and return the joined array and the s + 1 limits of its parts."""
    starts = np.cumsum([0, *(len(part) for part in parts)])
    return np.ascontiguousarray(np.concatenate([np.zeros((0, 3)), *parts])), starts


def _faces(faces: Sequence[tuple[Array, Array]]) -> tuple[Array, Array, NDArray[np.int_]]:
    """Return normals and offsets of the faces of all s solids, and the s + 1 limits of solids."""
    normals, starts = _joined([normal for normal, _ in faces])
    return normals, np.concatenate([np.zeros(0), *(offset for _, offset in faces)]), starts


_SCENES: "WeakKeyDictionary[Drawable, Scene]" = WeakKeyDictionary()
