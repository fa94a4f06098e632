"""One least-squares adjustment of both cameras, their relative pose and all board poses.

The observations are all measured pixels. Nine intrinsics describe a camera: the focal lengths fx
and fy and the principal point cx, cy in px, then the distortion coefficients k1, k2, p1, p2, k3 of
Brown and Conrady in OpenCV's order. Intrinsics that are not free stay at their initial values.

Levenberg and Marquardt's method solves the normal equations. A board pose affects only the
residuals of its own view. The poses are therefore eliminated view by view (Schur complement), and
the reduced normal matrix N of the free intrinsics and of right_from_left remains. All pixels have
equal weight, and their variance sigma² is estimated from the residuals. The covariance for
independent errors is sigma² N^-1. The stated covariance is larger if the points of a view have
common errors.
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
from cmmsim.geometry.pose import Array, apply, point_jacobian, rotation_exp, skew

# Free distortion terms of each model of distortion, by its name.
DISTORTIONS = {"none": (), "radial2": ("k1", "k2"), "brown5": ("k1", "k2", "p1", "p2", "k3")}
DEFAULT_DISTORTION = "brown5"
# Number of steps after which the adjustment fails.
MOST_STEPS = 60
# The iteration ends when a step decreases the sum of squares by less than this fraction.
SMALLEST_GAIN = 1e-11
# The adjustment fails if N, scaled to a unit diagonal, has an eigenvalue that is not above this.
SINGULAR = 1e-14
POSE = 6  # number of unknowns of a pose
# Slices of the unknowns of a view. The pose of the view's board follows the common unknowns.
COMMON = slice(None, -POSE)
BOARD = slice(-POSE, None)


def free_directions(distortion: str, fix_aspect: bool) -> Array:
    """Return the matrix (9, k) that maps the k free intrinsics of a camera to all nine.

    ``distortion`` is the key of DISTORTIONS that names the free distortion terms. With
    ``fix_aspect``, fx and fy change by the same amount. Raises UnknownOptionError for an unknown
    key.
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
    """Return OpenCV's camera matrix (3, 3) for the intrinsics (9,) of a camera."""
    return np.array([[values[0], 0.0, values[2]], [0.0, values[1], values[3]], [0.0, 0.0, 1.0]])


def computed_pixels(values: Array, points: Array) -> tuple[Array, Array, Array]:
    """Return the pixels (n, 2) of points (n, 3) in camera axes, and the pixels' derivatives.

    The derivatives are with respect to the intrinsics (n, 2, 9) and to the points (n, 2, 3), px/m.
    The points must lie in front of the camera.
    """
    pixels, jacobian = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), camera_matrix(values), values[4:]
    )
    # OpenCV's columns are 3 for the rotation, 3 for the translation, 2 for the focal lengths, 2 for
    # the principal point, and 5 for the distortion.
    by_all = np.asarray(jacobian, dtype=float).reshape(len(points), 2, -1)
    return np.asarray(pixels, dtype=float).reshape(-1, 2), by_all[:, :, 6:15], by_all[:, :, 3:6]


