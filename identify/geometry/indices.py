"""Observability indices of sets of static poses. A smaller index is better.

- `determinant`: minus the logarithm of the determinant of the information, Borm and Menq's O1,
  which is D-optimality (Int. J. Robot. Res. 10(1), 1991).
- `prediction`: mean expected error of the calibrated robot at the candidates' poses
  (I-optimality).
- `noise_amplification`: s_1 / s_r^2 of the extreme singular values of the whitened columns, the
  inverse of Nahvi and Hollerbach's index (ICRA 1996). It covers only combinations that all
  candidates together determine, because the other combinations do not depend on the choice.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from identify.arrays import Array
from identify.geometry.calibration import OBSERVABLE

EXTREMES = 24
"""Number of the best determined, and of the worst determined directions in the first ranking."""
PROMISING = 16
"""Number of best candidates of the first ranking for which the index is computed exactly."""
HARDLY = 10.0
"""Information about a direction below which the direction counts as hardly determined."""


class ObservabilityIndex(ABC):
    """Index of the information (u, u) of poses and prior, for unknowns in units of their prior."""

    @abstractmethod
    def value(self, information: Array) -> tuple[float, Array]:
        """Return the index, and its negative derivative with respect to the information (u, u)."""

    @abstractmethod
    def best(self, columns: Array, information: Array) -> int:
        """Return the number of the pose that improves the index of this information most.

        ``columns`` (N, m, u) are the whitened columns of the candidate poses.
        """


class Determinant(ObservabilityIndex):
    """Index O1 of Borm and Menq."""

    def value(self, information: Array) -> tuple[float, Array]:
        covariance = np.asarray(np.linalg.inv(information))
        return float(np.linalg.slogdet(covariance)[1]), covariance

    def best(self, columns: Array, information: Array) -> int:
        _, inner = _spread(columns, information)
        return int(np.argmax(np.linalg.slogdet(inner)[1]))


@dataclass(frozen=True)
class Prediction(ObservabilityIndex):
    """Mean squared error of the candidates' coordinates, each in units of its noise.

    ``weight`` (u, u) is the matrix of this quadratic form in the unknowns.
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
    """Inverse of Nahvi and Hollerbach's index.

    ``told`` (u, r) are orthonormal directions of the unknowns that the candidates can determine.
    """

    told: Array

    @classmethod
    def among(cls, information: Array) -> "NoiseAmplification":
        """Return the index for candidates with this total information (u, u)."""
        values, vectors = np.linalg.eigh(information)
        return cls(vectors[:, values > OBSERVABLE**-2])

    def value(self, information: Array) -> tuple[float, Array]:
        values, vectors = np.linalg.eigh(self.told.T @ information @ self.told)
        first = (self.told @ vectors[:, -1])[:, None]
        last = (self.told @ vectors[:, 0])[:, None]
        index = 0.5 * np.log(values[-1]) - np.log(values[0])
        return float(index), np.asarray(
            last @ last.T / values[0] - 0.5 * first @ first.T / values[-1]
        )

    def best(self, columns: Array, information: Array) -> int:
        """Return the number of the pose that improves the index most.

        While a direction is hardly determined, the determinant is used in place of this index. The
        candidates are first ranked by a bound of the index in the space of the extreme directions.
        Then the index is computed exactly for the best candidates.
        """
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
    """Return the ascending eigenvalues (N, k) of an information (k, k) with each pose added."""
    return np.asarray(np.linalg.eigvalsh(information + columns.swapaxes(1, 2) @ columns))


def _spread(columns: Array, information: Array) -> tuple[Array, Array]:
    """Return columns of each pose times the covariance, and covariances of its coordinates."""
    spread = columns @ np.linalg.inv(information)
    return spread, np.eye(columns.shape[1]) + spread @ columns.swapaxes(1, 2)


def chosen_index(criterion: str, information: Array, candidates: int) -> ObservabilityIndex:
    """Return the index of a criterion for candidates with this total information (u, u)."""
    if criterion == "determinant":
        return Determinant()
    if criterion == "noise_amplification":
        return NoiseAmplification.among(information)
    return Prediction(information / candidates)
