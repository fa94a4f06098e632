"""Rendered calibration images: random poses of a board, and its images in a sensor's cameras."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmmsim.calibration.board import Board
from cmmsim.errors import CalibrationError
from cmmsim.geometry.camera import Optics
from cmmsim.geometry.pose import Array, apply, apply_each, frozen, invert, rigid
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.imaging.formation import ImageFormation
from cmmsim.imaging.prints import PRINT_SUPERSAMPLING, Print, plates_image, print_renderer
from cmmsim.imaging.renderer import Drawable, Renderer
from cmmsim.imaging.scene_bodies import SUNK, Disc, DiscStack, Mesh, Patch, solid_mesh
from cmmsim.radiometry.noise import CameraNoise
from cmmsim.radiometry.stereo_images import StereoFrame

# Width of the drawn plate beyond the outermost points, in spacings. On a board of squares, the
# outer squares fill this margin. A bright rim of width RIM, in spacings, surrounds them.
MARGIN = 1.0
RIM = 0.35
# Number of picture elements along the side of a square. OpenCV rounds sides of markers to elements.
SQUARE = 80
THICKNESS = 0.008  # m
# Reflectances of the bright and the dark parts of a board.
BRIGHT = 0.86
DARK = 0.06
# The normal of the front points against the board's z axis.
FRONT = frozen([0.0, 0.0, -1.0])
# Largest angle between the front's normal and the direction to the middle of the baseline, rad.
LARGEST_TILT = 0.75
# Range of the board's depth, in units of ``meeting_depth``.
DEPTH_RANGE = (0.8, 1.2)
# Each image is divided into CELLS x CELLS cells, in which the board appears in turn.
CELLS = 3
# Smallest cosine of the angle between the board's z axis and the line from either camera to it.
GRAZING = 0.35
# Largest number of poses tried for one pair, and number of poses that are examined together.
TRIES = 4000
AT_ONCE = 200
# Number of samples per pixel and axis in the images of dots.
SUPERSAMPLING = 12


def board_drawable(board: Board, distance: float) -> Drawable:
    """Return the plate and the dots of a board as one body in the board frame.

    ``distance`` is the distance from the cameras to the board, m.
    """
    ground, mark = (BRIGHT, DARK) if board.dark else (DARK, BRIGHT)
    dots = [DiscStack((Disc(point, FRONT, board.dot_radius, mark),)) for point in board.points]
    patches: list[Patch] = [*dots, _plate(board, ground)]
    return Drawable(patches, [0] * len(patches), distance)


def plate_corners(board: Board) -> Array:
    """Return the corners (4, 3) of the plate's front in the board frame, m."""
    points = board.points
    rim = board.spacing * (MARGIN + (RIM if board.has_squares else 0.0))
    x0, y0 = points[:, :2].min(axis=0) - rim
    x1, y1 = points[:, :2].max(axis=0) + rim
    return np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]])


def _plate(board: Board, level: float) -> Mesh:
    corners = plate_corners(board)
    size = [*(corners[2, :2] - corners[0, :2]), THICKNESS]
    mesh = trimesh.creation.box(extents=size)
    mesh.apply_translation([*corners[:, :2].mean(axis=0), SUNK + 0.5 * THICKNESS])
    return solid_mesh(mesh, level)


def _squares(board: Board) -> Print:
    """Return the print of a board of squares, with its bright rim."""
    columns = board.columns + 1
    rows = board.rows + 1
    rim = round(RIM * SQUARE)
    if board.kind == "chessboard":
        parity = np.add.outer(np.arange(rows), np.arange(columns))
        bright = np.kron(parity % 2, np.ones((SQUARE, SQUARE), dtype=int))
    else:
        bright = board.charuco().generateImage((columns * SQUARE, rows * SQUARE)) // 255
    levels = np.where(np.pad(bright, rim, constant_values=1), BRIGHT, DARK).astype(np.float32)
    # The frame of a print begins at its corner, and that of a board at its first point.
    board_from_print = rigid(np.eye(3), plate_corners(board)[0])
    return Print(levels, board.spacing / SQUARE, board_from_print)


def default_board(rig: StereoRig) -> Board:
    """Return a board of 13 x 9 dots.

    Where the optical axes meet, its dots span about a third of the left image's width.
    """
    spacing = round(meeting_depth(rig) * rig.left.width / rig.left.focal_px / 3.0 / 13.0, 3)
    return Board(kind="dots", columns=13, rows=9, spacing=spacing, radius=round(0.25 * spacing, 5))


def meeting_depth(rig: StereoRig) -> float:
    """Return the depth along the left optical axis at which the right axis comes nearest, m.

    It is 1.5 baselines for axes that are parallel or come nearest behind the cameras.
    """
    right_axis = invert(rig.right_from_left)[:3, 2]
    eye = rig.right_centre
    # No point of the left axis is nearest to a parallel right axis.
    across = 1.0 - right_axis[2] ** 2
    depth = (eye[2] - (eye @ right_axis) * right_axis[2]) / across if across > 1e-6 else 0.0
    return float(depth) if depth > 0.0 else 1.5 * float(np.linalg.norm(eye))


def board_poses(rig: StereoRig, board: Board, count: int, rng: np.random.Generator) -> list[Array]:
    """Draw ``count`` random poses left_from_board (4, 4).

    Both cameras see the whole front of the board in each of them. Raises CalibrationError if no
    such pose is found.
    """
    return [_draw_pose(rig, board, k, rng) for k in range(count)]


