"""Initial values of the adjustment from OpenCV's calibration of each camera and of both together.

The points of a symmetric board can be numbered in several orders (half a turn, quarter turns), and
the order is found for each picture separately. If the two pictures of a pair have different orders,
they give a wrong pose of the right camera. The order in each right picture is therefore chosen such
that most pairs agree on this pose. Here, a pair is a left and a right picture of one exposure.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from cmmsim.calibration.adjustment import RigState, camera_matrix
from cmmsim.calibration.board import Board
from cmmsim.calibration.board_detection import BoardView
from cmmsim.calibration.sightings import SIDES, PairView, views_of
from cmmsim.errors import CalibrationError
from cmmsim.geometry.pose import Array, invert, rigid

# Smallest number of different views of each camera, and of pairs that agree on right_from_left.
FEWEST_VIEWS = 3
# Pairs with fewer common points are left out of OpenCV's stereo calibration.
FEWEST_COMMON = 6
# Two pictures of a camera count as one view if their points differ by less than this, px rms.
ALIKE_PX = 2.0
# Poses of the right camera count as the same if they differ by less than this angle, rad, and by
# less than this fraction of the baseline.
ALIKE_ANGLE = 0.06
ALIKE_SHIFT = 0.12
MISFIT = (
    "the right camera's pose from this pair differs from that of most pairs: the images do not "
    "belong together, or the board moved between the exposures"
)


def start_values(
    board: Board,
    pairs: Sequence[PairView],
    size: tuple[int, int],
    radial_terms: bool,
    fix_aspect: bool,
) -> tuple[RigState, list[PairView]]:
    """Return the initial state, and the pairs with the same order of points in both images.

    A pair that does not agree with the others on right_from_left loses both views. The reason
    replaces each of them. If ``radial_terms`` is True, two radial terms of distortion are
    estimated. ``size`` is (width, height) px. Raises CalibrationError if a camera has too few
    different views, if OpenCV finds no camera, or if too few pairs agree on right_from_left.
    """
    left, in_left = _one_camera(board, pairs, 0, size, radial_terms, fix_aspect)
    right, in_right = _one_camera(board, pairs, 1, size, radial_terms, fix_aspect)
    read, in_right, right_from_left = _with_agreeing_orders(board, pairs, in_left, in_right)
    right_from_left = _stereo(board, read, (left, right), size, right_from_left)
    # Boards that no camera sees get any pose, which is not used.
    boards = [
        in_left[k] if k in in_left else invert(right_from_left) @ in_right.get(k, np.eye(4))
        for k in range(len(pairs))
    ]
    return RigState(np.stack([left, right]), right_from_left, np.stack(boards)), read


def _one_camera(
    board: Board,
    pairs: Sequence[PairView],
    side: int,
    size: tuple[int, int],
    radial_terms: bool,
    fix_aspect: bool,
) -> tuple[Array, dict[int, Array]]:
    """Return the intrinsics (9,) of one camera, and camera_from_board (4, 4) for each of its views.

    The keys are the indices of the pairs. Raises CalibrationError if the camera has too few
    different views, or if OpenCV finds no valid camera.
    """
    views = views_of(pairs, side)
    if len(views) < FEWEST_VIEWS:
        raise CalibrationError(
            f"the {SIDES[side]} camera sees the board in {len(views)} images, "
            f"but {FEWEST_VIEWS} are needed"
        )
    _require_variety(list(views.values()), board.symmetries, SIDES[side])
    # two radial terms are enough for start values; the adjustment frees the other terms
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    flags |= 0 if radial_terms else cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2
    flags |= cv2.CALIB_FIX_ASPECT_RATIO if fix_aspect else 0
    points = [board.points[view.index].astype(np.float32) for view in views.values()]
    pixels = [view.pixels.astype(np.float32) for view in views.values()]
    try:
        _, matrix, terms, rotation_vectors, translations = cv2.calibrateCamera(
            points, pixels, size, np.eye(3), np.zeros(5), flags=flags
        )
    except cv2.error as error:
        raise CalibrationError(
            f"OpenCV finds no {SIDES[side]} camera for these views: {error.err}; show the board "
            "tilted to several sides"
        ) from error
    values = np.array(
        [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *np.ravel(terms)[:5]], dtype=float
    )
    poses = [
        rigid(cv2.Rodrigues(turn)[0], np.ravel(shift))
        for turn, shift in zip(rotation_vectors, translations, strict=True)
    ]
    if not (np.isfinite(values).all() and values[:2].min() > 0.0 and np.isfinite(poses).all()):
        raise CalibrationError(
            f"OpenCV's {SIDES[side]} camera is not valid (focal lengths {values[:2]}): show the "
            "board tilted to several sides"
        )
    return values, dict(zip(views, poses, strict=True))


def _require_variety(
    views: Sequence[BoardView], orders: Sequence[NDArray[np.int_]], camera: str
) -> None:
    """Raise CalibrationError if a camera has too few different views.

    ``orders`` are the board's symmetries. Two views that agree in any of these orders count as one.
    """
    different: list[BoardView] = []
    for view in views:
        readings = [view.read_as(order) for order in orders]
        if not any(
            _distance(reading, other) < ALIKE_PX for reading in readings for other in different
        ):
            different.append(view)
    if len(different) < FEWEST_VIEWS:
        places = "one place" if len(different) == 1 else f"{len(different)} places"
        raise CalibrationError(
            f"the {len(views)} pictures of the {camera} camera are alike: they show the board in "
            f"{places} only (within {ALIKE_PX:g} px), but at least {FEWEST_VIEWS} are needed; move "
            "and tilt the board from picture to picture"
        )


def _distance(a: BoardView, b: BoardView) -> float:
    """Return the rms distance of the points that both views show, px; inf if they share none."""
    _, in_a, in_b = np.intersect1d(a.index, b.index, return_indices=True)
    difference: Array = a.pixels[in_a] - b.pixels[in_b]
    return float(np.sqrt(np.mean(np.sum(difference**2, axis=1)))) if len(difference) else np.inf


def _with_agreeing_orders(
    board: Board,
    pairs: Sequence[PairView],
    from_left: dict[int, Array],
    from_right: dict[int, Array],
) -> tuple[list[PairView], dict[int, Array], Array]:
    """Order the points of each right image such that most pairs agree on right_from_left.

    ``from_left`` and ``from_right`` are the poses left_from_board and right_from_board, by the
    pair's index. Return the pairs with the points in this order, the poses right_from_board in this
    order, and right_from_left (4, 4). In a pair that agrees in no order, the reason MISFIT replaces
    both views. Raises CalibrationError if fewer than half of the pairs or FEWEST_VIEWS pairs agree.
    """
    orders = board.symmetries
    symmetry_motions = [_symmetry_motion(board, order) for order in orders]
    candidates = [(k, j) for k, pair in enumerate(pairs) if pair.both for j in range(len(orders))]
    rigs = np.stack(
        [from_right[k] @ symmetry_motions[j] @ invert(from_left[k]) for k, j in candidates]
    )
    alike = _nearly_equal(rigs)
    pair_of = np.array([k for k, _ in candidates])
    support = np.array([len(set(pair_of[row])) for row in alike])
    angle = _angles(rigs, np.eye(3)[None])[:, 0]
    # Several orders can have equal support. The smallest angle between the cameras is most likely.
    best = int(np.lexsort((angle, -support))[0])
    count = sum(pair.both for pair in pairs)
    if support[best] < max(FEWEST_VIEWS, 0.5 * count):
        raise CalibrationError(
            f"only {support[best]} of {count} pairs agree on the place of the right camera: the "
            "images of a pair were not taken together, or the folders are paired wrongly"
        )
    chosen = {candidates[i][0]: i for i in np.flatnonzero(alike[best])}
    read = list(pairs)
    for k, pair in enumerate(pairs):
        if pair.both and k not in chosen:
            read[k] = PairView(pair.name, MISFIT, MISFIT)
        elif pair.both and not isinstance(pair.right, str):
            read[k] = PairView(
                pair.name, pair.left, pair.right.read_as(orders[candidates[chosen[k]][1]])
            )
    return (
        read,
        from_right | {k: rigs[i] @ from_left[k] for k, i in chosen.items()},
        rigs[best],
    )


def _symmetry_motion(board: Board, order: NDArray[np.int_]) -> Array:
    """Return the rigid motion (4, 4) in the board's plane that moves points[order] onto points."""
    points = board.points
    renamed = board.points[order]
    renamed_side = renamed[1] - renamed[0]
    side = points[1] - points[0]
    angle = np.arctan2(side[1], side[0]) - np.arctan2(renamed_side[1], renamed_side[0])
    rotation = np.array(
        [[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]]
    )
    return rigid(rotation, points[0] - rotation @ renamed[0])


