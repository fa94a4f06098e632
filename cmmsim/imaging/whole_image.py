"""Whole images: drawn coarsely, and as finely as windows are around each bright spot."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import Array
from cmmsim.imaging.exposed_windows import exposed_windows
from cmmsim.imaging.image_formation import ImageFormation
from cmmsim.imaging.views import View

PASTED_SIZE = 24  # px side of the finely drawn window around a bright spot
LARGEST_PASTED_SIZE = 96  # px: a larger spot is left coarse
DARK_RIM = 8  # px of the surroundings that are drawn finely with a spot that is longer than a sticker
BRIGHT = 0.4  # radiance above which a spot is drawn finely
TILE = 64  # px side of the pieces that are bent and blurred at a time
COARSE = 2  # drawn samples a pixel and axis away from bright spots


def whole_image(
    formation: ImageFormation, camera: PinholeCamera, moments: Sequence[Array], supersampling: int
) -> NDArray[np.float32]:
    """Mean radiance (height, width) of one camera's image over moments with bodies (b,4,4) each."""
    image, bright = _coarse(formation, camera, moments)
    corners, size = _spots(bright, fixed_size=len(moments) == 1 and formation.draws_pixels([camera]))
    if len(corners):
        fine = exposed_windows(formation, camera, moments, corners, size, supersampling)[0]
        for (x, y), window in zip(corners, fine, strict=True):
            image[y : y + size, x : x + size] = window
    return image if formation.optics.vignetting == 0.0 else image * _illumination(formation, camera)


def _coarse(
    formation: ImageFormation, camera: PinholeCamera, moments: Sequence[Array]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Mean radiance (height, width) with COARSE² drawn samples a pixel, and where it is bright at any moment."""
    if len(moments) == 1 and formation.draws_pixels([camera]):
        view = View(camera.ideal, moments[0], (0, 0), (camera.width, camera.height))
        image = formation.renderer.draw(formation.drawable, [view], COARSE, formation.background)[0]
        return image, image > BRIGHT
    rows, columns = -(-camera.height // TILE), -(-camera.width // TILE)
    x, y = np.meshgrid(TILE * np.arange(columns), TILE * np.arange(rows))
    corners = np.column_stack([x.ravel(), y.ravel()])
    mean, brightest = (
        tiles.reshape(rows, columns, TILE, TILE)
        .swapaxes(1, 2)
        .reshape(rows * TILE, columns * TILE)[: camera.height, : camera.width]
        for tiles in exposed_windows(formation, camera, moments, corners, TILE, COARSE, sub_pixels=1)
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


def _illumination(formation: ImageFormation, camera: PinholeCamera) -> NDArray[np.float32]:
    """Relative illumination (height, width) of the whole image."""
    pixels = np.stack(np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height))), axis=-1)
    return formation.optics.illumination(camera, pixels).astype(np.float32)
