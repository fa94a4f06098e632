"""Tests of whether the model explains its records, by the size and the whiteness of its residuals.

With the right model the mean squared whitened residual is what noise makes of it, but for chance.
Where it is larger than chance allows, the rest, the misfit, is an error of the model. Unlike noise
it lasts from frame to frame, and moves an estimate further than white residuals of the same size
would. Scaling the covariance by the residual (Birge's ratio) is therefore not enough. The scores
J^T r of stationary residuals with the autocorrelation R_k have the covariance

    sum over frames i, j of J_i^T R_(i-j) J_j

(Morelli and Klein, "Accuracy of aerodynamic model parameters estimated from flight test data", J.
Guidance, Control, and Dynamics 20(1), 1997), with R_k from the residuals themselves. The model's
share is added to what the noise makes. No residual shows the part of an error that the parameters
take up. Where the model's error makes most of the residual, no interval can be trusted, and nothing
counts as identified.

A model driven by the logged commands feels everything that the plant felt. With the right model its
residuals are the sensor's noise, independent from frame to frame. The portmanteau test of Ljung and
Box tells whether their autocorrelations r_k could be chance: n (n + 2) sum_k r_k² / (n - k) over
the lags k = 1 ... L is chi-square with L degrees of freedom. A model that closes its own loop
cannot follow what the noise did to the plant. Its residuals are coloured even if it is right, and
are not tested.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import chdtrc, ndtri

from identify.arrays import Array
from identify.errors import EstimationError
from identify.estimation.output_error import OutputErrorProblem
from identify.files.dataset import POSE

SIGNIFICANT = float(ndtri(0.999))
"""Standard deviations above the expected residual from which on the rest is an error of the model.
"""

MISFIT_STDS = 5.0
"""Standard deviations below the expected residual from which on the stated covariance is wrong."""

NOISE_DECIDES = 3.0
"""Ratio of the residual to the expected one above which the model's error decides."""

REACH = 0.2
"""Lag after which residuals are taken as independent, as a share of a record's length.

Up to there correlations fade out.
"""

MISFIT = ("noise_ratio", "expected_noise_ratio", "noise_ratio_std")
"""Entries of a result that hold a `Misfit`, in its order."""


@dataclass(frozen=True)
class Misfit:
    """Mean squared whitened residual of a record, and what noise alone would make of it.

    std: spread of the expected value from one experiment to the next.
    """

    found: float
    expected: float
    std: float

    def __str__(self) -> str:
        return (
            f"the mean squared residual is {self.found:.3f} times the variance that the sensor "
            f"states, where noise alone would make it {self.expected:.3f} ± {self.std:.3f}"
        )

    @property
    def significant(self) -> bool:
        """True if the model misses the record by more than chance explains."""
        return self.found > self.expected + SIGNIFICANT * self.std

    @property
    def share_of_model(self) -> float:
        """Share of the model's error in the residual's variance, zero where it may be chance."""
        return 1 - self.expected / self.found if self.significant else 0.0

    @property
    def decides(self) -> bool:
        """True if the model's error makes most of the residual."""
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
                "widened by what the residuals show, but cannot know of errors that the parameters "
                "have taken up",
            )
        if self.found < self.expected - MISFIT_STDS * self.std:
            return (
                f"{model} is nearer to the record than its noise allows: {self}; the covariance "
                "that the sensor states is too large, and so are the intervals",
            )
        return ()


def misfit_of_white(residuals: Array) -> Misfit:
    """Return the misfit of whitened residuals (n, 6) that noise alone would leave white.

    Such are those of a model that is driven by the logged commands.
    """
    return Misfit(float(np.mean(residuals**2)), 1.0, float(np.sqrt(2 / residuals.size)))


