"""Comparison of two calibrations, each from one half of the pictures.

It checks the stated covariance, and does not need the true cameras. With the cameras of each half,
distances between points of the board are also measured in the pictures of the other half.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cmmsim.calibration.board import Board
from cmmsim.calibration.calibrate import FEWEST_PAIRS, CalibrationOptions, calibrate
from cmmsim.calibration.calibrated_rig import Calibration
from cmmsim.calibration.distances import Distances, measured_distances
from cmmsim.calibration.sightings import SIDES, PairView
from cmmsim.errors import CalibrationError
from cmmsim.geometry.stereo_rig import PARAMETER_NAMES
from cmmsim.uncertainty.known_rig import KnownRig


@dataclass(frozen=True)
class Halves:
    """Squared differences between the calibrations of both halves, for n splits.

    ``squares`` (n, p) belong to p independent directions of the free parameters. Each is divided by
    the sum of the variances that both calibrations state, so its expected value is 1.
    ``distances`` are measured in each half of each split with the cameras of the other half.
    """

    squares: np.ndarray
    distances: Sequence[Distances] = ()

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

    @property
    def distance_figures(self) -> dict[str, float]:
        """Root mean squares over all splits of the figures of `Distances`, by their names."""
        names = ("rms_m", "normalised_error", "noise_px", "board_m")
        values = np.array([[getattr(one, name) for name in names] for one in self.distances])
        return dict(zip(names, np.sqrt(np.mean(values**2, axis=0)).tolist(), strict=True))

    def to_dict(self) -> dict[str, Any]:
        """Return the figures for JSON."""
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
        found = []
        for part in chosen:
            found.append(calibrate(board, part, size, options))
            advance()
        squares.append(squared_differences(found[0].known, found[1].known))
        used = [_seen_by_both(one, part) for one, part in zip(found, chosen, strict=True)]
        distances += [measured_distances(found[k], used[k], used[1 - k]) for k in range(2)]
    return Halves(np.array(squares), distances)


def _seen_by_both(found: Calibration, pairs: Sequence[PairView]) -> list[PairView]:
    """Return the pairs of which a calibration used both images."""
    names = {view.name for view in found.used if len(view.rms_px) == len(SIDES)}
    return [pair for pair in pairs if pair.name in names]


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
