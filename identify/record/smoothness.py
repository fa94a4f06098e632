"""Smoothness of measured poses: their noise and spectrum, and single poses that are wrong.

A motion is smooth over a few frames, and the noise of the sensor is not. A polynomial through the
nearest poses on both sides predicts each pose. No model of the robot is needed.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from identify.arrays import Array
from identify.filtering import interpolated
from identify.record.telemetry import PoseLog

NEIGHBOURS = 12  # number of poses near a pose, through which polynomials go
TRUSTED = 9  # number of these neighbours that must be right
SUBSETS = 30  # number of polynomials that are tried for each pose
DEGREE = 6  # degree of the polynomial. It follows motions up to a tenth of the frame rate.
LONGEST = 2.5  # longest time between two poses of a polynomial, as a multiple of the usual time
# Squared distance from the prediction above which a pose is a gross error. It is the squared
# Mahalanobis distance, whose mean is six for noise alone.
GROSS = 100.0
MEDIAN = float(chdtri(6, 0.5))  # median of this squared distance for noise alone
FEWEST = 30  # smallest number of poses among which wrong ones are looked for


@dataclass(frozen=True)
class Windows:
    """Rows of a log, each with its neighbours on both sides and the polynomial through them.

    Attributes
    ----------
    rows : ndarray, shape (K,)
        Rows whose neighbours are near enough in time.
    neighbours : ndarray, shape (K, NEIGHBOURS)
        Rows of the neighbours.
    weights : ndarray, shape (K, NEIGHBOURS)
        Weights with which the values of the neighbours predict the value of the row.
    """

    rows: NDArray[np.intp]
    neighbours: NDArray[np.intp]
    weights: Array

    @property
    def variance(self) -> Array:
        """Variance (K,) of a deviation due to noise, as a multiple of the variance of a value."""
        return np.asarray(1.0 + np.sum(self.weights**2, axis=1))

    def deviations(self, values: Array) -> Array:
        """Return the deviations (K, n) of values (N, n) from what their neighbours predict."""
        predicted = np.einsum("kq,kqn->kn", self.weights, values[self.neighbours])
        return np.asarray(values[self.rows] - predicted)


def windows_of(times: Array) -> Windows:
    """Return the rows at times (N,), s, that have NEIGHBOURS / 2 neighbours on either side."""
    half = NEIGHBOURS // 2
    rows = np.arange(half, max(len(times) - half, half))
    if not len(rows):
        return Windows(rows, np.zeros((0, NEIGHBOURS), np.intp), np.zeros((0, NEIGHBOURS)))
    neighbours, powers, reached = _windows(times, rows)
    base, along = _weights(powers[reached])
    weights = np.einsum("kqp,kp->kq", base, along)
    return Windows(rows[reached], neighbours[reached], weights)


def wrong_poses(log: PoseLog, covariance: Array) -> NDArray[np.bool_]:
    """Return which poses (N,) of a log are single gross errors.

    covariance (6, 6): covariance of a pose. If there are too few poses, or the covariance is not
    valid, no pose counts as wrong.
    """
    wrong = np.zeros(len(log.ok), dtype=bool)
    good = np.flatnonzero(log.ok)
    # An invalid covariance is refused later, with a better message.
    valid = np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[0] > 0
    if valid and len(good) >= FEWEST:
        wrong[good[gross_errors(log.time[good], log.pose[good], covariance)]] = True
    return wrong


def local_misfit(times: Array, poses: Array, covariance: Array) -> float:
    """Return the mean squared distance of poses (N, 6) from local polynomials, per component.

    The distance is in units of the noise variance, and about one if the motion is a smooth function
    of the times (N,), s. The largest tenth of all distances is left out, because a motion can have
    kinks.
    """
    white = _whitened(poses, covariance)
    neighbours, powers, _ = _windows(times, np.arange(len(times)))
    _, leftover = _predicted(white, powers, white[neighbours])
    ordered = np.sort(leftover)[: max(1, int(0.9 * len(leftover)))]
    return float(ordered.mean())


def gross_errors(times: Array, poses: Array, covariance: Array) -> NDArray[np.intp]:
    """Return the rows of single poses that are wrong.

    A wrong pose is far from the polynomial through its neighbours, and the neighbours are near the
    polynomial. At a kink of the motion, the neighbours are far from it, too. Neighbours can also be
    wrong. Of several polynomials through TRUSTED neighbours, the one that is nearest to TRUSTED of
    them is used (least trimmed squares).

    times, poses (N,) and (N, 6)  Times, s, and measured poses, without lost ones.
    covariance (6, 6)             Covariance of a pose.

    References
    ----------
    Rousseeuw, Least median of squares regression, Journal of the American Statistical Association
    79(388), 1984.
    """
    rows = np.arange(len(times))
    white = _whitened(poses, covariance)
    neighbours, powers, reached = _windows(times, rows)
    values = white[neighbours]
    best = np.full(len(rows), np.inf)
    kept = np.zeros((len(rows), TRUSTED), dtype=np.intp)
    rng = np.random.default_rng(0)
    for _ in range(SUBSETS):
        chosen = np.sort(rng.choice(NEIGHBOURS, TRUSTED, replace=False))
        base, triangle = np.linalg.qr(powers[:, chosen])
        slopes = np.linalg.solve(triangle, base.transpose(0, 2, 1) @ values[:, chosen])
        apart = np.sum((values - powers @ slopes) ** 2, axis=2)
        order = np.argsort(apart, axis=1)[:, :TRUSTED]
        trimmed = np.take_along_axis(apart, order, axis=1).sum(axis=1)
        better = trimmed < best
        best[better] = trimmed[better]
        kept[better] = order[better]
    squared, leftover = _predicted(
        white[rows],
        np.take_along_axis(powers, kept[:, :, None], axis=1),
        np.take_along_axis(values, kept[:, :, None], axis=1),
    )
    # A motion too fast for the frame rate is nowhere near its polynomials.
    least = max(1.0, float(np.median(squared)) / MEDIAN)
    wrong = np.flatnonzero(reached & (squared > GROSS * np.maximum(least, leftover)))
    return _still_wrong(times, white, wrong[np.argsort(squared[wrong])], least)


def _still_wrong(
    times: Array, white: Array, wrong: NDArray[np.intp], least: float
) -> NDArray[np.intp]:
    """Return the sorted rows of wrong poses that are also far from right poses alone.

    A right pose beside wrong poses can be far from a polynomial through the wrong ones. wrong:
    rows, the least wrong first. least: lower limit of the mean squared distance of neighbours.
    """
    for row in wrong:
        others = np.delete(np.arange(len(times)), wrong[wrong != row])
        index = np.searchsorted(others, [row])
        # Consecutive wrong poses leave a gap, so a longer time between poses is allowed.
        neighbours, powers, reached = _windows(times[others], index, 2 * LONGEST)
        squared, leftover = _predicted(white[[row]], powers, white[others[neighbours]])
        if reached[0] and squared[0] <= GROSS * max(least, leftover[0]):
            wrong = wrong[wrong != row]
    return np.sort(wrong)


def _whitened(poses: Array, covariance: Array) -> Array:
    """Return poses (N, 6) with unwrapped angles, whitened by the covariance of the noise."""
    continuous = np.column_stack([poses[:, :3], np.unwrap(poses[:, 3:], axis=0)])
    return np.asarray(np.linalg.solve(np.linalg.cholesky(covariance), continuous.T).T)


def _windows(
    times: Array, rows: NDArray[np.intp], longest: float = LONGEST
) -> tuple[NDArray[np.intp], Array, NDArray[np.bool_]]:
    """Return the neighbours (k, NEIGHBOURS) of rows (k,), and the powers of their times.

    The powers (k, NEIGHBOURS, DEGREE + 1) are of times relative to the row, scaled to at most one.
    The third array (k,) is False where the window spans a gap, across which no polynomial reaches.
    """
    first = np.clip(rows - NEIGHBOURS // 2, 0, len(times) - NEIGHBOURS - 1)
    window = first[:, None] + np.arange(NEIGHBOURS + 1)
    neighbours = window[window != rows[:, None]].reshape(len(rows), NEIGHBOURS)
    since = times[neighbours] - times[rows][:, None]
    scale = np.abs(since).max(axis=1, keepdims=True)
    powers = (since / scale)[:, :, None] ** np.arange(DEGREE + 1)
    widest = np.diff(times[window], axis=1).max(axis=1)
    return neighbours, powers, widest <= longest * np.median(np.diff(times))


def _predicted(white: Array, powers: Array, values: Array) -> tuple[Array, Array]:
    """Predict whitened poses (k, 6) by polynomials through other poses (k, q, 6).

    powers (k, q, DEGREE + 1): powers of the times of the other poses. Returns the squared distances
    (k,) from the predictions in units of their variance, and the mean squared distances (k,) of the
    other poses from the polynomials, per component and degree of freedom.
    """
    base, weights = _weights(powers)
    coefficients = base.transpose(0, 2, 1) @ values
    residuals = values - base @ coefficients
    freedom = white.shape[1] * (powers.shape[1] - powers.shape[2])
    leftover = np.sum(residuals**2, axis=(1, 2)) / freedom
    predicted = np.einsum("kp,kpc->kc", weights, coefficients)
    variance = 1.0 + np.sum(weights**2, axis=1)
    return np.sum((white - predicted) ** 2, axis=1) / variance, leftover


def _weights(powers: Array) -> tuple[Array, Array]:
    """Return an orthonormal basis (k, q, p) of powers (k, q, p), and weights (k, p).

    The sum of a polynomial's coefficients in the basis, times the weights, is the value of the
    polynomial at the row.
    """
    base, triangle = np.linalg.qr(powers)
    # At the row itself all powers but the first are zero.
    at_row = np.eye(powers.shape[2])[:, :1]
    return base, np.linalg.solve(triangle.transpose(0, 2, 1), at_row)[:, :, 0]


NORMAL = 1.4826  # ratio of the standard deviation of normal numbers to their median magnitude
MOVING = 0.99  # fraction of the power of a motion that lies below its highest frequency
# Standard deviation of a component, as a multiple of that of its noise, above which it moves.
MOVES = 2.0
SEGMENTS = 4  # number of segments of the spectrum, not counting those that overlap two others
SHORTEST = 128  # smallest number of frames of a segment, if the record has that many


def pose_noise(time: Array, poses: Array) -> Array:
    """Return the standard deviation (6,) of the noise of poses (N, 6) at times (N,), m and rad.

    It is NaN if no poses are near enough to each other in time.
    """
    windows = windows_of(time)
    if not len(windows.rows):
        return np.full(6, np.nan)
    deviation = windows.deviations(poses) / np.sqrt(windows.variance)[:, None]
    return np.asarray(NORMAL * np.median(np.abs(deviation), axis=0))


@dataclass(frozen=True)
class Spectrum:
    """Power of a motion by frequency.

    frequency (F,)  Frequencies, Hz.
    power (F, 6)    Power of each entry of a pose, m2/Hz and rad2/Hz.
    highest_hz      Frequency below which 99 % of the power lies, the higher one of positions and
                    angles. It is zero if nothing moves.
    """

    frequency: Array
    power: Array
    highest_hz: float


def spectrum(time: Array, poses: Array, noise: Array) -> Spectrum:
    """Return the spectrum of poses (N, 6) that were measured at times (N,).

    Poses are interpolated at N evenly spaced times. Positions or angles that move no more than
    MOVES times their noise (6,), m and rad, have no highest frequency.
    """
    # imported here, because it imports scipy.stats, for which a process of a study must not wait
    from scipy.signal import welch

    even = np.linspace(time[0], time[-1], len(time))
    rate = (len(time) - 1) / (time[-1] - time[0])
    values = interpolated(even, time, poses)
    length = min(max(len(time) // SEGMENTS, SHORTEST), len(time))
    frequency, power = welch(values, rate, nperseg=length, detrend="linear", axis=0)
    highest = 0.0
    for kind in (slice(0, 3), slice(3, 6)):
        total = np.cumsum(power[:, kind].sum(axis=1))
        if (values[:, kind].std(axis=0) > MOVES * noise[kind]).any():
            index = int(np.searchsorted(total, MOVING * total[-1]))
            highest = max(highest, float(frequency[index]))
    return Spectrum(frequency, power, highest)
