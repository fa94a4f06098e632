"""Tests of whether the model explains its records, by the size and the whiteness of its residuals.

With the right model, noise alone determines the mean squared whitened residual. If the residual is
significantly larger, the excess is caused by an error of the model. Such an error is correlated
from frame to frame, and moves an estimate further than white residuals of the same size would.
Scaling the covariance by the residual (Birge's ratio) is therefore not enough. For stationary
residuals r with the Jacobian J and the autocorrelation R_k, the scores J^T r have the covariance

    sum over frames i, j of J_i^T R_(i-j) J_j

(Morelli and Klein, "Accuracy of aerodynamic model parameters estimated from flight test data", J.
Guidance, Control, and Dynamics 20(1), 1997), with R_k estimated from the residuals. The covariance
due to the model's error is added to that due to noise. An error that is compensated by wrong
parameters does not appear in the residuals. If the model's error causes most of the residual, no
interval can be trusted, and nothing counts as identified.

A model driven by the logged commands has the same input as the plant. If it is right, its residuals
are the sensor's noise, independent from frame to frame. The portmanteau test of Ljung and Box
checks their autocorrelations r_k in n frames: n (n + 2) sum_k r_k² / (n - k) over the lags
k = 1 ... L is chi-square distributed with L degrees of freedom. A model that closes its own loop
cannot follow the effect of the noise on the plant. Its residuals are coloured even if it is right,
so they are not tested for whiteness.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import chdtrc, ndtri

from identify.arrays import Array
from identify.errors import EstimationError
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.files.dataset import POSE

SIGNIFICANT = float(ndtri(0.999))
"""Excess of the residual, in standard deviations, above which the model has an error."""

MISFIT_STDS = 5.0
"""Deficit of the residual, in standard deviations, above which the stated covariance is wrong."""

NOISE_DECIDES = 3.0
"""Ratio of the residual to its expected value above which the model's error dominates."""

REACH = 0.2
"""Lag from which residuals are assumed independent, as a fraction of a record's length.

Up to this lag, a window reduces the correlations gradually to zero.
"""

MISFIT = ("noise_ratio", "expected_noise_ratio", "noise_ratio_std")
"""Entries of a result that hold the fields of a `Misfit`, in the same order."""


@dataclass(frozen=True)
class Misfit:
    """Mean squared whitened residual of a record, and its expected value for noise alone.

    std: standard deviation of the residual from experiment to experiment, for noise alone.
    """

    found: float
    expected: float
    std: float

    def __str__(self) -> str:
        # The residuals of a model that the logged commands drive are the noise itself.
        moving = ", more than 1 as it also moves the robot through the servo"
        return (
            f"the mean squared residual is {self.found:.3f} times the variance that the sensor "
            f"states, and {self.expected:.3f} ± {self.std:.3f} times is expected of noise alone"
            f"{moving if self.expected > 1.0 else ''}"
        )

    @property
    def significant(self) -> bool:
        """True if the model misses the record by more than chance explains."""
        return self.found > self.expected + SIGNIFICANT * self.std

    @property
    def share_of_model(self) -> float:
        """Fraction of the mean squared residual above its expected value, zero if insignificant."""
        return 1 - self.expected / self.found if self.significant else 0.0

    @property
    def decides(self) -> bool:
        """True if the model's error causes most of the residual."""
        return self.found > NOISE_DECIDES * self.expected

    def warnings(self, model: str = "the model") -> tuple[str, ...]:
        """Return a warning if noise does not explain the residual."""
        wrong = "either this model of the robot or the covariance that the sensor states is wrong"
        if self.decides:
            return (
                f"{model} does not explain the record: {self}; {wrong}, by so much that nothing "
                "counts as identified",
            )
        if self.significant:
            return (
                f"{model} does not explain all of the record: {self}; {wrong}; the intervals are "
                "widened according to the residuals, but not for errors that wrong parameters "
                "compensate",
            )
        if self.found < self.expected - MISFIT_STDS * self.std:
            return (
                f"{model} is nearer to the record than its noise allows: {self}; the covariance "
                "that the sensor states is too large, and so are the intervals",
            )
        return ()


