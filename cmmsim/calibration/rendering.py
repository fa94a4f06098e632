"""Rendered calibration images: what the cameras of a sensor see of a board."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from cmmsim.calibration.board import Board
from cmmsim.calibration.board_scene import board_drawable, plate_corners
from cmmsim.calibration_errors import CalibrationError
from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import Array, apply
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.imaging.image_formation import ImageFormation, Side
from cmmsim.imaging.renderer import Renderer
from cmmsim.radiometry.images import StereoFrame
from cmmsim.radiometry.noise import CameraNoise
from cmmsim.radiometry.optics import Optics

TILE_PX = 64
SUPERSAMPLING = 12
OUTLINE_POINTS = 15  # along each side of the plate, to know where a bent one reaches


def render_pairs(
    rig: StereoRig,
    board: Board,
    poses: Sequence[Array],
    renderer: Renderer,
    optics: Optics,
    noise: CameraNoise,
    rng: np.random.Generator,
) -> Iterator[StereoFrame]:
    """Noisy images of both cameras for each pose left_from_board (4,4).

    Raises CalibrationError for a chessboard with the analytic renderer, which draws discs and convex solids only.
    """
    if board.kind == "chessboard" and renderer.name == "analytic":
        raise CalibrationError("the analytic renderer draws no chessboard: take the renderer pyrender, or a dot board")
    distance = float(np.mean([np.linalg.norm(pose[:3, 3]) for pose in poses]))
    formation = ImageFormation(renderer, board_drawable(board, distance), 0.0, optics)
    for pose in poses:
        sides = [
            noise.expose(_radiance(formation, camera, move @ pose, board), rng)
            for camera, move in zip(rig.cameras, rig.from_camera, strict=True)
        ]
        yield StereoFrame(*sides)


def _radiance(
    formation: ImageFormation, camera: PinholeCamera, camera_from_board: Array, board: Board
) -> NDArray[np.float32]:
    """Radiance (height, width) of one image; only tiles that the board reaches are drawn."""
    image = np.zeros((-(-camera.height // TILE_PX) * TILE_PX, -(-camera.width // TILE_PX) * TILE_PX), dtype=np.float32)
    corners = _reached_tiles(camera, camera_from_board, board, formation.optics.margin_px)
    tiles = formation.windows([Side(camera, camera_from_board[None], corners)], TILE_PX, SUPERSAMPLING)[0]
    for (x, y), tile in zip(corners, tiles, strict=True):
        image[y : y + TILE_PX, x : x + TILE_PX] = tile
    return image[: camera.height, : camera.width]


def _reached_tiles(camera: PinholeCamera, camera_from_board: Array, board: Board, margin: int) -> NDArray[np.int_]:
    """First pixels (k,2) of the tiles within the bounds of the board's plate."""
    plate = plate_corners(board)
    share = np.linspace(0.0, 1.0, OUTLINE_POINTS)[:, None, None]
    outline = ((1.0 - share) * plate + share * np.roll(plate, -1, axis=0)).reshape(-1, 3)
    pixels = camera.project(apply(camera_from_board, outline))[0]
    size = np.array([camera.width, camera.height])
    first = np.clip(pixels.min(axis=0) - margin - 2.0, 0, size - 1).astype(int) // TILE_PX
    last = np.clip(pixels.max(axis=0) + margin + 2.0, 0, size - 1).astype(int) // TILE_PX
    x, y = np.meshgrid(*(TILE_PX * np.arange(a, b + 1) for a, b in zip(first, last, strict=True)))
    return np.column_stack([x.ravel(), y.ravel()])
