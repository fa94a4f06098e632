"""Observability indices: what makes some static poses better than others. Each is better where it
is smaller.

`determinant`: minus the logarithm of the determinant of the information, Borm and Menq's O1, the
D-optimal one (Int. J. Robot. Res. 10(1), 1991). `prediction`: what the calibrated robot misses
poses by, on average over candidates, the I-optimal one. `noise_amplification`: s_1 / s_r^2 of the
extreme singular values of the whitened columns, the inverse of Nahvi and Hollerbach's index (ICRA
1996), over the combinations that all candidates together can tell: of the others no choice changes
anything.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from identify.arrays import Array
from identify.geometry.calibration import OBSERVABLE

EXTREMES, PROMISING = 24, 16
"""Directions that are told least, and as many that are told most, among which candidates are judged
first; and how many of these are judged exactly."""
HARDLY = 10.0
"""Information about a direction of which its prior, one, is much."""


class ObservabilityIndex(ABC):
    """Of the information (u, u) of poses and of what is known before them, about unknowns in units
    of their prior.
    """

    @abstractmethod
    def value(self, information: Array) -> tuple[float, Array]:
        """The index, and minus its derivative by the information (u, u)."""

    @abstractmethod
    def best(self, columns: Array, information: Array) -> int:
        """Which of some poses, with whitened columns (N, m, u), improves the index of this
        information most.
        """


class Determinant(ObservabilityIndex):
    """O1."""

    def value(self, information: Array) -> tuple[float, Array]:
        covariance = np.asarray(np.linalg.inv(information))
        return float(np.linalg.slogdet(covariance)[1]), covariance

    def best(self, columns: Array, information: Array) -> int:
        _, inner = _spread(columns, information)
        return int(np.argmax(np.linalg.slogdet(inner)[1]))


@dataclass(frozen=True)
class Prediction(ObservabilityIndex):
    """weight (u, u): mean square error of the candidates' coordinates, each in units of its noise,
    by the unknowns.
    """

    weight: Array

    def value(self, information: Array) -> tuple[float, Array]:
        covariance = np.linalg.inv(information)
        cost = float(np.sum(self.weight * covariance))
        return float(np.log(cost)), np.asarray(covariance @ self.weight @ covariance / cost)

    def best(self, columns: Array, information: Array) -> int:
        spread, inner = _spread(columns, information)
        return int(
            np.argmax(np.einsum("nmu,nmu->n", np.linalg.solve(inner, spread), spread @ self.weight))
        )


@dataclass(frozen=True)
class NoiseAmplification(ObservabilityIndex):
    """told (u, r): orthonormal directions of the unknowns that the candidates can tell."""

    told: Array

    @classmethod
    def among(cls, information: Array) -> "NoiseAmplification":
        """From the information (u, u) of all candidates."""
        values, vectors = np.linalg.eigh(information)
        return cls(vectors[:, values > OBSERVABLE**-2])

    def value(self, information: Array) -> tuple[float, Array]:
        values, vectors = np.linalg.eigh(self.told.T @ information @ self.told)
        first, last = ((self.told @ vectors[:, place])[:, None] for place in (-1, 0))
        index = 0.5 * np.log(values[-1]) - np.log(values[0])
        return float(index), np.asarray(
            last @ last.T / values[0] - 0.5 * first @ first.T / values[-1]
        )

    def best(self, columns: Array, information: Array) -> int:
        """By the determinant as long as some direction is hardly told, then by the index: in the
        space of the extreme directions of what is there, which bounds it, and among the best there,
        exactly."""
        within = self.told.T @ information @ self.told
        values, vectors = np.linalg.eigh(within)
        if values[0] < HARDLY:
            return Determinant().best(columns, information)
        seen = columns @ self.told
        least = _eigenvalues(np.diag(values[:EXTREMES]), seen @ vectors[:, :EXTREMES])[:, 0]
        most = _eigenvalues(np.diag(values[-EXTREMES:]), seen @ vectors[:, -EXTREMES:])[:, -1]
        promising = np.argsort(0.5 * np.log(most) - np.log(least), kind="stable")[:PROMISING]
        exact = _eigenvalues(within, seen[promising])
        return int(promising[np.argmin(0.5 * np.log(exact[:, -1]) - np.log(exact[:, 0]))])


def _eigenvalues(information: Array, columns: Array) -> Array:
    """Of an information (k, k) with each pose of columns (N, m, k) (N, k), ascending."""
    return np.asarray(np.linalg.eigvalsh(information + columns.swapaxes(1, 2) @ columns))


def _spread(columns: Array, information: Array) -> tuple[Array, Array]:
    """Of each pose: columns times the covariance (N, m, u), and the covariance of its coordinates
    with noise (N, m, m)."""
    spread = columns @ np.linalg.inv(information)
    return spread, np.eye(columns.shape[1]) + spread @ columns.swapaxes(1, 2)


def chosen_index(criterion: str, information: Array, candidates: int) -> ObservabilityIndex:
    """The index of a criterion's name, for so many candidates with this information (u, u)."""
    if criterion == "determinant":
        return Determinant()
    if criterion == "noise_amplification":
        return NoiseAmplification.among(information)
    return Prediction(information / candidates)
