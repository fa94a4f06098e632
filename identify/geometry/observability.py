"""Observability of a geometry: undetermined combinations, and number of poses needed."""

import numpy as np

from dynamics import Robot
from identify.arrays import Array
from identify.errors import EstimationError
from identify.geometry.calibration import OBSERVABLE

SMALL = 0.05
"""Share of the largest coefficient below which a number is left out of a combination."""

LONG_ENOUGH = 0.5
"""Smallest length of the column of a pivot, as a share of the largest remaining length."""


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
    """Return well-separated pivot columns, as many as there are rows.

    Each pivot is the first column that is long enough.
    """
    left = directions.copy()
    pivots = list[int]()
    while len(pivots) < len(directions):
        lengths = np.linalg.norm(left, axis=0)
        pivots.append(int(np.argmax(lengths >= LONG_ENOUGH * lengths.max())))
        along = left[:, pivots[-1]] / lengths[pivots[-1]]
        left -= np.outer(along, along @ left)
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

    information (u, u): information of the poses about unknowns in units of their prior. The prior
    is added here.
    """
    covariance = scale @ np.linalg.inv(information + np.eye(len(scale))) @ scale.T
    return np.asarray(covariance[:count, :count])


def check_enough(
    robot: Robot, poses: int, information: Array, scale: Array, prior_std: Array
) -> None:
    """Raise EstimationError if the poses give fewer equations than there are numbers to determine.

    ``information`` (u, u) is the information of many poses about all unknowns, in units of their
    prior. The message states how many poses are needed and which numbers are hardest to determine.
    """
    names = robot.geometry.number_names
    rows = len(robot.coordinate_names)
    covariance = posterior(information, scale, len(names))
    told = len(names) - len(unobservable(covariance, prior_std))
    if poses * rows >= told:
        return
    worst = np.argsort(-np.sqrt(np.diagonal(covariance)) / prior_std, kind="stable")
    unseen = [names[k] for k in worst if covariance[k, k] <= (OBSERVABLE * prior_std[k]) ** 2][
        : told - poses * rows
    ]
    shown = ", ".join(unseen[:6]) + (f" and {len(unseen) - 6} more" if len(unseen) > 6 else "")
    needed = -(-told // rows)
    missing = told - poses * rows
    raise EstimationError(
        f"{poses} poses that differ give {poses * rows} equations for {told} combinations of the "
        f"{len(names)} geometric numbers of {robot.name} that poses can determine: at least "
        f"{needed} are needed; missing: {missing}, hardest to determine: {shown}"
    )