@dataclass(frozen=True)
class RigState:
    """State of the rig and of the board poses in v views.

    ``intrinsics`` is (2, 9), ``right_from_left`` (4, 4), and ``left_from_boards`` (v, 4, 4).
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
        """Return the state after changes of the intrinsics, the relative pose and the boards.

        ``intrinsics`` (2, 9) is added. ``right`` (6,) and ``boards`` (v, 6) are small changes
        [dt, dphi] of right_from_left and of the board poses.
        """
        return RigState(
            self.intrinsics + intrinsics,
            _moved(self.right_from_left, right),
            np.stack(
                [_moved(b, change) for b, change in zip(self.left_from_boards, boards, strict=True)]
            ),
        )


def _moved(transform: Array, change: Array) -> Array:
    """Return a transform (4, 4) after a small change [dt, dphi] (6,).

    dt is added to the translation, m. The rotation by dphi, rad, multiplies from the left.
    """
    moved = transform.copy()
    moved[:3, 3] += change[:3]
    moved[:3, :3] = rotation_exp(change[3:]) @ transform[:3, :3]
    return moved


@dataclass(frozen=True)
class Adjustment:
    """Result of an adjustment.

    state                   adjusted rig and board poses
    residuals               (m, 2) for each camera, measured minus computed pixels, px
    sigma_px                estimated standard deviation of a pixel coordinate
    covariance              (24, 24), of the 9 left intrinsics, the 9 right intrinsics and the small
                            error [dt, dphi] of right_from_left
    independent_covariance  what ``covariance`` would be if all points had independent errors
    condition               condition number of N scaled to a unit diagonal
    steps                   number of iterations
    freedom                 degrees of freedom: number of observations minus number of unknowns
    shared                  common errors of the points of a view
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
    """Normal equations of each view.

    ``matrix`` (v, s, s) and the right-hand side ``rhs`` (v, s) have s = c + 6 unknowns: first the c
    common ones, then the pose of the view's board. ``residuals`` are those of each camera (m, 2),
    px. ``cost`` is the sum of the squared residuals of both cameras, px², or inf if a point lies
    behind a camera.
    """

    matrix: Array
    rhs: Array
    residuals: tuple[Array, Array]
    cost: float

    def blocks(self, damping: float = 0.0) -> tuple[Array, Array, Array]:
        """Return the blocks of the matrix with its diagonal multiplied by 1 + ``damping``.

        The blocks are those of the common unknowns (v, c, c), the mixed ones (v, c, 6), and those
        of the boards (v, 6, 6).
        """
        damped = self.matrix + damping * self.matrix * np.eye(self.matrix.shape[1])
        return damped[:, COMMON, COMMON], damped[:, COMMON, BOARD], damped[:, BOARD, BOARD]

    def reduced(self, damping: float = 0.0) -> tuple[Array, Array]:
        """Return each view's contribution to the reduced normal equations.

        These are the matrices (v, c, c) and the right-hand sides (v, c).
        """
        common, mixed, boards = self.blocks(damping)
        eliminated = np.linalg.solve(boards, mixed.swapaxes(1, 2)).swapaxes(1, 2)
        matrix = np.asarray(common - eliminated @ mixed.swapaxes(1, 2), dtype=np.float64)
        return matrix, self.rhs[:, COMMON] - np.einsum("vci,vi->vc", eliminated, self.rhs[:, BOARD])

    def step(self, damping: float) -> tuple[Array, Array]:
        """Return the damped changes of the common unknowns (c,) and of the boards (v, 6)."""
        matrix, rhs = (part.sum(axis=0) for part in self.reduced(damping))
        # focal lengths and distortion terms differ by ten orders of magnitude; scaling to a unit
        # diagonal avoids a loss of digits
        scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        common = (
            scale * np.linalg.lstsq(matrix * scale[:, None] * scale, scale * rhs, rcond=1e-15)[0]
        )
        _, mixed, boards = self.blocks(damping)
        board_rhs = self.rhs[:, BOARD] - np.einsum("vci,c->vi", mixed, common)
        return common, np.linalg.solve(boards, board_rhs[..., None])[..., 0]


