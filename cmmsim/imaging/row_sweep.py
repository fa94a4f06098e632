"""Exposure of an image row after row, as by a rolling shutter.

The pose of an exposure is the pose when the middle row of the image is exposed. Each window is
drawn with the platform at the pose at which the middle row of the window is exposed. The platform
hardly moves while the few rows of a window are exposed.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import Array, transforms_of
from cmmsim.imaging.formation import ImageFormation, Side

# Number of rows between two poses whose difference gives the change per row.
SWEPT_ROWS = 100.0


def row_sweeps(
    poses: Array, rates: Array, row_time: float, from_base: Sequence[Array]
) -> list[Array | None]:
    """Return, for each of N poses, the changes (2, 4, 4) of camera_from_platform per row.

    The platform has poses (N, 6) that change at rates (N, 6), and a row is exposed ``row_time`` s
    after the row above it. ``from_base`` are camera_from_base (4, 4) of the left and the right
    camera. A pose of a platform at rest has None instead of changes.
    """
    ahead, behind = (
        transforms_of(poses + sign * 0.5 * SWEPT_ROWS * row_time * rates) for sign in (1.0, -1.0)
    )
    steps = (ahead - behind) / SWEPT_ROWS
    sweeps = np.stack([move @ steps for move in from_base], axis=1)
    return [sweep if sweep.any() else None for sweep in sweeps]


def swept(
    camera: PinholeCamera, bodies: Array, sweep: Array | None, first_row: int, size: int
) -> Array:
    """Return camera_from_body (b, 4, 4) when the middle row of a window is exposed.

    ``bodies`` (b, 4, 4), with the platform first, belong to the middle row of the image. ``sweep``
    (4, 4) is the change of the platform's transform from one row to the next, or None at rest. The
    window begins at ``first_row`` and has ``size`` rows. The motion is linearised.
    """
    if sweep is None:
        return bodies
    moved = bodies.copy()
    moved[0] += (first_row + 0.5 * (size - 1) - 0.5 * (camera.height - 1)) * sweep
    return moved


def drawn_at_middle_rows(
    formation: ImageFormation,
    sides: Sequence[Side],
    sweeps: Sequence[Array | None],
    size: int,
    supersampling: int,
) -> list[NDArray[np.float32]]:
    """Return the radiance (2, n, size, size) of each exposure's windows, each at its own time.

    ``sides`` are the left and the right side of the first exposure, then those of the second, and
    so on. ``sweeps`` is the result of ``row_sweeps`` for the exposures.
    """
    windows = []
    for k, side in enumerate(sides):
        sweep = sweeps[k // 2]
        own = None if sweep is None else sweep[k % 2]
        parts = [
            Side(side.camera, swept(side.camera, side.bodies, own, corner[1], size), corner[None])
            for corner in side.corners
        ]
        windows.append(np.concatenate(formation.windows(parts, size, supersampling)))
    return [np.stack(pair) for pair in zip(windows[::2], windows[1::2], strict=True)]
