"""Sequential likelihood ratio test for movements of the rig, and the finding of a run.

All models of the residuals are Gaussian. In the first model, the rig has not changed since
calibration and teaching: its errors have the calibration's covariance and are the same in every
frame. In other models, the rig's parameters perform a random walk at one of several rates, or have
larger errors from the start than the covariance states. Each model is a Kalman filter that predicts
the next residuals.

The likelihood ratio is the mean likelihood of the other models divided by the likelihood of the
first model. If the first model is true, this ratio is a martingale with mean 1. The probability
that it exceeds 1 / chance at any time of a run, however long, is then at most ``chance`` (Ville's
inequality). Therefore no correction for repeated tests is needed. Sources: J. Ville, Étude critique
de la notion de collectif (1939); H. Robbins, Statistical methods related to the law of the iterated
logarithm, Ann. Math. Statist. 41 (1970).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dtrtrs

from cmmsim.geometry.pose import Array
from cmmsim.geometry.stereo_rig import PARAMETER_NAMES
from cmmsim.uncertainty.drift_blocks import PLACES_OF_RIG, RIG, Rows

# Magnitude of a relevant drift of each parameter: a tenth of a pixel, 20 um, 20 urad.
SIZES = np.array(
    [*2 * (*4 * (0.1,), 1e-4, 1e-4, 1e-5, 1e-5, 1e-4), *6 * (2e-5,), *len(PLACES_OF_RIG) * (2e-5,)]
)

# Standard deviations of random walks after WALK_FRAMES frames, in units of SIZES. The rates stand
# for drifts within hours, minutes and seconds.
RATES = (0.05, 0.5, 5.0)

WALK_FRAMES = 1000
DRIFT_NAMES = (*PARAMETER_NAMES, *PLACES_OF_RIG)
# If the named parameters explain this fraction of the evidence for a drift, no more are named.
ENOUGH_EXPLAINED = 0.97
# If the named parameters explain less than this fraction, no movement is claimed.
MOSTLY_MOVED = 0.9
# Largest number of parameters that a finding names.
MOST_NAMED = 3
# A direction is named by the parameters whose components, in units of SIZES, are at least this
# large.
LEAST_COMPONENT = 0.3
# Name of the direction that never changes a residual.
ALWAYS_UNSEEN = ("scale of rig and taught places together",)


class Filter:
    """Kalman filter of n unknowns. The first w unknowns begin at zero and perform a random walk.

    The filter is in information form, so that all models share the products of derivatives. The
    density of the unknowns x is proportional to exp(constant + right x - x precision x / 2), in
    which ``right`` (n,) is the information vector and ``precision`` (n, n) the information matrix.
    Source: B. D. O. Anderson and J. B. Moore, Optimal Filtering (1979), section 6.3.
    """

    def __init__(self, prior_std: Array, walk_std: Array) -> None:
        self._walk = walk_std**2
        self.precision = np.diag(np.concatenate([np.zeros(len(walk_std)), prior_std**-2]))
        self.right = np.zeros(len(self.precision))
        self._constant = -float(np.log(prior_std).sum())

    def step(self, gram: Array, right: Array, squared: float, frames: int) -> None:
        """Update with residuals r (m,) of unit variance, which have derivatives D (m, n).

        ``gram`` is D'D, ``right`` is D'r, and ``squared`` is r'r. ``frames`` is the number of
        frames since the last update.
        """
        if len(self._walk):
            self._predict(frames)
        self.precision += gram
        self.right += right
        self._constant -= 0.5 * squared

    def _predict(self, frames: int) -> None:
        """Let the first unknowns walk for a number of frames."""
        w = len(self._walk)
        walked = frames * self._walk
        if not self.precision[0, 0]:
            self.precision[range(w), range(w)] = 1.0 / walked
            self._constant -= 0.5 * float(np.log(walked).sum())
            return
        # the unknowns before the step are integrated out and replaced by those after the step
        both = np.column_stack([self.precision[:w], self.right[:w]])
        lower, part = _factored(self.precision[:w, :w] + np.diag(1.0 / walked), both)
        self.precision -= part[:, :-1].T @ part[:, :-1]
        self.right -= part[:, :-1].T @ part[:, -1]
        logarithms = float(np.log(np.diag(lower)).sum() + 0.5 * np.log(walked).sum())
        self._constant += 0.5 * float(part[:, -1] @ part[:, -1]) - logarithms

    @property
    def log_likelihood(self) -> float:
        """Log-likelihood of all residuals so far."""
        # before the first update, the precision of unknowns that walk is zero
        if not self.precision[0, 0]:
            return 0.0
        lower, part = _factored(self.precision, self.right)
        return self._constant + 0.5 * float(part @ part) - float(np.log(np.diag(lower)).sum())

    def marginal_information(self, d: int) -> tuple[Array, Array]:
        """Return the marginal information (d, d) and score (d,) of the first ``d`` unknowns."""
        others = np.linalg.solve(self.precision[d:, d:], self.precision[d:, :d])
        return (
            self.precision[:d, :d] - self.precision[:d, d:] @ others,
            self.right[:d] - others.T @ self.right[d:],
        )


def _factored(matrix: Array, right: Array) -> tuple[Array, Array]:
    """Return the lower Cholesky factor L of a matrix (n, n), and L^-1 right, (n,) or (n, p).

    The upper part of the first result has no meaning. LAPACK is called directly, because SciPy's
    functions have a larger overhead than the computation itself.
    """
    lower, failed = dpotrf(matrix, lower=True, clean=False)
    if failed:
        raise np.linalg.LinAlgError(
            f"the matrix is not positive definite: minor {failed} of {len(matrix)}"
        )
    return lower, dtrtrs(lower, right, lower=True)[0]


@dataclass(frozen=True)
class DriftInformation:
    """Information about a drift in units of SIZES, from residuals alone, without the prior.

    ``information`` (d, d) is the inverse covariance, and ``score`` (d,) is the information times
    the estimate. ``from_start`` is True if the rig had these errors at teaching already.
    """

    information: Array
    score: Array
    from_start: bool


class Evidence:
    """Filters of all models.

    The errors of the calibration, in units of SIZES, are ``calibration`` (24, r) times r
    independent numbers of unit variance. ``delay_std`` is the standard deviation of the right
    camera's delay, s. ``offset_std`` (o,) are the standard deviations of constant errors of single
    centres, px. ``place_shows`` is True if the base is observed. Only then do the residuals depend
    on the pose of the whole rig.
    """

    def __init__(
        self, calibration: Array, delay_std: float, offset_std: Array, place_shows: bool
    ) -> None:
        self._calibration = calibration
        self._delay_std = delay_std
        self._size = len(SIZES) if place_shows else RIG
        known = np.concatenate([np.ones(calibration.shape[1]), np.ones(1), offset_std])
        self._fitting = Filter(known, np.zeros(0))
        self._walking = {
            rate: Filter(known, np.full(self._size, rate / np.sqrt(WALK_FRAMES))) for rate in RATES
        }
        self._wrong = Filter(np.concatenate([np.ones(RIG), known]), np.zeros(0))
        self._frames = 0

    @property
    def log_ratio(self) -> float:
        """Logarithm of the likelihood ratio of a moved rig to an unmoved rig.

        The likelihood of a moved rig is the mean over its models.
        """
        others = np.array([one.log_likelihood for one in (*self._walking.values(), self._wrong)])
        return float(
            np.logaddexp.reduce(others) - np.log(len(others)) - self._fitting.log_likelihood
        )

    def products(self, rows: Rows) -> Array:
        """Return the products (b, n, n) of residuals and derivatives of b blocks, for ``step``."""
        by_start = rows.by_start * SIZES[:RIG]
        known = [by_start @ self._calibration, self._delay_std * rows.by_delay, rows.by_offsets]
        by_drift = (rows.by_drift * SIZES)[..., : self._size]
        every = np.concatenate([by_drift, by_start, *known, rows.residuals[..., None]], axis=-1)
        return np.asarray(every.swapaxes(1, 2) @ every)

    def step(self, products: Array, frames: int) -> None:
        """Update with the products (n, n) of a block, ``frames`` frames after the last update."""
        self._frames += frames
        size = self._size
        drifted = np.delete(np.arange(len(products) - 1), slice(self._size, self._size + RIG))

        def update(model: Filter, columns: slice | NDArray[np.int_]) -> None:
            model.step(
                products[columns][:, columns],
                products[columns, -1],
                float(products[-1, -1]),
                frames,
            )

        update(self._fitting, slice(size + RIG, -1))
        update(self._wrong, slice(size, -1))
        for walking in self._walking.values():
            update(walking, drifted)

    @property
    def sensitivity(self) -> Array:
        """Information (d, d) about a drift at the slowest rate, in units of SIZES."""
        slow = min(RATES)
        return _without_prior(self._walking[slow], self._size, self._walked(slow))[0]

    @property
    def drift_information(self) -> DriftInformation:
        """Information about the drift from the most likely model of a moved rig."""
        rate, walking = max(self._walking.items(), key=lambda item: item[1].log_likelihood)
        from_start = self._wrong.log_likelihood > walking.log_likelihood
        if from_start:
            return DriftInformation(*_without_prior(self._wrong, RIG, 1.0), from_start)
        return DriftInformation(
            *_without_prior(walking, self._size, self._walked(rate)), from_start
        )

    def _walked(self, rate: float) -> float:
        """Return the variance of a random walk after all frames so far."""
        return rate**2 * max(self._frames, 1) / WALK_FRAMES


def _without_prior(filtered: Filter, size: int, prior_variance: float) -> tuple[Array, Array]:
    """Return information (d, d) and score (d,) of the first d unknowns, without the prior."""
    information, score = filtered.marginal_information(size)
    # without an update, there is no prior to subtract
    if not information.any():
        return information, score
    return information - np.eye(size) / prior_variance, score


@dataclass(frozen=True)
class Movement:
    """Movement of one parameter of the rig, with its standard deviation.

    The ``name`` of the parameter ends with the unit.
    """

    name: str
    amount: float
    std: float

    def __str__(self) -> str:
        entry = self.name.rpartition(".")[2]
        unit = entry.rpartition("_")[2] if "_" in entry else ""
        return f"{self.name} by {self.amount:.3g} ± {self.std:.1g} {unit}".rstrip()


@dataclass(frozen=True)
class Finding:
    """Result of a drift watch over a run.

    Attributes
    ----------
    noticed_s, noticed_frame : float and int, or None
        Time and frame at which a movement was detected; None if none was detected.
    evidence, limit : float
        Largest logarithm of the likelihood ratio, and the limit above which a movement counts as
        detected.
    chance : float
        Probability of a false alarm in a run, however long.
    frames, judged_frames : int
        Number of all frames, and of frames in which enough stickers were seen.
    movements : tuple of Movement
        A few parameters whose movement explains the residuals at the end of the run, in falling
        order of effect. Other parameters with nearly the same effect might be the true cause. Empty
        if no movement was detected.
    explained : float
        Fraction of the evidence that the movements explain.
    from_start : bool
        True if the parameters were probably wrong at teaching already.
    unseen : tuple of str
        Directions in which a drift of a tenth of a pixel, 20 um or 20 urad could not be detected.
        Each direction is named by the parameters that move together.
    """

    noticed_s: float | None
    noticed_frame: int | None
    evidence: float
    limit: float
    chance: float
    frames: int
    judged_frames: int
    movements: tuple[Movement, ...]
    explained: float
    from_start: bool
    unseen: tuple[str, ...]

    @property
    def warning(self) -> str | None:
        """Sentence that describes the detected movement; None if none was detected."""
        if self.noticed_s is None:
            return None
        alarm = f"(the probability of a false alarm is {self.chance:g} per run)"
        # Movements that explain little are fitted to an error of another kind.
        if self.explained < MOSTLY_MOVED:
            return (
                f"stickers are not where the cameras should see them, noticed after "
                f"{self.noticed_s:.2f} s, and a movement of {MOST_NAMED} parameters of the cameras "
                f"explains only {100 * self.explained:.0f} % of it: more likely, the detection of "
                f"the stickers or their positions are wrong {alarm}"
            )
        moved = ", ".join(map(str, self.movements))
        since, what = (
            ("were wrong from the start", "an error")
            if self.from_start
            else ("moved", "a movement")
        )
        return (
            f"the cameras {since}: noticed after {self.noticed_s:.2f} s; at the end of the run, "
            f"{100 * self.explained:.0f} % of what the stickers show is explained by {what} of "
            f"{moved} {alarm}"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the finding as a dictionary of plain numbers and texts."""
        return asdict(self) | {"warning": self.warning, "unseen": list(self.unseen)}


