"""Comparison of two calibrations, each from one half of the pictures.

The comparison checks the stated covariance without the true cameras. With the cameras of each half,
distances between points of the board are also measured in the pictures of the other half, and
compared with the distances of the board file. The stated variance of a distance has three
contributions: the uncertainty of the rig, the noise of the images, and the error of the board, such
as that of its print. An error of the board moves a point in both images alike. It therefore causes
residuals of the calibration, but no gap between the point's two rays. Thus the ray gaps give the
noise of the images, and the rest of the residuals gives the error of the board.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cmmsim.calibration.board import Board
from cmmsim.calibration.board_detection import BoardView
from cmmsim.calibration.calibrate import FEWEST_PAIRS, CalibrationOptions, calibrate
from cmmsim.calibration.calibrated_rig import Calibration
from cmmsim.calibration.sightings import SIDES, PairView
from cmmsim.errors import CalibrationError
from cmmsim.geometry.disc_image import centre_offset
from cmmsim.geometry.pose import Array, apply
from cmmsim.geometry.registration import register
from cmmsim.geometry.stereo_rig import PARAMETER_NAMES, StereoRig
from cmmsim.geometry.triangulation import StereoPoints, triangulate
from cmmsim.uncertainty.known_rig import KnownRig

# Number of rounds in which the eccentricities of dots are corrected.
ROUNDS = 3


class MeasuredBoard(NamedTuple):
    """Points of a board in one pair of pictures.

    ``numbers`` (n,) are the indices of the points on the board. ``points`` are their measured
    positions, with covariances for pixels of variance 1 px². ``pixel`` is the size of a pixel at
    the board's distance, m.
    """

    numbers: NDArray[np.int_]
    points: StereoPoints
    pixel: float


@dataclass(frozen=True)
class Distances:
    """Measured distances between points of a board, n in all pairs of pictures together.

    errors    (n,), measured minus stated distance, m
    variances (n,), stated variances of the errors, m²
    noise_px  standard deviation of a point's pixel coordinates due to noise of the images
    board_m   standard deviation of a point's position on the board along each axis, m
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
        """Root mean square of errors divided by their stated deviations; ideally 1."""
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
    pixel = float(np.mean([view.pixel for view in seen]))
    of_board = (variance - noise) * pixel**2
    parts = [
        _errors(board, rig, view, noise, of_board, calibration.known.covariance) for view in seen
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
    board_points = board.points[index]
    unit = np.tile(np.eye(2), (len(index), 1, 1))
    offsets = np.zeros_like(pixels)
    # The positions of dots and the eccentricities of their images depend on each other.
    for _ in range(ROUNDS if board.dot_radius else 1):
        centre_pixels = pixels - offsets
        points = triangulate(rig, centre_pixels[0], centre_pixels[1], unit, unit)
        left_from_board = register(board_points, points.points, points.covariances).transform
        for side in range(len(SIDES) if board.dot_radius else 0):
            camera_from_board = rig.from_camera[side] @ left_from_board
            normals = np.tile(-camera_from_board[:3, 2], (len(index), 1))
            centres = apply(camera_from_board, board_points)
            offsets[side] = centre_offset(rig.cameras[side], centres, normals, board.dot_radius)
    depth = float(np.linalg.norm(points.points.mean(axis=0)))
    return MeasuredBoard(index, points, depth / rig.left.focal_px)


def _common(left: BoardView, right: BoardView) -> tuple[NDArray[np.int_], Array]:
    """Return the indices (n,) of the points that both views show, and their pixels (2, n, 2)."""
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
    differences = points[first] - points[second]
    lengths = np.linalg.norm(differences, axis=1)
    along = differences / lengths[:, None]
    by_points, by_rig = (np.concatenate(part, axis=1) for part in rig.derivatives(points))
    # Errors of the rig move the triangulated point such that its pixels change least.
    moved = -np.linalg.pinv(by_points) @ by_rig
    by_rig = np.einsum("ni,nik->nk", along, moved[first] - moved[second])
    covariances = noise * measured.points.covariances
    variances = (
        np.einsum("ni,nij,nj->n", along, covariances[first] + covariances[second], along)
        + np.einsum("nk,kl,nl->n", by_rig, covariance, by_rig)
        + 2.0 * of_board
    )
    return lengths - stated, variances


@dataclass(frozen=True)
class Halves:
    """Squared differences between the calibrations of both halves, for n splits.

    ``squares`` (n, p) belong to p independent directions of the free parameters. Each is divided by
    the sum of the variances that both calibrations state, so its expected value is 1.
    ``distances`` are measured in each half of each split with the cameras of the other half.
    """

    squares: np.ndarray
    distances: Sequence[Distances]

    @property
    def mean_square(self) -> float:
        """Mean of ``squares``; well above 1 if the stated covariance is too small."""
        return float(self.squares.mean())

    @property
    def chance(self) -> float:
        """Standard deviation of the mean square of one split if the covariance is right.

        The number of splits does not reduce it, because splits of the same pictures are not
        independent.
        """
        return float(np.sqrt(2.0 / self.squares.shape[1]))

    @property
    def verdict(self) -> str:
        """Statement on the covariance.

        The covariance is called wrong if the mean square differs from 1 by more than two standard
        deviations of a single split.
        """
        if abs(self.mean_square - 1.0) <= 2.0 * self.chance:
            return "the differences agree with the stated covariance"
        return f"the stated covariance is too {'small' if self.mean_square > 1.0 else 'large'}"

    @property
    def distance_figures(self) -> dict[str, float]:
        """Root mean square over ``distances`` of each value of `Distances`, by its name."""
        names = ("rms_m", "normalised_error", "noise_px", "board_m")
        values = np.array([[getattr(one, name) for name in names] for one in self.distances])
        return dict(zip(names, np.sqrt(np.mean(values**2, axis=0)).tolist(), strict=True))

    def to_dict(self) -> dict[str, Any]:
        """Return the results as a dictionary for JSON."""
        return {
            "splits": len(self.squares),
            "mean_square": self.mean_square,
            "chance_of_one": self.chance,
            "verdict": self.verdict,
            "distances": self.distance_figures,
        }


def compare_halves(
    board: Board,
    pairs: Sequence[PairView],
    size: tuple[int, int],
    options: CalibrationOptions,
    splits: int,
    rng: np.random.Generator,
    advance: Callable[[], None] = lambda: None,
) -> Halves:
    """Split pairs of pictures repeatedly at random into two halves, and compare the calibrations.

    ``advance`` is called after each calibration. Raises CalibrationError if a half has too few
    pairs or does not determine the cameras.
    """
    half = len(pairs) // 2
    least = max(options.min_images, FEWEST_PAIRS)
    if half < least:
        raise CalibrationError(
            f"each half of {len(pairs)} pairs of pictures has {half} pairs, fewer than {least}"
        )
    squares = []
    distances = []
    for _ in range(splits):
        order = rng.permutation(len(pairs))
        chosen = [[pairs[k] for k in sorted(part)] for part in (order[:half], order[half:])]
        calibrations = []
        for part in chosen:
            calibrations.append(calibrate(board, part, size, options))
            advance()
        squares.append(squared_differences(calibrations[0].known, calibrations[1].known))
        used = [_seen_by_both(one, part) for one, part in zip(calibrations, chosen, strict=True)]
        distances += [measured_distances(calibrations[k], used[k], used[1 - k]) for k in range(2)]
    return Halves(np.array(squares), distances)


def _seen_by_both(found: Calibration, pairs: Sequence[PairView]) -> list[PairView]:
    """Return the pairs of which a calibration used both images."""
    names = {view.name for view in found.used if len(view.rms_px) == len(SIDES)}
    return [pair for pair in pairs if pair.name in names]


def squared_differences(one: KnownRig, other: KnownRig) -> np.ndarray:
    """Return the squared differences (p,) of two rigs along p independent directions.

    Each is divided by the sum of both variances along its direction.
    """
    covariance = one.covariance + other.covariance
    free = np.flatnonzero(np.diag(covariance) > 0.0)
    std = np.sqrt(np.diag(covariance)[free])
    difference = (one.rig.parameters - other.rig.parameters)[free] / std
    values, vectors = np.linalg.eigh(covariance[np.ix_(free, free)] / np.outer(std, std))
    # the constraint fx = fy leaves directions without variance, in which both halves agree
    kept = values > len(PARAMETER_NAMES) * np.finfo(float).eps * values[-1]
    return np.asarray((vectors.T @ difference)[kept] ** 2 / values[kept])
