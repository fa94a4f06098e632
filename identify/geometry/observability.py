"""Observability of a geometry: undetermined combinations, number of poses needed, and indices.

The smaller the index of a set of poses, the better the poses:

- `determinant`: minus the logarithm of the determinant of the information, Borm and Menq's O1,
  which is D-optimality (Int. J. Robot. Res. 10(1), 1991).
- `prediction`: logarithm of the mean expected squared error of the calibrated robot at the
  candidates' poses (I-optimality).
- `noise_amplification`: logarithm of s_1 / s_r^2, with the extreme singular values of the whitened
  columns, the inverse of Nahvi and Hollerbach's index (ICRA 1996). It covers only combinations that
  all candidates together determine, because no choice determines the others.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from dynamics import Robot
from identify.arrays import Array
from identify.errors import EstimationError
from identify.geometry.calibration import OBSERVABLE

SMALL = 0.05  # fraction of the largest coefficient up to which a number is left out
# Smallest length of a pivot's column, as a fraction of the largest remaining length.
LONG_ENOUGH = 0.5


def unobservable(covariance: Array, prior_std: Array) -> Array:
    """Return orthonormal directions (k, g) of geometric numbers that the poses do not determine.

    The numbers are in units of their tolerance. Along these directions the standard deviation stays
    above OBSERVABLE of the tolerance.
    """
    values, vectors = np.linalg.eigh(covariance / np.outer(prior_std, prior_std))
    return np.asarray(vectors[:, values > OBSERVABLE**2].T)


def combinations(names: tuple[str, ...], covariance: Array, prior_std: Array) -> tuple[str, ...]:
    """Return the combinations that poses do not determine, such as `a + 0.5 b`.

    If the numbers change together by these amounts (m and rad), the measured poses hardly change.
    Each combination begins with a number that no other combination contains.
    """
    directions = unobservable(covariance, prior_std)
    if not len(directions):
        return ()
    pivots = _pivots(directions)
    # In this basis each combination has its own pivot, with coefficient one.
    rows = np.linalg.solve(directions[:, pivots], directions)
    return tuple(
        _expression(names, row * prior_std / prior_std[pivot], np.abs(row), pivot)
        for row, pivot in zip(rows, pivots, strict=True)
    )


def _pivots(directions: Array) -> list[int]:
    """Return the indices of well-separated pivot columns, as many as there are rows.

    Each pivot is the first column that is still long enough.
    """
    remaining = directions.copy()
    pivots = list[int]()
    while len(pivots) < len(directions):
        lengths = np.linalg.norm(remaining, axis=0)
        pivots.append(int(np.argmax(lengths >= LONG_ENOUGH * lengths.max())))
        along = remaining[:, pivots[-1]] / lengths[pivots[-1]]
        remaining -= np.outer(along, along @ remaining)
    return sorted(pivots)


def _expression(names: tuple[str, ...], coefficients: Array, sizes: Array, pivot: int) -> str:
    others = [k for k in np.flatnonzero(sizes > SMALL * sizes.max()) if k != pivot]
    terms = [names[pivot]]
    for k in others:
        size = f"{abs(coefficients[k]):.2g}"
        terms.append(
            f"{'-' if coefficients[k] < 0 else '+'} {'' if size == '1' else size + ' '}{names[k]}"
        )
    return " ".join(terms)


def posterior(information: Array, scale: Array, count: int) -> Array:
    """Return the covariance (g, g) [m and rad] of the geometry, the first `count` = g unknowns.

    information (u, u): information of the poses, without the prior, about unknowns in units of
    their prior. scale (u, u): matrix from these units to m and rad.
    """
    covariance = scale @ np.linalg.inv(information + np.eye(len(scale))) @ scale.T
    return np.asarray(covariance[:count, :count])


def check_enough(
    robot: Robot, poses: int, information: Array, scale: Array, prior_std: Array
) -> None:
    """Raise EstimationError if poses give fewer equations than there are determinable combinations.

    ``information`` (u, u) is the information of many candidates about all unknowns, in units of
    their prior. The message states the needed poses, and the numbers hardest to determine.
    """
    names = robot.geometry.number_names
    coordinates = len(robot.coordinate_names)
    covariance = posterior(information, scale, len(names))
    determinable = len(names) - len(unobservable(covariance, prior_std))
    if poses * coordinates >= determinable:
        return
    worst = np.argsort(-np.sqrt(np.diagonal(covariance)) / prior_std, kind="stable")
    missing = determinable - poses * coordinates
    hardest = [names[k] for k in worst if covariance[k, k] <= (OBSERVABLE * prior_std[k]) ** 2]
    hardest = hardest[:missing]
    shown = ", ".join(hardest[:6]) + (f" and {len(hardest) - 6} more" if len(hardest) > 6 else "")
    needed = -(-determinable // coordinates)
    raise EstimationError(
        f"{poses} poses that differ give {poses * coordinates} equations for {determinable} "
        f"combinations of the {len(names)} geometric numbers of {robot.name} that poses can "
        f"determine: at least {needed} are needed; missing equations: {missing}; hardest to "
        f"determine: {shown}"
    )


# Number of best determined directions, and of worst determined directions, in the first ranking.
EXTREMES = 24
# Number of best candidates of the first ranking for which the index is computed exactly.
PROMISING = 16
HARDLY = 10.0  # information about a direction below which the direction counts as hardly determined


class ObservabilityIndex(ABC):
    """Index of the information (u, u) of poses and prior, for unknowns in units of their prior."""

    @abstractmethod
    def value(self, information: Array) -> tuple[float, Array]:
        """Return the index, and the negative of its derivative by the information (u, u)."""

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
    """Log of the mean squared error of the candidates' coordinates, each in units of its noise.

    ``weight`` (u, u) is the matrix of the squared error as a quadratic form of the unknowns.
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
    """Logarithm of the inverse of Nahvi and Hollerbach's index.

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
    """Return the ascending eigenvalues (N, k) of an information (k, k) plus that of each pose."""
    return np.asarray(np.linalg.eigvalsh(information + columns.swapaxes(1, 2) @ columns))


def _spread(columns: Array, information: Array) -> tuple[Array, Array]:
    """Return columns times the unknowns' covariance, and covariances of coordinates with noise."""
    weighted = columns @ np.linalg.inv(information)
    return weighted, np.eye(columns.shape[1]) + weighted @ columns.swapaxes(1, 2)


def chosen_index(criterion: str, information: Array, candidates: int) -> ObservabilityIndex:
    """Return the index of a criterion for candidates with this total information (u, u)."""
    if criterion == "determinant":
        return Determinant()
    if criterion == "noise_amplification":
        return NoiseAmplification.among(information)
    return Prediction(information / candidates)
