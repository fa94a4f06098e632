"""Windows of one camera's image over the moments of an exposure, in which most of the scene stands still.

A window that nothing reaches shows the background and is not drawn; one that no moving body reaches is drawn once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import Array
from cmmsim.imaging.image_formation import ImageFormation, Side


def exposed_windows(
    formation: ImageFormation,
    camera: PinholeCamera,
    moments: Sequence[Array],
    corners: NDArray[np.int_],
    size: int,
    supersampling: int,
    sub_pixels: int | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean and largest radiance (k, size, size) over moments with bodies (b,4,4) each, without vignetting.

    Parameters: corners (k,2) px; supersampling and sub_pixels as of ``ImageFormation.windows``.
    """
    reached = formation.reached(camera, moments, corners, size, sub_pixels)
    moves = np.ptp(np.stack(moments), axis=0).any(axis=(1, 2))[formation.drawable.body_index]
    drawn_often = np.asarray(reached[:, :, moves].any(axis=(0, 2)))
    drawn_once = np.asarray(reached.any(axis=(0, 2))) & ~drawn_often

    def draw(bodies: Array, which: NDArray[np.bool_]) -> NDArray[np.float32]:
        if not which.any():
            return np.empty((0, size, size), dtype=np.float32)
        return formation.windows([Side(camera, bodies, corners[which])], size, supersampling, sub_pixels, shade=False)[
            0
        ]

    mean = np.full((len(corners), size, size), formation.background, dtype=np.float32)
    mean[drawn_once] = draw(moments[0], drawn_once)
    total = draw(moments[0], drawn_often)
    largest = total.copy()
    for bodies in moments[1:]:
        window = draw(bodies, drawn_often)
        total += window
        np.maximum(largest, window, out=largest)
    brightest = mean.copy()
    mean[drawn_often], brightest[drawn_often] = total / np.float32(len(moments)), largest
    return mean, brightest
