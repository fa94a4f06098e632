"""Distances between points of a board, measured with cameras that other pictures have calibrated.

They are compared with the distances of the board file. Three errors are stated for each distance:
that of the known rig, that of the images' noise, and that of the board, such as of its print. An
error of the board moves a point in both images alike. It therefore causes residuals of the
calibration, but no gap between the point's two rays. Thus the ray gaps give the noise of the
images, and the rest of the residuals gives the error of the board.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cmmsim.calibration.board import Board
from cmmsim.calibration.board_detection import BoardView
from cmmsim.calibration.calibrated_rig import Calibration
from cmmsim.calibration.sightings import SIDES, PairView
from cmmsim.geometry.disc_image import centre_offset
from cmmsim.geometry.pose import Array, apply
from cmmsim.geometry.registration import register
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.geometry.triangulation import StereoPoints, triangulate

# Number of rounds in which the eccentricities of dots are corrected.
ROUNDS = 3


class MeasuredBoard(NamedTuple):
    """Points of a board in one pair of pictures.

    ``numbers`` (n,) are the numbers of the points. ``points`` are their places, with covariances
    for pixels of variance 1 px². ``pixel`` is the size of a pixel at the board's distance, m.
    """

    numbers: NDArray[np.int_]
    points: StereoPoints
    pixel: float


@dataclass(frozen=True)
class Distances:
    """Measured distances between points of a board, n in all pairs of pictures together.

    errors    (n,), measured minus stated distance, m
    variances (n,), stated variances of the errors, m²
    noise_px  standard deviation of a point's pixel coordinates by the noise of images
    board_m   standard deviation of a point's place on the board in each axis
    """

    errors: Array
    variances: Array
    noise_px: float
    board_m: float

    @property
    def rms_m(self) -> float:
        """Root mean square error, m."""
        return float(np.sqrt(np.mean(self.errors**2)))

    @property
    def normalised_error(self) -> float:
        """Root mean square of errors divided by their standard deviations; 1 if these are right."""
        return float(np.sqrt(np.mean(self.errors**2 / self.variances)))


def measured_distances(
    calibration: Calibration, own: Sequence[PairView], other: Sequence[PairView]
) -> Distances:
    """Measure distances in ``other`` pairs of pictures with the cameras of a calibration.

    ``own`` are the pairs from which the cameras were calibrated. All pairs must show the board to
    both cameras.
    """
    board = calibration.board
    rig = calibration.known.rig
    gaps = [_measured(board, rig, pair).points.ray_gap for pair in own]
    variance = calibration.adjustment.sigma_px**2
    noise = min(float(np.mean(np.concatenate(gaps))), variance)
    seen = [_measured(board, rig, pair) for pair in other]
    pixel = float(np.mean([one.pixel for one in seen]))
    of_board = (variance - noise) * pixel**2
    parts = [
        _errors(board, rig, one, noise, of_board, calibration.known.covariance) for one in seen
    ]
    errors, variances = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Distances(errors, variances, float(np.sqrt(noise)), float(np.sqrt(of_board)))


def _measured(board: Board, rig: StereoRig, pair: PairView) -> MeasuredBoard:
    """Return the points that both images show, numbered such that their rays meet best."""
    left, right = pair.sides
    assert isinstance(left, BoardView)
    assert isinstance(right, BoardView)
    tried = [_common(left, right.read_as(order)) for order in board.symmetries]
    index, pixels = min(tried, key=lambda one: _epipolar_gap(rig, one[1]))
    places = board.points[index]
    unit = np.tile(np.eye(2), (len(index), 1, 1))
    offsets = np.zeros_like(pixels)
    # The places of dots and the eccentricities of their images depend on each other.
    for _ in range(ROUNDS if board.dot_radius else 1):
        at = pixels - offsets
        points = triangulate(rig, at[0], at[1], unit, unit)
        place = register(places, points.points, points.covariances).transform
        for side in range(len(SIDES) if board.dot_radius else 0):
            move = rig.from_camera[side] @ place
            normals = np.tile(-move[:3, 2], (len(index), 1))
            centres = apply(move, places)
            offsets[side] = centre_offset(rig.cameras[side], centres, normals, board.dot_radius)
    depth = float(np.linalg.norm(points.points.mean(axis=0)))
    return MeasuredBoard(index, points, depth / rig.left.focal_px)


def _common(left: BoardView, right: BoardView) -> tuple[NDArray[np.int_], Array]:
    """Return the numbers (n,) of the points that both views show, and their pixels (2, n, 2)."""
    index, in_left, in_right = np.intersect1d(left.index, right.index, return_indices=True)
    return index, np.stack([left.pixels[in_left], right.pixels[in_right]])


def _epipolar_gap(rig: StereoRig, pixels: Array) -> float:
    """Return the median of |right' F left| of points at pixels (2, n, 2)."""
    left, right = (
        np.column_stack([camera.undistort(own)[0], np.ones(len(own))])
        for camera, own in zip(rig.cameras, pixels, strict=True)
    )
    return float(np.median(np.abs(np.einsum("ni,ij,nj->n", right, rig.fundamental, left))))


def _errors(
    board: Board,
    rig: StereoRig,
    measured: MeasuredBoard,
    noise: float,
    of_board: float,
    covariance: Array,
) -> tuple[Array, Array]:
    """Return the errors of all distances in one pair of pictures, and their variances.

    ``noise`` is the variance of pixels, px², ``of_board`` that of points of the board, m², and
    ``covariance`` (24, 24) that of the rig.
    """
    first, second = np.triu_indices(len(measured.numbers), 1)
    stated = board.points[measured.numbers]
    stated = np.linalg.norm(stated[first] - stated[second], axis=1)
    points = measured.points.points
    gaps = points[first] - points[second]
    found = np.linalg.norm(gaps, axis=1)
    along = gaps / found[:, None]
    by_points, by_rig = (np.concatenate(part, axis=1) for part in rig.derivatives(points))
    # Errors of the rig move the triangulated point such that its pixels change least.
    moved = -np.linalg.pinv(by_points) @ by_rig
    by_rig = np.einsum("ni,nik->nk", along, moved[first] - moved[second])
    spread = noise * measured.points.covariances
    variances = (
        np.einsum("ni,nij,nj->n", along, spread[first] + spread[second], along)
        + np.einsum("nk,kl,nl->n", by_rig, covariance, by_rig)
        + 2.0 * of_board
    )
    return found - stated, variances
