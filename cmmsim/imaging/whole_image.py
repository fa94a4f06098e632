"""Exposures of windows over several moments, and whole images.

A whole image is drawn finely only around bright spots. Most of the scene stands still during an
exposure, so a window without a moving body is drawn only once. A window without any body is filled
with the background, unless the background is painted too.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import Array
from cmmsim.imaging.formation import ImageFormation, Side
from cmmsim.imaging.renderer import View
from cmmsim.imaging.row_sweep import swept

# px: smallest side of the finely drawn window around a bright spot.
PASTED_SIZE = 24
# px: largest side of a finely drawn window; larger spots are drawn coarsely.
LARGEST_PASTED_SIZE = 96
# px: smallest finely drawn margin around a spot, unless the size is fixed.
DARK_RIM = 8
# Radiance above which a spot is drawn finely.
BRIGHT = 0.4
# The same threshold where light and print can make stickers darker than their level.
DIM = 0.25
# px: side of the pieces in which a whole image is distorted and blurred.
TILE = 64
# Number of drawn samples per pixel and axis away from bright spots.
COARSE = 2


def exposed_windows(
    formation: ImageFormation,
    camera: PinholeCamera,
    moments: Sequence[Array],
    corners: NDArray[np.int_],
    size: int,
    supersampling: int,
    sub_pixels: int | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the mean and the largest radiance (k, size, size) of windows over several moments.

    Each moment states camera_from_body (b, 4, 4). Windows have first pixels ``corners`` (k, 2). The
    results have no vignetting. See ``ImageFormation.windows`` for ``supersampling`` and
    ``sub_pixels``.
    """
    reached = formation.reached(camera, moments, corners, size, sub_pixels)
    # Mask of the patches whose bodies move.
    moves = np.ptp(np.stack(moments), axis=0).any(axis=(1, 2))[formation.drawable.body_index]
    drawn_often = np.asarray(reached[:, :, moves].any(axis=(0, 2)))
    shown = np.asarray(reached.any(axis=(0, 2)))
    if formation.painter is not None and formation.painter.paints_background:
        shown[:] = True
    drawn_once = shown & ~drawn_often

    def draw(bodies: Array, which: NDArray[np.bool_]) -> NDArray[np.float32]:
        if not which.any():
            return np.empty((0, size, size), dtype=np.float32)
        sides = [Side(camera, bodies, corners[which])]
        return formation.windows(sides, size, supersampling, sub_pixels, shade=False)[0]

    mean = np.full((len(corners), size, size), formation.background, dtype=np.float32)
    mean[drawn_once] = draw(moments[0], drawn_once)
    total = draw(moments[0], drawn_often)
    largest = total.copy()
    for bodies in moments[1:]:
        window = draw(bodies, drawn_often)
        total += window
        np.maximum(largest, window, out=largest)
    brightest = mean.copy()
    mean[drawn_often] = total / np.float32(len(moments))
    brightest[drawn_often] = largest
    return mean, brightest


def whole_image(
    formation: ImageFormation,
    camera: PinholeCamera,
    moments: Sequence[Array],
    supersampling: int,
    sweep: Array | None = None,
) -> NDArray[np.float32]:
    """Return the mean radiance (height, width) of one camera's image over several moments.

    Each moment states camera_from_body (b, 4, 4). The image is drawn coarsely, except for finely
    drawn windows around bright spots. ``sweep`` (4, 4) is the change of the platform's transform
    from one row to the next, see ``swept``.
    """
    image, bright = _coarse(formation, camera, moments)
    corners, size = _spots(
        bright, fixed_size=len(moments) == 1 and formation.draws_pixels([camera])
    )
    groups = [slice(0, len(corners))]
    if sweep is not None:
        groups = [slice(k, k + 1) for k in range(len(corners))]
    for own in groups if len(corners) else []:
        moved = [swept(camera, moment, sweep, corners[own][0, 1], size) for moment in moments]
        fine = exposed_windows(formation, camera, moved, corners[own], size, supersampling)[0]
        for (x, y), window in zip(corners[own], fine, strict=True):
            image[y : y + size, x : x + size] = window
    if formation.optics.vignetting == 0.0:
        return image
    pixels = np.stack(
        np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height))), axis=-1
    )
    return image * formation.optics.illumination(camera, pixels).astype(np.float32)


def _coarse(
    formation: ImageFormation, camera: PinholeCamera, moments: Sequence[Array]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the mean radiance (height, width), drawn with COARSE samples per pixel and axis.

    It has no vignetting. The second result is a mask of pixels that are bright at any moment.
    """
    if len(moments) == 1 and formation.draws_pixels([camera]):
        view = View(camera.ideal, moments[0], (0, 0), (camera.width, camera.height))
        image = formation.renderer.draw(formation.drawable, [view], COARSE, formation.background)[0]
        return image, image > BRIGHT
    rows = -(-camera.height // TILE)
    columns = -(-camera.width // TILE)
    x, y = np.meshgrid(TILE * np.arange(columns), TILE * np.arange(rows))
    corners = np.column_stack([x.ravel(), y.ravel()])
    mean, brightest = (
        tiles.reshape(rows, columns, TILE, TILE)
        .swapaxes(1, 2)
        .reshape(rows * TILE, columns * TILE)[: camera.height, : camera.width]
        for tiles in exposed_windows(
            formation, camera, moments, corners, TILE, COARSE, sub_pixels=1
        )
    )
    return mean, brightest > (BRIGHT if formation.painter is None else DIM)


def _spots(bright: NDArray[np.bool_], fixed_size: bool) -> tuple[NDArray[np.int_], int]:
    """Return the first pixels (k, 2) of the windows around bright spots, and their side in px.

    If ``fixed_size`` is True, the side is PASTED_SIZE for spots of all sizes. Otherwise the side
    suits the largest spot, and spots too large for LARGEST_PASTED_SIZE have no window.
    """
    _, _, stats, centres = cv2.connectedComponentsWithStats(bright.astype(np.uint8))
    keep = np.isfinite(centres[1:]).all(axis=1)
    sides = stats[1:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1)
    size = PASTED_SIZE
    if not fixed_size:
        keep &= sides <= LARGEST_PASTED_SIZE - 2 * DARK_RIM
        size = max(size, int(sides[keep].max(initial=0)) + 2 * DARK_RIM)
    size = min(size, *bright.shape)
    highest = np.array(bright.shape[::-1]) - size
    return np.clip(np.rint(centres[1:][keep]).astype(int) - size // 2, 0, highest), size