def movements(drift_information: DriftInformation) -> tuple[tuple[Movement, ...], float]:
    """Return a few parameters whose movement explains the residuals, and the explained fraction.

    Parameters are chosen one by one. Each of them explains most together with those chosen before.
    """
    information = drift_information.information
    score = drift_information.score
    total = float(score @ np.linalg.pinv(information, hermitian=True) @ score)
    chosen: list[int] = []
    explained = 0.0
    while len(chosen) < MOST_NAMED and explained < ENOUGH_EXPLAINED:
        gains = {
            k: _gain(information, score, [*chosen, k]) for k in range(len(score)) if k not in chosen
        }
        best = max(gains, key=lambda k: gains[k])
        chosen.append(best)
        explained = min(gains[best] / max(total, gains[best], np.finfo(float).tiny), 1.0)
    part = np.ix_(chosen, chosen)
    amounts = np.linalg.solve(information[part], score[chosen])
    covariance = np.linalg.inv(information[part])
    moved = [
        Movement(DRIFT_NAMES[k], float(amount * SIZES[k]), float(np.sqrt(variance) * SIZES[k]))
        for k, amount, variance in zip(chosen, amounts, np.diag(covariance), strict=True)
    ]
    return tuple(moved), explained


def unseen_directions(information: Array) -> tuple[str, ...]:
    """Return names of the directions in which the standard deviation of a drift exceeds SIZES.

    Directions that the residuals never show come first. The other directions follow in rising order
    of information.
    """
    values, vectors = np.linalg.eigh(information)
    named = [
        " with ".join(
            DRIFT_NAMES[k] for k in np.argsort(-np.abs(vector)) if abs(vector[k]) >= LEAST_COMPONENT
        )
        for value, vector in zip(values, vectors.T, strict=True)
        if value < 1.0
    ]
    place = () if len(information) == len(DRIFT_NAMES) else ("place of the whole rig (base pose)",)
    return (*ALWAYS_UNSEEN, *place, *named)


def _gain(information: Array, score: Array, chosen: list[int]) -> float:
    """Return the evidence, twice a log-likelihood, that movements of chosen parameters explain."""
    part = information[np.ix_(chosen, chosen)]
    if np.linalg.eigvalsh(part)[0] <= 0.0:
        return 0.0
    return float(score[chosen] @ np.linalg.solve(part, score[chosen]))