def adjust(
    points: Array, sightings: tuple[Sightings, Sightings], start: RigState, free: Array
) -> Adjustment:
    """Adjust the rig and the board poses to sightings of the board's points (n, 3), m.

    At least one camera must have sightings in each view. ``free`` (9, k) is the result of
    ``free_directions``. Raises CalibrationError if there are not more observations than unknowns,
    if the iteration does not converge, or if the views do not determine the cameras.
    """

    def build(state: RigState) -> _Normal:
        return _normal_equations(points, sightings, state, free)

    state, steps = _minimise(build, start, free)
    normal = build(state)
    common = normal.rhs.shape[1] - POSE
    observations = sum(2 * len(s.view) for s in sightings)
    unknowns = common + POSE * len(state.left_from_boards)
    freedom = observations - unknowns
    if freedom < 1:
        raise CalibrationError(
            f"too few points: their {observations} pixel coordinates must be more than the "
            f"{unknowns} unknowns"
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
    to_all = block_diag(free, free, np.eye(POSE))  # (24, c) maps the common unknowns to all 24
    return Adjustment(
        state,
        normal.residuals,
        float(np.sqrt(sigma2)),
        to_all @ shared.covariance @ to_all.T,
        to_all @ shared.independent @ to_all.T,
        float(eigenvalues[-1] / eigenvalues[0]),
        steps,
        freedom,
        shared,
    )


def _minimise(
    build: Callable[[RigState], _Normal], state: RigState, free: Array
) -> tuple[RigState, int]:
    """Return the state of least cost by Levenberg and Marquardt's method, and the number of steps.

    Raises CalibrationError after MOST_STEPS steps.
    """
    damping = 1e-4
    normal = build(state)
    free_count = free.shape[1]
    for step in range(1, MOST_STEPS + 1):
        common, boards = normal.step(damping)
        trial = state.moved(
            common[: 2 * free_count].reshape(2, free_count) @ free.T,
            common[2 * free_count :],
            boards,
        )
        attempt = build(trial)
        if attempt.cost < normal.cost:
            gain = (normal.cost - attempt.cost) / normal.cost
            state = trial
            normal = attempt
            damping = max(0.1 * damping, 1e-12)
            if gain < SMALLEST_GAIN:
                return state, step
        elif damping > 1e6 or abs(common @ normal.rhs[:, COMMON].sum(axis=0)) <= 1e-8 * normal.cost:
            # Either not even a tiny step decreases the cost, because the residuals are rounding
            # errors of points without noise, or the linear model predicts almost no decrease, so
            # that the increase is a rounding error.
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
    """Return the normal equations of all views at a state. See ``adjust`` for the arguments."""
    common = 2 * free.shape[1] + POSE
    views = len(state.left_from_boards)
    residuals = []
    matrix = np.zeros((views, common + POSE, common + POSE))
    rhs = np.zeros((views, common + POSE))
    for side, seen in enumerate(sightings):
        computed, by_common, by_board = _predict(points, seen, state, side, free)
        error = seen.pixels - computed
        residuals.append(error)
        # Sightings are sorted by view, so that each view is a slice.
        edges = np.searchsorted(seen.view, np.arange(views + 1))
        for v, (first, last) in enumerate(pairwise(edges)):
            common_part = by_common[first:last].reshape(-1, common)
            error_part = error[first:last].ravel()
            board_part = by_board[first:last].reshape(-1, POSE)
            matrix[v, COMMON, COMMON] += common_part.T @ common_part
            matrix[v, COMMON, BOARD] += common_part.T @ board_part
            matrix[v, BOARD, BOARD] += board_part.T @ board_part
            rhs[v, COMMON] += common_part.T @ error_part
            rhs[v, BOARD] += board_part.T @ error_part
    cost = float(sum(np.sum(r**2) for r in residuals))
    return _Normal(matrix, rhs, (residuals[0], residuals[1]), cost if np.isfinite(cost) else np.inf)


def _predict(
    points: Array, seen: Sightings, state: RigState, side: int, free: Array
) -> tuple[Array, Array, Array]:
    """Return the predicted pixels (m, 2) of one camera, and the derivatives of the pixels.

    The derivatives are with respect to the common unknowns (m, 2, c) and to the pose of the view's
    board (m, 2, 6).
    """
    free_count = free.shape[1]
    left_from_board = state.left_from_boards[seen.view]
    turned = np.einsum("mij,mj->mi", left_from_board[:, :3, :3], points[seen.point])
    camera_points = turned + left_from_board[:, :3, 3]
    point_by_board = point_jacobian(turned)
    if side == 1:
        rotation = state.right_from_left[:3, :3]
        turned = camera_points @ rotation.T
        camera_points = apply(state.right_from_left, camera_points)
        point_by_board = rotation @ point_by_board
    ahead = camera_points[:, 2] > 1e-6
    pixels, by_intrinsics, by_point = computed_pixels(
        state.intrinsics[side], np.where(ahead[:, None], camera_points, [0.0, 0.0, 1.0])
    )
    # A step that puts a board behind a camera must not count as an improvement.
    pixels[~ahead] = np.inf
    by_common = np.zeros((len(camera_points), 2, 2 * free_count + POSE))
    by_common[:, :, side * free_count : (side + 1) * free_count] = by_intrinsics @ free
    if side == 1:
        by_common[:, :, 2 * free_count : 2 * free_count + 3] = by_point
        by_common[:, :, 2 * free_count + 3 :] = by_point @ -skew(turned)
    return pixels, by_common, by_point @ point_by_board