def misfit_of_white(residuals: Array) -> Misfit:
    """Return the misfit of whitened residuals (n, 6) that are white for noise alone.

    This holds for a model that is driven by the logged commands.
    """
    return Misfit(float(np.mean(residuals**2)), 1.0, float(np.sqrt(2 / residuals.size)))


def coloured_score_covariance(residuals: Array, jacobian: Array, ok: NDArray[np.bool_]) -> Array:
    """Return the covariance (p, p) of J^T r from the autocorrelation of given residuals r.

    residuals (n, 6), jacobian (n, 6, p): rows of the good frames. ok (N,): marks of the good
    frames. Lost frames have no residual, and add nothing.
    """
    return score_covariance(spectral_density(residuals, ok), jacobian, ok)


def spectral_density(residuals: Array, ok: NDArray[np.bool_]) -> Array:
    """Return the spectral density (f, 6, 6) of residuals (n, 6) of the good frames, `ok` (N,)."""
    count = len(ok)
    rows = np.zeros((count, 6))
    rows[ok] = residuals
    length = _padded(count)
    spectrum = rfft(rows, length, axis=0)
    correlations = (
        irfft(spectrum[:, :, None] * spectrum[:, None, :].conj(), length, axis=0) / ok.sum()
    )
    lags = np.minimum(np.arange(length), length - np.arange(length))
    # A triangular window makes the sum positive semidefinite.
    window = np.maximum(1 - lags / (REACH * count), 0.0)
    return np.asarray(rfft(correlations * window[:, None, None], axis=0))


