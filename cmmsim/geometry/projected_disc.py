"""The ellipse in which a camera sees a disc, exact in perspective.

With C the centre, n the unit normal and R the radius in camera axes, C C' - R² (I - n n') is the dual conic of the
rim; carried to pixels by the camera matrix it gives the ellipse's centre and, in its upper left, its shape.
"""

from __future__ import annotations

import numpy as np

from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import Array


def project_discs(camera: PinholeCamera, centres: Array, normals: Array, radii: Array) -> tuple[Array, Array]:
    """Ellipses of n discs wholly before the camera: ideal centres (n,2) px and shapes A (n,2,2) px, symmetric.

    Parameters: centres (n,3) m and normals (n,3) unit, in camera axes; radii (n,) m. The ellipse is the image of the
    unit disc under x -> centre + A x.
    """
    from cmmsim.geometry.disc_kernel import project_all  # compiles, so it is loaded where it is first needed

    pixels, shapes = np.empty((len(centres), 2)), np.empty((len(centres), 2, 2))
    project_all(
        np.ascontiguousarray(centres, dtype=float),
        np.ascontiguousarray(normals, dtype=float),
        np.ascontiguousarray(radii, dtype=float),
        camera.focal_lengths,
        camera.centre,
        pixels,
        shapes,
    )
    return pixels, shapes
