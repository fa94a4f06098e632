"""Bodies that carry stickers on three machined planes, as the estimator knows them.

The planes are exact. The sticker places are only nominal: a sticker sits up to about a millimetre beside its place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmmsim.errors import ShapeError, TeachingError
from cmmsim.files.schema import Body, StickerPlane, unit
from cmmsim.geometry.plane_frame import PLANE_NAMES, frame_from_planes
from cmmsim.geometry.pose import Array

SMALLEST_CORNER = 0.001  # volume that the unit normals of three planes span: of a cube's corner it is 1


@dataclass(frozen=True)
class MarkedBody:
    """Planes and nominal stickers in body axes.

    normals (3,3) by row and offsets (3,) of planes A, B, C (n . p = d, m); sticker_ids (n,) such as "A1"; plane_index
    (n,); nominal (n,3) m; in_plane (n,3,2) the u and v axes of each sticker's plane.
    """

    name: str
    normals: Array
    offsets: Array
    sticker_ids: NDArray[np.str_]
    plane_index: NDArray[np.int_]
    nominal: Array
    in_plane: Array

    def __post_init__(self) -> None:
        if self.nominal.shape != (len(self.sticker_ids), 3) or self.normals.shape != (3, 3):
            raise ShapeError(f"body {self.name}: {len(self.sticker_ids)} stickers but places {self.nominal.shape}")
        for array in (self.normals, self.offsets, self.plane_index, self.nominal, self.in_plane):
            array.setflags(write=False)

    @property
    def sticker_normals(self) -> Array:
        """Outward normal (n,3) at each sticker."""
        return self.normals[self.plane_index]

    @property
    def body_from_planes(self) -> Array:
        """The known transform (4,4) from the frame of planes A, B, C to the body's own frame."""
        return frame_from_planes(self.normals, self.offsets)


def marked_body(name: str, body: Body) -> MarkedBody:
    """MarkedBody of a sensor file's section."""
    planes = [getattr(body.planes, plane) for plane in PLANE_NAMES]
    normals = np.stack([unit(p.normal) for p in planes])
    offsets = np.array([n @ np.array(p.point) for n, p in zip(normals, planes, strict=True)])
    counts = [len(p.stickers) for p in planes]
    axes = [_plane_axes(p) for p in planes]
    nominal = [np.array(p.point) + np.array(p.stickers) @ a.T for p, a in zip(planes, axes, strict=True)]
    ids = [f"{plane}{k + 1}" for plane, count in zip(PLANE_NAMES, counts, strict=True) for k in range(count)]
    return MarkedBody(
        name,
        normals,
        offsets,
        np.array(ids),
        np.repeat(np.arange(3), counts),
        np.concatenate(nominal),
        np.repeat(np.stack(axes), counts, axis=0),
    )


def require_corner(body: MarkedBody) -> None:
    """Raise TeachingError unless the three planes of a body meet in one point, which its frame hangs on."""
    volume = abs(float(np.linalg.det(body.normals)))
    if volume < SMALLEST_CORNER:
        raise TeachingError(
            f"{body.name}: planes A, B and C meet in no point, so no frame can be taught: their unit "
            f"normals span a volume of {volume:.1g}, at least {SMALLEST_CORNER:g} is needed"
        )


def _plane_axes(plane: StickerPlane) -> Array:
    """u and v axes (3,2) in the plane."""
    normal = unit(plane.normal)
    across = np.array(plane.across)
    u = unit(across - (across @ normal) * normal)
    return np.column_stack([u, np.cross(normal, u)])
