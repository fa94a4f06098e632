"""Flat prints, such as chessboards and tags, and whole images of flat plates.

A perfect lens images a plane by a homography. The point of the print that a sample of a pixel shows
is therefore exact. The renderer of prints draws nothing else, so `ImageFormation` adds distortion,
point spread and pixels as it does for stickers. Only tiles of an image that show a plate are drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import Array, apply
from cmmsim.imaging.formation import ImageFormation, Side
from cmmsim.imaging.renderer import NEAR, Drawable, Renderer, View, Views
from cmmsim.imaging.whole_image import TILE

# Number of drawn samples per pixel and axis. Sampling errors average out along an edge.
PRINT_SUPERSAMPLING = 6
# Number of points along each side of a plate, from which the extent of its image is computed.
OUTLINE_POINTS = 15


@dataclass(frozen=True)
class Print:
    """Flat print on a body.

    Its frame has the origin at the outer corner of the first picture element. The x axis points
    along the rows, the y axis down the columns, and the z axis away from an observer who looks at
    the front.

    levels           (rows, columns), radiance 0 to 1 of the picture elements
    side             side of a picture element, m
    body_from_print  (4, 4)
    body             index of the body
    """

    levels: NDArray[np.float32]
    side: float
    body_from_print: Array
    body: int = 0

    @property
    def corners(self) -> Array:
        """Corners (4, 2) in picture elements: first, along x, opposite, and along y."""
        height, width = self.levels.shape
        return np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])


def print_renderer(prints: Sequence[Print]) -> Renderer:
    """Return a renderer that draws prints in their order, whatever drawable it is given."""
    return Renderer("prints", partial(_draw_windows, prints))


def _draw_windows(
    prints: Sequence[Print],
    drawable: Drawable,
    views: Sequence[View],
    supersampling: int,
    background: float = 0.0,
) -> NDArray[np.float32]:
    """Draw the radiance (n, h, w) of n windows. Each pixel has ``supersampling``² samples.

    A print is left out if a camera stands behind it, or if a part of it is nearer than NEAR.
    """
    # Imported late, because importing numba takes time.
    from cmmsim.imaging.print_kernels import draw_print

    views = Views.of(views)
    width, height = views.size
    images = np.full((len(views), height, width), background, dtype=np.float32)
    for shown in views.exposures:
        for each in prints:
            camera_from_print = shown.camera_from_bodies[each.body] @ each.body_from_print
            corners = camera_from_print[:3, :2] @ (each.side * each.corners.T)
            depths = corners[2] + camera_from_print[2, 3]
            # The front is hidden from a camera behind the print.
            if depths.min() < NEAR or camera_from_print[:3, 2] @ camera_from_print[:3, 3] <= 0.0:
                continue
            plane = camera_from_print[:3, [0, 1, 3]] * [each.side, each.side, 1.0]
            pixels_from_texels = shown.camera.matrix @ plane
            outline = pixels_from_texels @ [*each.corners.T, np.ones(4)]
            pixels = outline[:2] / outline[2]
            for k in shown.windows:
                shift = np.eye(3)
                shift[:2, 2] = -views.corners[k]
                low = np.floor(pixels.min(axis=1) - views.corners[k])
                high = np.ceil(pixels.max(axis=1) - views.corners[k])
                if (high < 0.0).any() or (low >= views.size).any():
                    continue
                draw_print(
                    images[k],
                    np.linalg.inv(shift @ pixels_from_texels),
                    each.levels,
                    np.concatenate([low, high]).astype(int),
                    supersampling,
                )
    return images


def plates_image(
    formation: ImageFormation,
    camera: PinholeCamera,
    camera_from_body: Array,
    plates: Sequence[Array],
    supersampling: int,
) -> NDArray[np.float32]:
    """Return the radiance (height, width) of a whole image of the only body of a drawable.

    ``plates`` are the corners (4, 3) of its plates in body axes, m. All plates must stand in front
    of the camera. The image beside them shows the background.
    """
    image = np.full(
        (-(-camera.height // TILE) * TILE, -(-camera.width // TILE) * TILE),
        formation.background,
        dtype=np.float32,
    )
    margin = formation.reach_px(camera)
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
    """Return the first pixels (k, 2) of the tiles that the bounding box of a plate (4, 3) reaches.

    The box is that of its distorted image, with ``margin`` px on all sides.
    """
    fraction = np.linspace(0.0, 1.0, OUTLINE_POINTS)[:, None, None]
    outline = ((1.0 - fraction) * plate + fraction * np.roll(plate, -1, axis=0)).reshape(-1, 3)
    pixels = camera.project(apply(camera_from_body, outline))[0]
    size = np.array([camera.width, camera.height])
    first = np.clip(pixels.min(axis=0) - margin - 2.0, 0, size - 1).astype(int) // TILE
    last = np.clip(pixels.max(axis=0) + margin + 2.0, 0, size - 1).astype(int) // TILE
    x, y = np.meshgrid(*(TILE * np.arange(a, b + 1) for a, b in zip(first, last, strict=True)))
    return np.column_stack([x.ravel(), y.ravel()])