def score_covariance(density: Array, jacobian: Array, ok: NDArray[np.bool_]) -> Array:
    """Return the covariance (p, p) of J^T r for residuals of a spectral density (f, 6, 6)."""
    slopes = np.zeros((len(ok), *jacobian.shape[1:]))
    slopes[ok] = jacobian
    length = _padded(len(ok))
    spectrum = rfft(slopes, length, axis=0)
    weighted = np.einsum("fij,fjb->fib", density, spectrum)
    # Doubling accounts for the negative frequencies. Zero and the Nyquist frequency have none.
    weighted[1 : (length + 1) // 2] *= 2
    total = np.tensordot(spectrum.conj(), weighted, axes=([0, 1], [0, 1])).real / length
    return np.asarray((total + total.T) / 2, dtype=float)


def _padded(count: int) -> int:
    """Return the length of the transforms of a number of frames.

    Zero padding to twice the length makes the circular correlation a linear correlation.
    """
    return int(next_fast_len(2 * count, real=True))


LAGS = 10
"""Number of lags tested, in frames."""

SUSPICIOUS = 1e-4
"""P-value of the residuals below which the model counts as wrong."""


@dataclass(frozen=True)
class Whiteness:
    """Result of the test for whiteness.

    autocorrelations (6, lags): autocorrelations of the pose components. p_values (6,) and p_value:
    probability of correlations at least as large for noise alone, for each component and for all
    components together.
    """

    autocorrelations: Array
    p_values: Array
    p_value: float

    @property
    def suspicious(self) -> bool:
        """True if chance does not explain the correlations."""
        return self.p_value < SUSPICIOUS

    def warnings(self) -> tuple[str, ...]:
        """Return a warning if chance does not explain the correlations."""
        if not self.suspicious:
            return ()
        parts = ", ".join(f"{name} {p:.1g}" for name, p in zip(POSE, self.p_values, strict=True))
        return (
            "the residuals of the model, driven by the logged commands, are correlated from frame "
            f"to frame: for noise alone this has a probability of {self.p_value:.1g} (by "
            f"component {parts}); either this model of the robot is wrong, or the errors of the "
            "camera last for several frames",
        )


def whiteness(residuals: Array, ok: NDArray[np.bool_], lags: int = LAGS) -> Whiteness:
    """Test residuals (N, 6), in standard deviations, for whiteness.

    Frames where `ok` (N,) is False are missing and can be NaN. Raises EstimationError with fewer
    than ten good frames per lag.
    """
    if ok.sum() < 10 * lags:
        raise EstimationError(
            f"{ok.sum()} of {len(ok)} frames have a good pose, too few to test whether the model "
            f"explains them: {10 * lags} are needed for {lags} lags of the residuals"
        )
    centred = np.where(ok[:, None], residuals - residuals[ok].mean(axis=0), 0.0)
    power = np.sum(centred**2, axis=0)
    present = ok.astype(float)
    correlations = np.zeros((residuals.shape[1], lags))
    statistics = np.zeros(residuals.shape[1])
    count = float(ok.sum())
    for lag in range(1, lags + 1):
        pairs = float(present[lag:] @ present[:-lag])
        correlations[:, lag - 1] = np.sum(centred[lag:] * centred[:-lag], axis=0) / power
        # With gaps there are fewer pairs than n - k, so the number of pairs replaces n - k.
        statistics += (count + 2) * count * correlations[:, lag - 1] ** 2 / max(pairs, 1.0)
    together = float(chdtrc(lags * len(statistics), statistics.sum()))
    return Whiteness(correlations, np.asarray(chdtrc(lags, statistics)), together)


# Largest excess of the mean squared residual, as a fraction of its expected value, that needs no
# cause. The residual is that of the model under the logged commands. Errors of the teaching can
# cause such an excess if the teaching counts as exact, as in a log that cannot state these errors.
LITTLE = 0.1


def needs_cause(misfit: Misfit, driven_misfit: Misfit, suspicious: bool) -> bool:
    """Return whether a model misses its record by so much that a cause is worth asking for.

    driven_misfit: misfit under the logged commands. suspicious: True if the residuals under the
    logged commands are not white.
    """
    excess = driven_misfit.found - (1 + LITTLE) * driven_misfit.expected
    return misfit.significant or suspicious or excess > 0


@dataclass(frozen=True)
class Explanation:
    """Judgement of how well a model explains its records.

    misfit: misfit of the residuals of the estimate. driven_misfit and whiteness: tests of the
    residuals of the model that is driven by the logged commands.
    """

    misfit: Misfit
    driven_misfit: Misfit
    whiteness: Whiteness

    @property
    def hidden(self) -> bool:
        """True if the model's error dominates only under the logged commands."""
        return self.driven_misfit.decides and not self.misfit.decides

    @property
    def model_holds(self) -> bool:
        """True if no error of the model dominates either residual."""
        return not (self.misfit.decides or self.driven_misfit.decides)

    def warnings(self) -> tuple[str, ...]:
        """Return the warnings of the command-driven model that the misfit does not contain."""
        if not self.hidden:
            return self.whiteness.warnings()
        driven = self.driven_misfit.warnings("driven by the logged commands, the model")
        return (*driven, *self.whiteness.warnings())


def explanation(
    driven: OutputErrorProblem, parameters: Array, misfit: Misfit, rng: np.random.Generator
) -> Explanation:
    """Judge a model by the command-driven problem at its own optimal parameters (p,).

    misfit: misfit of the estimate. rng: generator for `white_residuals`. Raises EstimationError if
    there are too few good frames for `whiteness`.
    """
    residuals, ok = _residuals(driven, parameters, rng)
    return Explanation(misfit, misfit_of_white(residuals[ok]), whiteness(residuals, ok))


def _residuals(
    driven: OutputErrorProblem, parameters: Array, rng: np.random.Generator
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the whitened residuals (N, 6) of all records, and which frames (N,) are good."""
    runs = driven.runs
    residuals = [run.white_residuals(parameters, rng) for run in runs]
    return by_frames(residuals, [run.ok for run in runs])


def by_frames(
    residuals: Sequence[Array], frames: Sequence[NDArray[np.bool_]]
) -> tuple[Array, NDArray[np.bool_]]:
    """Return residuals (N, 6) of several records one after the other, and the good frames (N,).

    residuals: residuals (n, 6) of each record at its good frames. frames: marks of the good frames
    of each record. In the result, residuals of lost poses are NaN. After each record, as many lost
    poses are inserted as the test for whiteness has lags, so that no lag joins two records.
    """
    gap = np.full((LAGS, 6), np.nan)
    parts = []
    good = []
    for own, ok in zip(residuals, frames, strict=True):
        rows = np.full((len(ok), 6), np.nan)
        rows[ok] = own
        parts += [rows, gap]
        good += [ok, np.zeros(LAGS, dtype=bool)]
    return np.concatenate(parts), np.concatenate(good)
