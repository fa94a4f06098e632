"""Seeded poses in which both cameras see a whole board, all over their images and tilted to all sides."""

from __future__ import annotations

import numpy as np

from cmmsim.calibration.board import Board
from cmmsim.calibration.board_scene import plate_corners
from cmmsim.calibration_errors import CalibrationError
from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import Array, apply, invert, rotation_exp
from cmmsim.geometry.stereo_rig import StereoRig

LARGEST_TILT = 0.75  # rad between the board's normal and the view from the middle of the baseline
DEPTH_RANGE = (0.8, 1.2)  # of the depth at which the optical axes come nearest
CELLS = 3  # each image is divided into 3 x 3 cells that the board visits in turn
GRAZING = 0.35  # cosine between the board's normal and the view of either camera, at the least
TRIES = 4000  # poses drawn for one image before giving up


def default_board(rig: StereoRig) -> Board:
    """A board of 13 x 9 dots whose width is a third of what the left camera sees where the axes meet."""
    spacing = round(meeting_depth(rig) * rig.left.width / rig.left.focal_px / 3.0 / 13.0, 3)
    return Board(kind="dots", columns=13, rows=9, spacing=spacing, radius=round(0.25 * spacing, 5))


def meeting_depth(rig: StereoRig) -> float:
    """Depth along the left axis at which the right one comes nearest, m; for parallel axes 1.5 baselines."""
    right_axis, eye = invert(rig.right_from_left)[:3, 2], _right_eye(rig)
    across = 1.0 - right_axis[2] ** 2
    depth = (eye[2] - (eye @ right_axis) * right_axis[2]) / across if across > 1e-6 else 0.0
    return float(depth) if depth > 0.0 else 1.5 * float(np.linalg.norm(eye))


def board_poses(rig: StereoRig, board: Board, count: int, rng: np.random.Generator) -> list[Array]:
    """``count`` poses left_from_board (4,4).

    Raises CalibrationError when no such pose is found: the board is too large or too small for the rig.
    """
    return [_draw_pose(rig, board, k, rng) for k in range(count)]


def _draw_pose(rig: StereoRig, board: Board, number: int, rng: np.random.Generator) -> Array:
    """One pose in the cell whose turn it is, or in any where that cell shows no whole board to both cameras."""
    corners = plate_corners(board)
    middle, side = corners.mean(axis=0), number % 2
    camera, from_left = rig.cameras[side], rig.from_camera[side]
    for attempt in range(TRIES):
        cell = (4 + 2 * number) % CELLS**2 if attempt < TRIES // 2 else int(rng.integers(CELLS**2))
        depth = meeting_depth(rig) * rng.uniform(*DEPTH_RANGE)
        place = apply(invert(from_left), _point_in_cell(camera, cell, depth, rng))
        pose = np.eye(4)
        pose[:3, :3] = _facing(0.5 * _right_eye(rig) - place) @ _tilt(rng)
        pose[:3, 3] = place - pose[:3, :3] @ middle
        if rig.project(apply(pose, corners))[1].all() and _front_to_both(rig, pose, middle):
            return pose
    width, height = np.ptp(corners[:, :2], axis=0)
    raise CalibrationError(
        f"none of {TRIES} poses shows the whole board of {width:.3g} x {height:.3g} m to both "
        f"cameras at about {meeting_depth(rig):.3g} m: take a smaller one"
    )


def _point_in_cell(camera: PinholeCamera, cell: int, depth: float, rng: np.random.Generator) -> Array:
    """A point (3,) in camera axes that shows anywhere in one cell of the image, lens distortion aside."""
    row, column = divmod(cell, CELLS)
    pixel = (np.array([column, row]) + rng.random(2)) / CELLS * (camera.width, camera.height)
    return depth * np.append((pixel - camera.centre) / camera.focal_lengths, 1.0)


def _right_eye(rig: StereoRig) -> Array:
    return invert(rig.right_from_left)[:3, 3]


def _facing(towards: Array) -> Array:
    """Rotation (3,3) of a board whose front looks along ``towards`` (3,), its x axis horizontal in the left image."""
    z = -towards / np.linalg.norm(towards)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def _tilt(rng: np.random.Generator) -> Array:
    """A turn within the board's plane, then a tilt about a random axis in it."""
    about, tilt, turn = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.0, LARGEST_TILT), rng.uniform(-np.pi, np.pi)
    axis = np.array([np.cos(about), np.sin(about), 0.0])
    return rotation_exp(tilt * axis) @ rotation_exp(np.array([0.0, 0.0, turn]))


def _front_to_both(rig: StereoRig, pose: Array, middle: Array) -> bool:
    """Whether both cameras see the front, at more than a grazing angle."""
    place = apply(pose, middle)
    return all(
        float(pose[:3, 2] @ view) > GRAZING * float(np.linalg.norm(view)) for view in (place, place - _right_eye(rig))
    )
