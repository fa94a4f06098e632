"""One least-squares adjustment of sticker positions, platform poses and cameras to all photographs.

The observations are the centres of stickers in both images of all pairs, with their covariances.
The unknowns are the positions of the base's stickers, the positions of the platform's stickers at
a reference pair, and the motion of the platform from the reference pair to each pair, all in the
camera frame. If the rig is known with a covariance, its 24 parameters are unknowns, too, and their
known values are additional observations.

A pose affects only the observations of its own pair. Gauss-Newton steps therefore eliminate the
poses pair by pair (Schur complement). A common movement of all platform stickers can be undone by
the poses, and then changes no observation. An inner constraint fixes this movement without an
effect on the shape of the platform.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmmsim.errors import LostError
from cmmsim.geometry.disc_image import centre_offset, sticker_outlines
from cmmsim.geometry.pose import Array, point_jacobian, rotation_exp
from cmmsim.geometry.stereo_rig import PARAMETER_NAMES, StereoRig

# The adjustment fails after this many steps. Three are usual.
MOST_STEPS = 12
# The adjustment ends when a step changes all coordinates of stickers by less than this, m.
CONVERGED = 1e-9
POSE = 6  # number of unknowns of a pose
RIG = len(PARAMETER_NAMES)  # number of parameters of a rig


@dataclass(frozen=True)
class Observations:
    """All m observations of stickers, each in both images of a pair.

    pair         (m,), index of the pair
    sticker      (m,), index of the sticker; those of the base precede those of the platform
    pixels       (2, m, 2), centres of the ellipses
    covariances  (2, m, 2, 2), of the centres, px²
    shapes       (2, m, 2, 2), symmetric matrices of the ellipses, px
    base         number of stickers of the base
    normals      (n, 3), of all n stickers, in the axes of `BundleState.places`
    radius       radius of a sticker, m
    """

    pair: NDArray[np.int_]
    sticker: NDArray[np.int_]
    pixels: Array
    covariances: Array
    shapes: Array
    base: int
    normals: Array
    radius: float

    @property
    def moves(self) -> NDArray[np.bool_]:
        """Mask (m,) of the observations of the platform."""
        return np.asarray(self.sticker >= self.base)

    def selected(self, keep: NDArray[np.bool_]) -> Observations:
        """Return the observations in the mask ``keep`` (m,)."""
        return replace(
            self,
            pair=self.pair[keep],
            sticker=self.sticker[keep],
            pixels=self.pixels[:, keep],
            covariances=self.covariances[:, keep],
            shapes=self.shapes[:, keep],
        )


@dataclass(frozen=True)
class BundleState:
    """Values of the unknowns.

    They are the positions ``places`` (n, 3) of all stickers in the camera frame, m, the ``poses``
    (K, 4, 4), and the ``rig``. The positions of platform stickers are those at the reference pair.
    A pose moves the platform from there to its position and orientation in a pair. The parameters
    of the rig differ from those of the known rig by ``rig_change`` (24,).
    """

    places: Array
    poses: Array
    rig: StereoRig
    rig_change: Array

    def points(self, seen: Observations) -> Array:
        """Return the points (m, 3) of the observed stickers in the camera frame."""
        return self._placed(seen, self.places) + np.where(
            seen.moves[:, None], self.poses[seen.pair, :3, 3], 0.0
        )

    def _placed(self, seen: Observations, vectors: Array) -> Array:
        """Return, for each observation, the vector of its sticker in camera axes, as (m, 3)."""
        own = vectors[seen.sticker]
        turned = np.einsum("mij,mj->mi", self.poses[seen.pair, :3, :3], own)
        return np.where(seen.moves[:, None], turned, own)

    def residuals(self, seen: Observations) -> Array:
        """Return measured minus computed centres (2, m, 2), px."""
        points = self.points(seen)
        normals = self._placed(seen, seen.normals)
        computed = self.rig.project(points)[0]
        for side, (camera, move) in enumerate(
            zip(self.rig.cameras, self.rig.from_camera, strict=True)
        ):
            in_camera = points @ move[:3, :3].T + move[:3, 3]
            computed[side] += centre_offset(
                camera, in_camera, normals @ move[:3, :3].T, seen.radius
            )
        return np.asarray(seen.pixels - computed)

    def radius(self, seen: Observations) -> float:
        """Return the radius of the stickers, m, from the median area of all observed ellipses."""
        poses = np.where(seen.moves[:, None, None], self.poses[seen.pair], np.eye(4))
        places, normals = self.places[seen.sticker], seen.normals[seen.sticker]
        shapes = sticker_outlines(self.rig, poses, places, normals, seen.radius)[1]
        areas = np.linalg.det(seen.shapes) / np.linalg.det(shapes)
        return seen.radius * float(np.sqrt(np.median(areas)))

    def moved(self, known: StereoRig, places: Array, poses: Array, rig: Array) -> BundleState:
        """Return the state after changes of places (n, 3), poses (K, 6) and rig (24,).

        The changes of poses are [dt, dphi]. ``known`` is the known rig.
        """
        moved = self.poses.copy()
        moved[:, :3, 3] += poses[:, :3]
        moved[:, :3, :3] = (
            np.stack([rotation_exp(turn) for turn in poses[:, 3:]]) @ self.poses[:, :3, :3]
        )
        change = self.rig_change + rig
        return BundleState(self.places + places, moved, known.moved(change), change)


@dataclass(frozen=True)
class Bundle:
    """Result of an adjustment.

    state        adjusted values
    covariance   (3 n + 24, 3 n + 24), of the places and the rig's parameters, with unknown poses
    residuals    (2, m, 2), measured minus computed centres, px
    squares      (m,), sum of the squared whitened residuals in both images
    factor       sum of ``squares`` per degree of freedom
    freedom      degrees of freedom: number of coordinates minus number of determined unknowns
    """

    state: BundleState
    covariance: Array
    residuals: Array
    squares: Array
    factor: float
    freedom: int


def adjust(seen: Observations, start: BundleState, known: StereoRig, prior: Array) -> Bundle:
    """Adjust a state to the observations.

    ``known`` is the rig as calibrated, and ``prior`` (24, 24) the covariance of its parameters.
    Parameters with zero variance do not change. The covariance of the result assumes the stated
    noise. The ``factor`` of the result is well above 1 if the residuals are larger than this noise.
    Raises LostError if the steps do not converge.
    """
    state = start
    free = np.flatnonzero(np.diag(prior) > 0.0)
    information: Array = np.asarray(np.linalg.inv(prior[np.ix_(free, free)]), dtype=float)
    for _ in range(MOST_STEPS):
        places, poses, rig, covariance = _step(seen, state, information, free)
        if np.abs(places).max() < CONVERGED:
            break
        state = state.moved(known, places, poses, rig)
    else:
        raise LostError(
            f"the adjustment of the photographs has not converged in {MOST_STEPS} steps: the last "
            f"one moves a sticker by {1e3 * np.abs(places).max():.2g} mm"
        )
    residuals = state.residuals(seen)
    squares = np.einsum(
        "smi,smij,smj->m", residuals, np.linalg.inv(seen.covariances), residuals, optimize=True
    )
    # The common movement of the platform's stickers is not determined.
    unknowns = 3 * len(np.unique(seen.sticker)) + POSE * (len(np.unique(seen.pair[seen.moves])) - 1)
    freedom = 4 * len(squares) - unknowns
    factor = float(squares.sum() / max(freedom, 1))
    return Bundle(state, covariance, residuals, squares, factor, freedom)


def _step(
    seen: Observations, state: BundleState, information: Array, free: NDArray[np.int_]
) -> tuple[Array, Array, Array, Array]:
    """Return the changes of places (n, 3), poses (K, 6) and rig (24,), and the covariance.

    ``information`` (f, f) is that of the ``free`` (f,) parameters of the rig. The covariance of
    places and rig (3 n + 24, 3 n + 24) has zeros for parameters that are not free.
    """
    rows = _rows(seen, state, free)
    count = 3 * len(state.places)
    matrix = np.zeros((count + len(free),) * 2)
    rhs = np.zeros(len(matrix))
    matrix[count:, count:] = information
    rhs[count:] = -information @ state.rig_change[free]
    poses = []
    for by_common, by_pose, residuals in rows:
        matrix += by_common.T @ by_common
        rhs += by_common.T @ residuals
        if not by_pose.any():
            poses.append((np.zeros((POSE, len(matrix))), np.zeros(POSE)))
            continue
        pose_covariance = np.linalg.inv(by_pose.T @ by_pose)
        mixed = pose_covariance @ (by_pose.T @ by_common)
        alone = pose_covariance @ (by_pose.T @ residuals)
        matrix -= by_common.T @ by_pose @ mixed
        rhs -= by_common.T @ by_pose @ alone
        poses.append((mixed, alone))
    # An unseen sticker has no observations. A unit diagonal keeps the matrix invertible.
    empty = np.diag(matrix) == 0.0
    matrix[empty, empty] = 1.0
    gauge = _gauge(seen, state, len(matrix))
    matrix += np.diag(matrix)[:count].mean() * gauge @ gauge.T
    # Parameters differ by many orders of magnitude. A unit diagonal avoids a loss of digits.
    scale = 1.0 / np.sqrt(np.diag(matrix))
    scaled = np.linalg.inv(scale[:, None] * matrix * scale)
    covariance = scale[:, None] * (0.5 * (scaled + scaled.T)) * scale
    change = covariance @ rhs
    pose_changes = np.array([alone - mixed @ change for mixed, alone in poses])
    rig = np.zeros(RIG)
    rig[free] = change[count:]
    kept = np.concatenate([np.arange(count), count + free])
    full = np.zeros((count + RIG,) * 2)
    full[np.ix_(kept, kept)] = covariance
    return change[:count].reshape(-1, 3), pose_changes, rig, full


def _rows(
    seen: Observations, state: BundleState, free: NDArray[np.int_]
) -> list[tuple[Array, Array, Array]]:
    """Return, for each pair, the whitened derivatives and residuals of its r coordinates.

    The derivatives are with respect to places and rig (r, 3 n + f), and to the pose of the pair
    (r, 6).
    """
    points = state.points(seen)
    by_points, by_rig = state.rig.derivatives(points)
    whiten = np.linalg.inv(np.linalg.cholesky(seen.covariances))
    moves = seen.moves[:, None, None]
    turns = np.where(moves, state.poses[seen.pair, :3, :3], np.eye(3))
    arms = points - state.poses[seen.pair, :3, 3]
    by_places = whiten @ by_points @ turns
    by_poses = whiten @ by_points @ np.where(moves, point_jacobian(arms), 0.0)
    by_rig = whiten @ by_rig[..., free]
    residuals = (whiten @ state.residuals(seen)[..., None])[..., 0]
    count = 3 * len(state.places)
    rows = []
    for pair in range(len(state.poses)):
        own = np.flatnonzero(seen.pair == pair)
        common = np.zeros((2, len(own), 2, count + len(free)))
        for k, column in enumerate(3 * seen.sticker[own]):
            common[:, k, :, column : column + 3] = by_places[:, own[k]]
        common[..., count:] = by_rig[:, own]
        rows.append(
            (
                common.reshape(-1, count + len(free)),
                by_poses[:, own].reshape(-1, POSE),
                residuals[:, own].ravel(),
            )
        )
    return rows


def _gauge(seen: Observations, state: BundleState, size: int) -> Array:
    """Return six orthonormal columns (size, 6) that span the common movements of the platform."""
    places = state.places[seen.base :]
    movements = point_jacobian(places - places.mean(axis=0)).reshape(-1, POSE)
    gauge = np.zeros((size, POSE))
    gauge[3 * seen.base : 3 * len(state.places)] = np.linalg.qr(movements)[0]
    return gauge
