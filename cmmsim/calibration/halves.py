"""Comparison of two calibrations, each from one half of the pictures.

It checks the stated covariance, and does not need the true cameras.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from cmmsim.calibration.board import Board
from cmmsim.calibration.calibrate import FEWEST_PAIRS, CalibrationOptions, calibrate
from cmmsim.calibration.sightings import PairView
from cmmsim.errors import CalibrationError
from cmmsim.geometry.stereo_rig import PARAMETER_NAMES
from cmmsim.uncertainty.known_rig import KnownRig


@dataclass(frozen=True)
class Halves:
    """Squared differences between the calibrations of both halves, for n splits.

    ``squares`` (n, p) belong to p independent directions of the free parameters. Each is divided by
    the sum of the variances that both calibrations state, so its expected value is 1.
    """

    squares: np.ndarray

    @property
    def mean_square(self) -> float:
        """Mean over splits and directions; well above 1 if the stated covariance is too small."""
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

    def to_dict(self) -> dict[str, float | int | str]:
        """Return the figures for JSON."""
        return {
            "splits": len(self.squares),
            "mean_square": self.mean_square,
            "chance_of_one": self.chance,
            "verdict": self.verdict,
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
    for _ in range(splits):
        order = rng.permutation(len(pairs))
        chosen = (sorted(order[:half]), sorted(order[half:]))
        known = []
        for part in chosen:
            known.append(calibrate(board, [pairs[k] for k in part], size, options).known)
            advance()
        squares.append(squared_differences(*known))
    return Halves(np.array(squares))


def squared_differences(one: KnownRig, other: KnownRig) -> np.ndarray:
    """Return the squared differences (p,) of two rigs along independent directions.

    Each is divided by the sum of both variances.
    """
    covariance = one.covariance + other.covariance
    free = np.flatnonzero(np.diag(covariance) > 0.0)
    std = np.sqrt(np.diag(covariance)[free])
    difference = (one.rig.parameters - other.rig.parameters)[free] / std
    values, vectors = np.linalg.eigh(covariance[np.ix_(free, free)] / np.outer(std, std))
    # the constraint fx = fy leaves directions without variance, in which both halves agree
    kept = values > len(PARAMETER_NAMES) * np.finfo(float).eps * values[-1]
    return np.asarray((vectors.T @ difference)[kept] ** 2 / values[kept])
