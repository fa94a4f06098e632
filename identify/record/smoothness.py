"""Smoothness of measured poses: local polynomials in time, and single poses that are off them.

A polynomial through the nearest poses on both sides predicts each pose. No model of the robot is
needed.
"""

import numpy as np
from numpy.typing import NDArray

from identify.arrays import Array

NEIGHBOURS = 10
"""Number of poses through which a polynomial goes."""

DEGREE = 6
"""Degree of the polynomial. It follows motions up to a tenth of the frame rate."""

LONGEST = 3.5
"""Longest time between two poses of a polynomial, in usual times between poses."""

GROSS = 60.0
"""Squared distance from the prediction above which a pose is a gross error.

It is in units of its variance. For noise alone, its mean is six.
"""


def local_misfit(times: Array, poses: Array, covariance: Array) -> float:
    """Return the mean squared distance of poses (N, 6) from local polynomials, per component.

    It is in variances of the noise, and about one if the motion is smooth in times (N,), s. The
    largest tenth of all distances is left out, where the motion has kinks.
    """
    rows = np.arange(len(times))
    _, leftover, _ = _predicted(times, _whitened(poses, covariance), rows)
    ordered = np.sort(leftover)[: max(1, int(0.9 * len(leftover)))]
    return float(ordered.mean())


def gross_errors(times: Array, poses: Array, covariance: Array) -> NDArray[np.intp]:
    """Return the rows of single poses that are wrong.

    A wrong pose is far from the polynomial through its neighbours, from which the neighbours
    themselves are not. At a kink of the motion, all poses are far from it. The worst pose is left
    out first, because it also moves the predictions of its neighbours.

    Parameters
    ----------
    times, poses : ndarray, shapes (N,) and (N, 6)
        Times, s, and measured poses, without lost ones.
    covariance : ndarray, shape (6, 6)
        Covariance of a pose.

    Examples
    --------
    >>> import numpy as np
    >>> times = np.arange(100) / 60
    >>> poses = np.outer(0.01 * np.sin(5 * times), np.ones(6))
    >>> poses += 1e-6 * np.random.default_rng(0).standard_normal(poses.shape)
    >>> poses[40, 1] += 1e-3
    >>> gross_errors(times, poses, 1e-12 * np.eye(6))
    array([40])
    """
    kept = np.arange(len(times))
    white = _whitened(poses, covariance)
    found: list[int] = []
    passed: set[int] = set()
    while len(kept) > NEIGHBOURS + 1:
        squared, leftover, _ = _predicted(times[kept], white[kept], np.arange(len(kept)))
        squared = np.where([int(row) in passed for row in kept], 0.0, squared)
        worst = int(np.argmax(squared))
        if squared[worst] <= GROSS:
            break
        if squared[worst] > GROSS * max(1.0, leftover[worst]):
            found.append(int(kept[worst]))
            kept = np.delete(kept, worst)
            continue
        # A second wrong pose near it can hide it.
        near = np.delete(np.arange(len(kept)), _strongest_beside(squared, worst))
        place = int(np.flatnonzero(near == worst)[0])
        own, rest, _ = _predicted(times[kept[near]], white[kept[near]], np.array([place]))
        if own[0] > GROSS * max(1.0, rest[0]):
            found.append(int(kept[worst]))
            kept = np.delete(kept, worst)
        else:
            passed.add(int(kept[worst]))
    return np.array(_still_wrong(times, white, found), dtype=np.intp)


def _still_wrong(times: Array, white: Array, found: list[int]) -> list[int]:
    """Return the rows that are wrong beside the right ones alone, in their order.

    A right pose beside two wrong ones can have been taken for wrong before both were left out.
    """
    wrong = sorted(found)
    for row in reversed(found):
        others = np.delete(np.arange(len(times)), [one for one in wrong if one != row])
        place = np.searchsorted(others, row)
        squared, _, _ = _predicted(times[others], white[others], np.array([place]))
        if squared[0] <= GROSS:
            wrong.remove(row)
    return wrong


def _strongest_beside(squared: Array, row: int) -> int:
    """Return the row with the largest entry of squared (N,) near another row."""
    near = np.arange(max(0, row - NEIGHBOURS), min(len(squared), row + NEIGHBOURS + 1))
    near = near[near != row]
    return int(near[np.argmax(squared[near])])


def _whitened(poses: Array, covariance: Array) -> Array:
    """Return poses (N, 6) in standard deviations of the noise, with angles without jumps."""
    continuous = np.column_stack([poses[:, :3], np.unwrap(poses[:, 3:], axis=0)])
    return np.asarray(np.linalg.solve(np.linalg.cholesky(covariance), continuous.T).T)


def _predicted(
    times: Array, white: Array, rows: NDArray[np.intp]
) -> tuple[Array, Array, NDArray[np.intp]]:
    """Predict whitened poses (N, 6) at some rows (k,) by polynomials through their neighbours.

    Returns the squared distances (k,) from the predictions in units of their variance, the mean
    squared distances (k,) of the neighbours from the polynomial per component and degree of
    freedom, and the neighbours (k, NEIGHBOURS).
    """
    half = NEIGHBOURS // 2
    first = np.clip(rows - half, 0, len(times) - NEIGHBOURS - 1)
    window = first[:, None] + np.arange(NEIGHBOURS + 1)
    neighbours = window[window != rows[:, None]].reshape(len(rows), NEIGHBOURS)
    since = times[neighbours] - times[rows][:, None]
    scale = np.abs(since).max(axis=1, keepdims=True)
    powers = (since / scale)[:, :, None] ** np.arange(DEGREE + 1)
    base, triangle = np.linalg.qr(powers)
    values = white[neighbours]
    along = base.transpose(0, 2, 1) @ values
    left = values - base @ along
    freedom = white.shape[1] * (NEIGHBOURS - DEGREE - 1)
    leftover = np.sum(left**2, axis=(1, 2)) / freedom
    # At the row itself all powers but the first are zero.
    weights = np.linalg.solve(triangle.transpose(0, 2, 1), np.eye(DEGREE + 1)[:, :1])[:, :, 0]
    predicted = np.einsum("kp,kpc->kc", weights, along)
    variance = 1.0 + np.sum(weights**2, axis=1)
    squared = np.sum((white[rows] - predicted) ** 2, axis=1) / variance
    # A polynomial does not reach across a gap.
    longest = np.diff(times[window], axis=1).max(axis=1)
    squared[longest > LONGEST * np.median(np.diff(times))] = 0.0
    return squared, leftover, neighbours
