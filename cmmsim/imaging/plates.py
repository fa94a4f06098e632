"""Images of flat plates. Only the tiles of an image that show a plate are drawn."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import Array, apply
from cmmsim.imaging.formation import ImageFormation, Side
from cmmsim.imaging.whole_image import TILE

# Points along each side of a plate, from which the extent of its distorted image is found.
OUTLINE_POINTS = 15


def plates_image(
    formation: ImageFormation,
    camera: PinholeCamera,
    camera_from_body: Array,
    plates: Sequence[Array],
    supersampling: int,
) -> NDArray[np.float32]:
    """Return the radiance (height, width) of the only body of a drawable.

    ``plates`` are the corners (4, 3) of its plates in body axes, m. All plates must stand in front
    of the camera.
    """
    image = np.full(
        (-(-camera.height // TILE) * TILE, -(-camera.width // TILE) * TILE),
        formation.background,
        dtype=np.float32,
    )
    margin = formation.optics.margin_px
    reached = [_reached_tiles(camera, camera_from_body, plate, margin) for plate in plates]
    corners = np.unique(np.concatenate(reached), axis=0)
    side = Side(camera, camera_from_body[None], corners)
    tiles = formation.windows([side], TILE, supersampling)[0]
    for (x, y), tile in zip(corners, tiles, strict=True):
        image[y : y + TILE, x : x + TILE] = tile
    return image[: camera.height, : camera.width]


def _reached_tiles(
    camera: PinholeCamera, camera_from_body: Array, plate: Array, margin: int
) -> NDArray[np.int_]:
    """Return the first pixels (k, 2) of the tiles within the bounding box of a plate (4, 3)."""
    fraction = np.linspace(0.0, 1.0, OUTLINE_POINTS)[:, None, None]
    outline = ((1.0 - fraction) * plate + fraction * np.roll(plate, -1, axis=0)).reshape(-1, 3)
    pixels = camera.project(apply(camera_from_body, outline))[0]
    size = np.array([camera.width, camera.height])
    first = np.clip(pixels.min(axis=0) - margin - 2.0, 0, size - 1).astype(int) // TILE
    last = np.clip(pixels.max(axis=0) + margin + 2.0, 0, size - 1).astype(int) // TILE
    x, y = np.meshgrid(*(TILE * np.arange(a, b + 1) for a, b in zip(first, last, strict=True)))
    return np.column_stack([x.ravel(), y.ravel()])