def _draw_pose(rig: StereoRig, board: Board, number: int, rng: np.random.Generator) -> Array:
    """Draw one pose that shows the whole board to both cameras.

    An even ``number`` selects a cell of the left image, an odd one a cell of the right image. The
    board's middle lies in this cell, or in any cell of the image if the first half of the tries
    fails. Raises CalibrationError if all tries fail.
    """
    corners = plate_corners(board)
    depth = meeting_depth(rig)
    for first in range(0, TRIES, AT_ONCE):
        before = rng.bit_generator.state
        drawn = _drawn_numbers(number, first, AT_ONCE, rng)
        poses = _poses_of(rig, corners.mean(axis=0), depth, number % 2, *drawn)
        good = rig.project(apply_each(poses, corners))[1].all(axis=(0, 2)) & _front_to_both(
            rig, poses, corners
        )
        if good.any():
            chosen = int(np.argmax(good))
            # Reset the random stream to its state directly after the chosen pose.
            rng.bit_generator.state = before
            _drawn_numbers(number, first, chosen + 1, rng)
            return np.asarray(poses[chosen])
    width, height = np.ptp(corners[:, :2], axis=0)
    raise CalibrationError(
        f"none of {TRIES} poses shows the whole board of {width:.3g} x {height:.3g} m to both "
        f"cameras at about {depth:.3g} m: use a smaller board"
    )


def _drawn_numbers(
    number: int, first: int, count: int, rng: np.random.Generator
) -> tuple[NDArray[np.int_], Array]:
    """Return the cells (count,) of tries, and random numbers (count, 6) from 0 to 1.

    The tries for pose ``number`` begin with the index ``first``. In the second half of all tries,
    the cells are random, too.
    """
    own_cell = (4 + 2 * number) % CELLS**2
    if first < TRIES // 2:
        return np.full(count, own_cell), rng.random((count, 6))
    drawn = [(int(rng.integers(CELLS**2)), rng.random(6)) for _ in range(count)]
    return np.array([cell for cell, _ in drawn]), np.array([numbers for _, numbers in drawn])


def _poses_of(
    rig: StereoRig, middle: Array, depth: float, side: int, cells: NDArray[np.int_], numbers: Array
) -> Array:
    """Return poses left_from_board (n, 4, 4) that show the middle (3,) of a board in given cells.

    ``cells`` (n,) are cells of the image of camera ``side``, and ``depth`` is the mean depth, m.
    Numbers (n, 6) from 0 to 1 determine the exact depth, the pixel, the tilt and the turn. The
    front first faces the middle of the baseline. Then the board is turned within its plane, and
    tilted about a random axis in that plane.
    """
    camera = rig.cameras[side]
    from_left = rig.from_camera[side]
    low, high = DEPTH_RANGE
    depths = depth * (low + (high - low) * numbers[:, 0])
    corner = np.column_stack([cells % CELLS, cells // CELLS])
    pixels = (corner + numbers[:, 1:3]) / CELLS * (camera.width, camera.height)
    ideal = np.column_stack([(pixels - camera.centre) / camera.focal_lengths, np.ones(len(cells))])
    middles = apply(invert(from_left), depths[:, None] * ideal)
    about = 2.0 * np.pi * numbers[:, 3]
    tilt = LARGEST_TILT * numbers[:, 4]
    turn = np.pi * (2.0 * numbers[:, 5] - 1.0)
    axes = np.column_stack([np.cos(about), np.sin(about), np.zeros(len(cells))])
    tilted = Rotation.from_rotvec(tilt[:, None] * axes) * Rotation.from_euler("z", turn[:, None])
    poses = np.zeros((len(cells), 4, 4))
    poses[:, :3, :3] = _facing(0.5 * rig.right_centre - middles) @ tilted.as_matrix()
    poses[:, :3, 3] = middles - poses[:, :3, :3] @ middle
    poses[:, 3, 3] = 1.0
    return poses


def _facing(towards: Array) -> Array:
    """Return rotations (n, 3, 3) of boards whose fronts face along ``towards`` (n, 3).

    Their x axes are perpendicular to the y axis of the left camera.
    """
    z = -towards / np.linalg.norm(towards, axis=1, keepdims=True)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=2)


def _front_to_both(rig: StereoRig, poses: Array, corners: Array) -> NDArray[np.bool_]:
    """Return a mask (n,) of the poses (n, 4, 4) at which both cameras see the front of a board.

    A view at a grazing angle does not count.
    """
    middles = poses[:, :3, :3] @ corners.mean(axis=0) + poses[:, :3, 3]
    views = np.stack([middles, middles - rig.right_centre])
    return np.asarray(
        (
            np.einsum("ni,sni->sn", poses[:, :3, 2], views)
            > GRAZING * np.linalg.norm(views, axis=2)
        ).all(axis=0)
    )


def render_pairs(
    rig: StereoRig,
    board: Board,
    poses: Sequence[Array],
    renderer: Renderer,
    optics: Optics,
    noise: CameraNoise,
    rng: np.random.Generator,
) -> Iterator[StereoFrame]:
    """Yield noisy images of both cameras for each pose left_from_board (4, 4).

    The renderer draws boards of dots. Boards of squares are drawn as prints instead.
    """
    renderer = print_renderer([_squares(board)]) if board.has_squares else renderer
    distance = float(np.mean([np.linalg.norm(pose[:3, 3]) for pose in poses]))
    formation = ImageFormation(renderer, board_drawable(board, distance), 0.0, optics)
    plate = plate_corners(board)
    samples = PRINT_SUPERSAMPLING if board.has_squares else SUPERSAMPLING
    for pose in poses:
        sides = [
            noise.expose(plates_image(formation, camera, move @ pose, [plate], samples), rng)
            for camera, move in zip(rig.cameras, rig.from_camera, strict=True)
        ]
        yield StereoFrame(*sides)
