"""One least-squares adjustment of both cameras, their relative pose and all board poses.

The observations are all measured pixels. Nine intrinsics describe a camera: focal lengths fx, fy
and principal point cx, cy in px, then k1, k2, p1, p2, k3 of Brown and Conrady as OpenCV orders
them. Intrinsics that are not free keep their start values.

Levenberg and Marquardt's method solves the normal equations. A board pose is seen by its own view
only, so the poses are eliminated view by view (Schur complement), which leaves the reduced normal
matrix N of the free intrinsics and of right_from_left. All pixels have equal weight, and their
variance sigma² is estimated from the residuals. The covariance of independent errors is sigma²
N^-1; it is enlarged where the points of a view share their errors.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from scipy.linalg import block_diag

from cmmsim.calibration.shared_errors import SharedErrors, shared_errors
from cmmsim.calibration.sightings import Sightings
from cmmsim.errors import CalibrationError, UnknownOptionError
from cmmsim.geometry.camera import INTRINSIC_NAMES
from cmmsim.geometry.pose import Array, apply, rotation_exp, skew

DISTORTIONS = {"none": (), "radial2": ("k1", "k2"), "brown5": ("k1", "k2", "p1", "p2", "k3")}
DEFAULT_DISTORTION = "brown5"
MOST_STEPS = 60
# Relative decrease of the sum of squares that ends the iteration.
SMALLEST_GAIN = 1e-11
# smallest eigenvalue of N, scaled to a unit diagonal, below which nothing is determined
SINGULAR = 1e-14
# Unknowns of a pose, then the places of the unknowns of all views and of one view's board.
POSE = 6
COMMON = slice(None, -POSE)
BOARD = slice(-POSE, None)


def free_directions(distortion: str, fix_aspect: bool) -> Array:
    """Return the matrix (9, k) from the k free numbers of a camera to all nine.

    ``distortion`` names the free terms, a key of DISTORTIONS. ``fix_aspect`` sets fx = fy. Raises
    UnknownOptionError.
    """
    if distortion not in DISTORTIONS:
        raise UnknownOptionError("distortion", distortion, DISTORTIONS)
    terms = DISTORTIONS[distortion]
    chosen = [name.endswith("_px") or name in terms for name in INTRINSIC_NAMES]
    free = np.eye(len(INTRINSIC_NAMES))[:, chosen]
    if fix_aspect:
        free[:, 0] += free[:, 1]
        free = np.delete(free, 1, axis=1)
    return free


def camera_matrix(values: Array) -> Array:
    """Return OpenCV's matrix (3, 3) of a camera's intrinsics (9,)."""
    return np.array([[values[0], 0.0, values[2]], [0.0, values[1], values[3]], [0.0, 0.0, 1.0]])


def project(values: Array, points: Array) -> tuple[Array, Array, Array]:
    """Return the pixels (n, 2) of points (n, 3) in camera axes, and their derivatives.

    The derivatives are by the intrinsics (n, 2, 9) and by the points (n, 2, 3), px/m. The points
    must lie before the camera.
    """
    pixels, jacobian = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), camera_matrix(values), values[4:]
    )
    # OpenCV's columns are 3 of the turn, 3 of the shift, 2 of f, 2 of c, and 5 of the distortion.
    by_all = np.asarray(jacobian, dtype=float).reshape(len(points), 2, -1)
    return np.asarray(pixels, dtype=float).reshape(-1, 2), by_all[:, :, 6:15], by_all[:, :, 3:6]


@dataclass(frozen=True)
class RigState:
    """State of the rig and of the boards of v views.

    It has intrinsics (2, 9), right_from_left (4, 4), and left_from_boards (v, 4, 4).
    """

    intrinsics: Array
    right_from_left: Array
    left_from_boards: Array

    @property
    def largest_tilt(self) -> float:
        """Largest angle between the normals of any two boards, rad."""
        normals = self.left_from_boards[:, :3, 2]
        return float(np.arccos(np.clip((normals @ normals.T).min(), -1.0, 1.0)))

    def moved(self, intrinsics: Array, right: Array, boards: Array) -> "RigState":
        """Return the state after changes of all its parts.

        They are changes of the intrinsics (2, 9), and small errors [dt, dphi] of right_from_left
        (6,) and of the boards (v, 6).
        """
        return RigState(
            self.intrinsics + intrinsics,
            _moved(self.right_from_left, right),
            np.stack(
                [_moved(b, change) for b, change in zip(self.left_from_boards, boards, strict=True)]
            ),
        )


def _moved(transform: Array, change: Array) -> Array:
    moved = transform.copy()
    moved[:3, 3] += change[:3]
    moved[:3, :3] = rotation_exp(change[3:]) @ transform[:3, :3]
    return moved


@dataclass(frozen=True)
class Adjustment:
    """Result of an adjustment.

    ``residuals`` (m, 2) of each camera are measured minus computed pixels, and ``sigma_px`` is the
    estimated standard deviation of a pixel coordinate. ``covariance`` (24, 24) belongs to the left
    and right intrinsics (9 each) and to the small error [dt, dphi] of right_from_left;
    ``independent_covariance`` assumes independent errors of all points. ``condition`` is the
    condition number of N scaled to a unit diagonal. ``freedom`` is the number of observations minus
    unknowns, and ``shared`` describes errors that points of a view share.
    """

    state: RigState
    residuals: tuple[Array, Array]
    sigma_px: float
    covariance: Array
    independent_covariance: Array
    condition: float
    steps: int
    freedom: int
    shared: SharedErrors


@dataclass(frozen=True)
class _Normal:
    """Normal equations by view.

    ``matrix`` (v, s, s) and ``side`` (v, s) belong to the c common unknowns and, last, to the pose
    of the view's board; s = c + 6. ``cost`` is the sum of the squared residuals of both cameras,
    px².
    """

    matrix: Array
    side: Array
    residuals: tuple[Array, Array]
    cost: float

    def blocks(self, damping: float = 0.0) -> tuple[Array, Array, Array]:
        """Return the blocks of the common unknowns (v, c, c), mixed (v, c, 6) and of the boards (v,
        6, 6).

        The damping enlarges their diagonals.
        """
        damped = self.matrix + damping * self.matrix * np.eye(self.matrix.shape[1])
        return damped[:, COMMON, COMMON], damped[:, COMMON, BOARD], damped[:, BOARD, BOARD]

    def reduced(self, damping: float = 0.0) -> tuple[Array, Array]:
        """Return each view's share of the reduced normal matrix (v, c, c) and of its right-hand
        side (v, c).
        """
        common, mixed, boards = self.blocks(damping)
        eliminated = np.linalg.solve(boards, mixed.swapaxes(1, 2)).swapaxes(1, 2)
        matrix = np.asarray(common - eliminated @ mixed.swapaxes(1, 2), dtype=np.float64)
        return matrix, self.side[:, COMMON] - np.einsum(
            "vci,vi->vc", eliminated, self.side[:, BOARD]
        )

    def step(self, damping: float) -> tuple[Array, Array]:
        """Return the damped changes of the common unknowns (c,) and of the boards (v, 6)."""
        matrix, side = (part.sum(axis=0) for part in self.reduced(damping))
        # Focal lengths and distortion terms differ by ten orders of magnitude: a unit diagonal
        # keeps digits.
        scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        common = (
            scale * np.linalg.lstsq(matrix * scale[:, None] * scale, scale * side, rcond=1e-15)[0]
        )
        _, mixed, boards = self.blocks(damping)
        rest = self.side[:, BOARD] - np.einsum("vci,c->vi", mixed, common)
        return common, np.linalg.solve(boards, rest[..., None])[..., 0]


def adjust(
    points: Array, sightings: tuple[Sightings, Sightings], start: RigState, free: Array
) -> Adjustment:
    """Adjust the rig and the board poses to sightings of points (n, 3) m of the board.

    Each view is seen by at least one camera. ``free`` (9, k) is the result of ``free_directions``.
    Raises CalibrationError where the views do not determine the cameras.
    """

    def build(state: RigState) -> _Normal:
        return _normal_equations(points, sightings, state, free)

    state, steps = _minimise(build, start, free)
    normal = build(state)
    size = normal.side.shape[1] - POSE
    freedom = sum(2 * len(s.view) for s in sightings) - size - POSE * len(state.left_from_boards)
    if freedom < 1:
        raise CalibrationError(
            f"too few points: {freedom + size} more observations than board poses, more than "
            f"{size} needed"
        )
    information, scores = normal.reduced()
    reduced = information.sum(axis=0)
    scale = 1.0 / np.sqrt(np.diag(reduced))
    eigenvalues = np.linalg.eigvalsh(reduced * scale[:, None] * scale)
    if not eigenvalues[0] > SINGULAR:
        raise CalibrationError(
            "these views do not determine the cameras (smallest eigenvalue of the scaled normal "
            f"matrix {eigenvalues[0]:.1e}): show the board tilted to several sides, all over the "
            "image"
        )
    sigma2 = normal.cost / freedom
    shared = shared_errors(scores, information, sigma2)
    spread = block_diag(free, free, np.eye(POSE))  # (24,c), from the free unknowns to all
    return Adjustment(
        state,
        normal.residuals,
        float(np.sqrt(sigma2)),
        spread @ shared.covariance @ spread.T,
        spread @ shared.independent @ spread.T,
        float(eigenvalues[-1] / eigenvalues[0]),
        steps,
        freedom,
        shared,
    )


def _minimise(
    build: Callable[[RigState], _Normal], state: RigState, free: Array
) -> tuple[RigState, int]:
    """Minimise by Levenberg and Marquardt; return the state of least cost and the steps taken."""
    damping = 1e-4
    normal = build(state)
    k = free.shape[1]
    for step in range(1, MOST_STEPS + 1):
        common, boards = normal.step(damping)
        trial = state.moved(common[: 2 * k].reshape(2, k) @ free.T, common[2 * k :], boards)
        attempt = build(trial)
        if attempt.cost < normal.cost:
            gain = (normal.cost - attempt.cost) / normal.cost
            state = trial
            normal = attempt
            damping = max(0.1 * damping, 1e-12)
            if gain < SMALLEST_GAIN:
                return state, step
        elif (
            damping > 1e6 or abs(common @ normal.side[:, COMMON].sum(axis=0)) <= 1e-8 * normal.cost
        ):
            # A step that does not help is rounding: it would lower the cost by next to nothing.
            return state, step
        else:
            damping *= 10.0
    rms = np.sqrt(normal.cost / sum(len(r) for r in normal.residuals))
    raise CalibrationError(
        f"the adjustment has not converged in {MOST_STEPS} steps (rms {rms:.3g} px, board normals "
        f"differ by at most {np.degrees(state.largest_tilt):.1f} degrees): show the board tilted "
        "to several sides, by 30 degrees and more, or free fewer terms of distortion"
    )


def _normal_equations(
    points: Array, sightings: tuple[Sightings, Sightings], state: RigState, free: Array
) -> _Normal:
    common = 2 * free.shape[1] + POSE
    views = len(state.left_from_boards)
    residuals = []
    matrix = np.zeros((views, common + POSE, common + POSE))
    sides = np.zeros((views, common + POSE))
    for side, seen in enumerate(sightings):
        computed, by_common, by_board = _predict(points, seen, state, side, free)
        error = seen.pixels - computed
        residuals.append(error)
        # Sightings are sorted by view, so that each view is a slice.
        edges = np.searchsorted(seen.view, np.arange(views + 1))
        for v, (first, last) in enumerate(pairwise(edges)):
            jc = by_common[first:last].reshape(-1, common)
            e = error[first:last].ravel()
            jb = by_board[first:last].reshape(-1, POSE)
            matrix[v, COMMON, COMMON] += jc.T @ jc
            matrix[v, COMMON, BOARD] += jc.T @ jb
            matrix[v, BOARD, BOARD] += jb.T @ jb
            sides[v, COMMON] += jc.T @ e
            sides[v, BOARD] += jb.T @ e
    cost = float(sum(np.sum(r**2) for r in residuals))
    return _Normal(
        matrix, sides, (residuals[0], residuals[1]), cost if np.isfinite(cost) else np.inf
    )


def _predict(
    points: Array, seen: Sightings, state: RigState, side: int, free: Array
) -> tuple[Array, Array, Array]:
    """Predict the pixels (m, 2) of one camera, and their derivatives.

    They are by the common unknowns (m, 2, c) and by the view's board (m, 2, 6).
    """
    k = free.shape[1]
    moves = state.left_from_boards[seen.view]
    turned = np.einsum("mij,mj->mi", moves[:, :3, :3], points[seen.point])
    places = turned + moves[:, :3, 3]
    place_by_board = np.concatenate(
        [np.broadcast_to(np.eye(3), (len(places), 3, 3)), -skew(turned)], axis=2
    )
    if side == 1:
        rotation = state.right_from_left[:3, :3]
        turned = places @ rotation.T
        places = apply(state.right_from_left, places)
        place_by_board = rotation @ place_by_board
    ahead = places[:, 2] > 1e-6
    pixels, by_intrinsics, by_place = project(
        state.intrinsics[side], np.where(ahead[:, None], places, [0.0, 0.0, 1.0])
    )
    # A step that puts a board behind a camera must not count as an improvement.
    pixels[~ahead] = np.inf
    by_common = np.zeros((len(places), 2, 2 * k + POSE))
    by_common[:, :, side * k : (side + 1) * k] = by_intrinsics @ free
    if side == 1:
        by_common[:, :, 2 * k : 2 * k + 3] = by_place
        by_common[:, :, 2 * k + 3 :] = by_place @ -skew(turned)
    return pixels, by_common, by_place @ place_by_board
