"""Discs of a scene as one camera sees them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.pose import Array
from cmmsim.geometry.projected_disc import project_discs
from cmmsim.imaging.scene import DiscStack
from cmmsim.imaging.views import NEAR, Drawable, View

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
        rows = [
            (disc, body)
            for patch, body in zip(drawable.patches, drawable.body_index, strict=True)
            if isinstance(patch, DiscStack)
            for disc in patch.discs
        ]
        self._places = np.array([d.centre for d, _ in rows]).reshape(-1, 3)
        self._normals = np.array([d.normal for d, _ in rows]).reshape(-1, 3)
        self._radii = np.array([d.radius for d, _ in rows])
        self._levels = np.array([d.level for d, _ in rows])
        self._owners = np.array([body for _, body in rows], dtype=int)

    def seen(self, view: View) -> DiscsInView:
        """The discs that face a view's camera."""
        from cmmsim.geometry.disc_kernel import (  # compiles, so it is loaded where it is first needed
            place_discs,
            probe_discs,
        )

        centres, normals = np.empty_like(self._places), np.empty_like(self._places)
        place_discs(view.camera_from_bodies, self._owners, self._places, self._normals, centres, normals)
        facing = (np.einsum("ni,ni->n", centres, normals) < 0.0) & (centres[:, 2] - self._radii > NEAR)
        kept = np.flatnonzero(facing)
        kept = kept[np.lexsort((-self._radii[kept], -np.round(centres[kept, 2], 3)))]
        centres, normals, radii = centres[kept], normals[kept], self._radii[kept]
        pixels, shapes = project_discs(view.camera, centres, normals, radii)
        probes = np.empty((len(kept), PROBES + 1, 3))
        probe_discs(centres, normals, radii, probes)
        return DiscsInView(
            pixels, shapes, np.linalg.norm(shapes, axis=2), self._levels[kept], self._owners[kept], probes
        )
