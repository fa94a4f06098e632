"""Light over an exposure: of windows, and of a whole image, which is drawn finely only around
bright spots.

Most of the scene stands still during an exposure: a window that nothing reaches shows the
background and is not drawn, one that no moving body reaches is drawn once.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import Array
from cmmsim.imaging.formation import ImageFormation, Side
from cmmsim.imaging.views import View

PASTED_SIZE = 24  # px side of the finely drawn window around a bright spot
LARGEST_PASTED_SIZE = 96  # px: a larger spot is left coarse
DARK_RIM = (
    8  # px of the surroundings that are drawn finely with a spot that is longer than a sticker
)
BRIGHT = 0.4  # radiance above which a spot is drawn finely
TILE = 64  # px side of the pieces that are bent and blurred at a time
COARSE = 2  # drawn samples a pixel and axis away from bright spots


def exposed_windows(
    formation: ImageFormation,
    camera: PinholeCamera,
    moments: Sequence[Array],
    corners: NDArray[np.int_],
    size: int,
    supersampling: int,
    sub_pixels: int | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean and largest radiance (k, size, size) over moments with bodies (b,4,4) each, without
    vignetting.

    Parameters: corners (k,2) px; supersampling and sub_pixels as of ``ImageFormation.windows``.
    """
    reached = formation.reached(camera, moments, corners, size, sub_pixels)
    moves = np.ptp(np.stack(moments), axis=0).any(axis=(1, 2))[formation.drawable.body_index]
    drawn_often = np.asarray(reached[:, :, moves].any(axis=(0, 2)))
    drawn_once = np.asarray(reached.any(axis=(0, 2))) & ~drawn_often

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
    formation: ImageFormation, camera: PinholeCamera, moments: Sequence[Array], supersampling: int
) -> NDArray[np.float32]:
    """Mean radiance (height, width) of one camera's image over moments with bodies (b,4,4) each.

    It is drawn coarsely, and as finely as windows are around each bright spot.
    """
    image, bright = _coarse(formation, camera, moments)
    corners, size = _spots(
        bright, fixed_size=len(moments) == 1 and formation.draws_pixels([camera])
    )
    if len(corners):
        fine = exposed_windows(formation, camera, moments, corners, size, supersampling)[0]
        for (x, y), window in zip(corners, fine, strict=True):
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
    """Mean radiance (height, width) with COARSE² drawn samples a pixel, and where it is bright at
    any moment.
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
    return mean, brightest > BRIGHT


def _spots(bright: NDArray[np.bool_], fixed_size: bool) -> tuple[NDArray[np.int_], int]:
    """First pixels (k, 2) of the windows around bright spots, and their side in px."""
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