def _nearly_equal(transforms: Array) -> Array:
    """Return a mask (n, n), which is True where two of n transforms (4, 4) are nearly equal."""
    shifts = transforms[:, :3, 3]
    distances = np.linalg.norm(shifts[:, None] - shifts[None], axis=2)
    near = distances < ALIKE_SHIFT * np.linalg.norm(shifts, axis=1)[:, None]
    return np.asarray(near & (_angles(transforms, transforms[:, :3, :3]) < ALIKE_ANGLE))


def _angles(transforms: Array, rotations: Array) -> Array:
    """Return the angles (n, m), rad, between transforms (n, 4, 4) and rotations (m, 3, 3)."""
    trace = np.einsum("nij,mij->nm", transforms[:, :3, :3], rotations)
    return np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))


def _stereo(
    board: Board,
    pairs: Sequence[PairView],
    cameras: tuple[Array, Array],
    size: tuple[int, int],
    guess: Array,
) -> Array:
    """Return right_from_left (4, 4) by OpenCV, from the points that both cameras see.

    The intrinsics ``cameras`` (9,) of both cameras are fixed. If OpenCV fails, the result is
    ``guess``.
    """
    points = []
    left = []
    right = []
    left_views = views_of(pairs, 0)
    right_views = views_of(pairs, 1)
    for k in sorted(left_views.keys() & right_views.keys()):
        left_view = left_views[k]
        right_view = right_views[k]
        index, in_a, in_b = np.intersect1d(left_view.index, right_view.index, return_indices=True)
        if len(index) < FEWEST_COMMON:
            continue
        points.append(board.points[index].astype(np.float32))
        left.append(left_view.pixels[in_a].astype(np.float32))
        right.append(right_view.pixels[in_b].astype(np.float32))
    lenses = [(camera_matrix(values), values[4:]) for values in cameras]
    try:
        results = cv2.stereoCalibrate(
            points, left, right, *lenses[0], *lenses[1], size, flags=cv2.CALIB_FIX_INTRINSIC
        )
    except cv2.error:
        return guess
    right_from_left = rigid(results[5], np.ravel(results[6]))
    return right_from_left if np.isfinite(right_from_left).all() else guess