def coloured_score_covariance(residuals: Array, jacobian: Array, ok: NDArray[np.bool_]) -> Array:
    """Return the covariance (p, p) of J^T r for residuals r as correlated as those found.

    residuals (n, 6) and jacobian (n, 6, p) are of the good frames, `ok` (N,). Frames between them
    have no residual, and add nothing.
    """
    count = len(ok)
    size = jacobian.shape[2]
    rows = np.zeros((count, 6))
    slopes = np.zeros((count, 6, size))
    rows[ok] = residuals
    slopes[ok] = jacobian
    # twice as long, so that the circular correlation is the linear one
    length = next_fast_len(2 * count, real=True)
    spectrum = rfft(rows, length, axis=0)
    correlations = (
        irfft(spectrum[:, :, None] * spectrum[:, None, :].conj(), length, axis=0) / ok.sum()
    )
    lags = np.minimum(np.arange(length), length - np.arange(length))
    # a triangular window keeps the sum positive semidefinite
    fading = np.maximum(1 - lags / (REACH * count), 0.0)
    density = rfft(correlations * fading[:, None, None], axis=0)
    seen = rfft(slopes, length, axis=0)
    weighted = np.einsum("fij,fjb->fib", density, seen)
    # the negative frequencies, which zero and Nyquist do not have
    weighted[1 : (length + 1) // 2] *= 2
    total = np.tensordot(seen.conj(), weighted, axes=([0, 1], [0, 1])).real / length
    return np.asarray((total + total.T) / 2, dtype=float)


LAGS = 10
"""Number of lags tested, in frames."""

SUSPICIOUS = 1e-4
"""Probability of the residuals under the model below which the model is called wrong."""


@dataclass(frozen=True)
class Whiteness:
    """Result of the test for whiteness.

    autocorrelations (6, lags): those of the pose components. p_values (6,) and p_value, of each
    component and of all together: probability of correlations at least as large if only noise
    remains.
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
            "the model, driven by the logged commands, leaves residuals that follow each other "
            f"from frame to frame: noise would do so with a probability of {self.p_value:.1g} (by "
            f"component {parts}); either this model of the robot is wrong, or the errors of the "
            "camera last for several frames",
        )


def whiteness(residuals: Array, ok: NDArray[np.bool_], lags: int = LAGS) -> Whiteness:
    """Test residuals (N, 6), in standard deviations, for whiteness.

    Frames where `ok` (N,) is False are missing and may be NaN. Raises EstimationError with fewer
    than ten good frames a lag.
    """
    if ok.sum() < 10 * lags:
        raise EstimationError(
            f"{ok.sum()} good frames are too few to test {lags} lags, {10 * lags} are needed"
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
        # Gaps leave fewer pairs than n - k; their number stands for it in the variance of r_k.
        statistics += (count + 2) * count * correlations[:, lag - 1] ** 2 / max(pairs, 1.0)
    together = float(chdtrc(lags * len(statistics), statistics.sum()))
    return Whiteness(correlations, np.asarray(chdtrc(lags, statistics)), together)


@dataclass(frozen=True)
class Explanation:
    """Judgement of how well a model explains its records.

    misfit is that of the estimate's own residuals. driven_misfit and whiteness are those of the
    model that the logged commands drive, which feels what the sensor's noise did to the plant.
    """

    misfit: Misfit
    driven_misfit: Misfit
    whiteness: Whiteness

    @property
    def hidden(self) -> bool:
        """True if the closed loop hides an error that the model shows under the logged commands."""
        return self.driven_misfit.decides and not self.misfit.decides

    @property
    def model_holds(self) -> bool:
        """True if an error of the model makes most of neither residual."""
        return not (self.misfit.decides or self.driven_misfit.decides)

    def warnings(self) -> tuple[str, ...]:
        """Return what the command-driven residuals say beyond the misfit of the estimate's own."""
        if not self.hidden:
            return self.whiteness.warnings()
        driven = self.driven_misfit.warnings("driven by the logged commands, the model")
        return (*driven, *self.whiteness.warnings())


def explanation(
    driven: OutputErrorProblem, parameters: Array, misfit: Misfit, rng: np.random.Generator
) -> Explanation:
    """Judge a model from the command-driven problem at its own optimum (p,).

    misfit: that of the estimate. rng: draws what a fit has taken out of the residuals. Raises
    EstimationError with too few good frames.
    """
    residuals, ok = _residuals(driven, parameters, rng)
    return Explanation(misfit, misfit_of_white(residuals[ok]), whiteness(residuals, ok))


def _residuals(
    driven: OutputErrorProblem, parameters: Array, rng: np.random.Generator
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the whitened residuals (N, 6) of all records, and which frames (N,) are good.

    Residuals are NaN where the pose was lost. The records follow each other with a gap of all lags
    of the test for whiteness between them.
    """
    gap = np.full((LAGS, 6), np.nan)
    residuals = []
    ok = []
    for run in driven.runs:
        rows = np.full(run.measured.shape, np.nan)
        rows[run.ok] = run.white_misses(parameters, rng)
        residuals += [rows, gap]
        ok += [run.ok, np.zeros(LAGS, dtype=bool)]
    return np.concatenate(residuals), np.concatenate(ok)
