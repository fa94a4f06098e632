"""Comparison of two halves of the pictures, each calibrated for itself.

It is the only proof of a stated covariance that needs no truth.
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
    """Squared differences of the halves' calibrations, for n splits.

    ``squares`` (n, p) belong to p independent directions of the free parameters. Each is divided by
    the variance that both halves state, so that 1 is expected.
    """

    squares: np.ndarray

    @property
    def mean_square(self) -> float:
        """Mean over splits and directions; well above 1 where the stated covariance is too
        small.
        """
        return float(self.squares.mean())

    @property
    def chance(self) -> float:
        """Standard deviation of the mean of one split if the covariance is right.

        Splits of the same pictures are not independent, so that many of them help less than their
        number says.
        """
        return float(np.sqrt(2.0 / self.squares.shape[1]))

    @property
    def verdict(self) -> str:
        """Statement on the covariance, which holds beyond two standard deviations of a single
        split.
        """
        if abs(self.mean_square - 1.0) <= 2.0 * self.chance:
            return "they agree as they state"
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
    """Split pairs of pictures at random into two halves, repeatedly, and compare the calibrations.

    Raises CalibrationError where halves are too few pictures, or do not determine the cameras.
    """
    half = len(pairs) // 2
    least = max(options.min_images, FEWEST_PAIRS)
    if half < least:
        raise CalibrationError(
            f"halves of {len(pairs)} pairs of pictures are fewer than {least} each"
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
    """Return squared differences (p,) of two rigs along independent directions.

    They are divided by the sum of both variances.
    """
    covariance = one.covariance + other.covariance
    free = np.flatnonzero(np.diag(covariance) > 0.0)
    std = np.sqrt(np.diag(covariance)[free])
    apart = (one.rig.parameters - other.rig.parameters)[free] / std
    values, vectors = np.linalg.eigh(covariance[np.ix_(free, free)] / np.outer(std, std))
    # fx = fy, where asked for, leaves directions without variance; both halves agree in them
    kept = values > len(PARAMETER_NAMES) * np.finfo(float).eps * values[-1]
    return np.asarray((vectors.T @ apart)[kept] ** 2 / values[kept])
