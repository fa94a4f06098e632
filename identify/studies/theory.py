"""Comparison of a study's rows with the study's laws, by a measured exponent or ratio.

A log-linear regression estimates how the mean square of a figure y depends on other quantities. The
mean square is modelled as exp(X beta). The estimate solves X^T (y^2 / mean - 1) = 0, the score
equation of a gamma-distributed y^2 with logarithmic link (McCullagh and Nelder 1989, section 8.3).
The result is the scaling of the mean square itself, for any distribution of the figure. A straight
line through logarithms would not give this scaling. The covariance is a sandwich estimate, which
holds even if the figure's distribution differs from row to row.

The figures of one point of a study have 95 % bands. The band of the mean is Student's interval. The
band of the rms is Student's interval of the logarithm of the mean square. A chi-square band would
need the number of independent errors in a row's figure, while this band uses the scatter of the
figure over the rows. In simulations with two or more rows, the band contained the true rms in 95 to
97 % of cases if the figures were the rms of three or more normal numbers. In the worst case, single
normal numbers, it did so in at least 92 %. A single row has no band.

A law states an exponent or a ratio, with a tolerance. The law fails if no value within the
tolerance lies in the 99 % interval of the measured value. Otherwise the law passes if the interval
is narrow. If the interval is wide, there are too few rows, and the law is undecided. One true law
in a hundred fails by chance. A law of order passes as soon as its interval excludes every decrease
beyond the tolerance, however wide the interval is.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import stdtrit

from identify.arrays import Array
from identify.errors import StudyError
from identify.studies.study_file import Law, Study

ITERATIONS = 100  # largest number of steps of the fit
STEP_TOLERANCE = 1e-10  # the fit ends before a step that changes all logarithms by less than this
SMALLEST = 1e-12  # smallest square at the start of the fit, as a fraction of the largest one


@dataclass(frozen=True)
class ScaleRegression:
    """Fit of the logarithm of a mean square.

    coefficients (k,)  Coefficients beta.
    covariance (k, k)  Covariance of the coefficients.
    freedom            Degrees of freedom.
    """

    coefficients: Array
    covariance: Array
    freedom: int

    def interval(self, index: int, confidence: float) -> tuple[float, float]:
        """Return Student's interval of one coefficient."""
        half = reach(confidence, self.freedom) * np.sqrt(self.covariance[index, index])
        return float(self.coefficients[index] - half), float(self.coefficients[index] + half)


def reach(confidence: float, freedom: int) -> float:
    """Return the half-width of Student's interval in standard deviations.

    `scipy.stats.t.interval` would return NaN for a standard deviation of zero.
    """
    return float(stdtrit(freedom, 0.5 + 0.5 * confidence))


def scale_regression(squares: Array, design: Array) -> ScaleRegression:
    """Fit exp(design (n, k) @ beta) to non-negative squares (n,).

    Raises StudyError if there are too few rows, the columns of the design are linearly dependent,
    the figure is zero in every row, or the fit does not converge.
    """
    rows, columns = design.shape
    if rows <= columns:
        raise StudyError(f"{rows} rows do not determine {columns} coefficients with an interval")
    if np.linalg.matrix_rank(design) < columns:
        raise StudyError("the factors do not vary, or not independently of each other")
    if not squares.max() > 0.0:
        raise StudyError("the figure is zero in every row")
    beta = np.linalg.lstsq(
        design, np.log(np.maximum(squares, SMALLEST * squares.max())), rcond=None
    )[0]
    for _ in range(ITERATIONS):
        ratio = squares / np.exp(design @ beta)
        step = np.linalg.lstsq(design, ratio - 1.0, rcond=None)[0]
        change = float(np.abs(design @ step).max())
        if change < STEP_TOLERANCE:
            break
        # To avoid divergence, a step changes no mean square by more than a factor of e.
        beta = beta + step / max(1.0, change)
    else:
        raise StudyError(f"the fit of the scale has not converged after {ITERATIONS} steps")
    return ScaleRegression(
        beta, _sandwich(design, squares / np.exp(design @ beta) - 1.0), rows - columns
    )


def _sandwich(design: Array, residuals: Array) -> Array:
    """Return the sandwich estimate (k, k) of the covariance of the coefficients.

    Residuals are enlarged according to their leverage (HC3), because rows can be few.
    """
    bread = np.linalg.inv(design.T @ design)
    leverage = np.einsum("ni,ij,nj->n", design, bread, design)
    # A row that alone determines a coefficient has leverage 1, which would divide by zero.
    scores = design * (residuals / np.maximum(1.0 - leverage, 1e-6))[:, None]
    return np.asarray(bread @ (scores.T @ scores) @ bread, dtype=float)


BAND_CONFIDENCE = 0.95  # confidence of the bands of a mean and an rms


@dataclass(frozen=True)
class Statistics:
    """Statistics of a figure over rows; `std` and the bands are None for a single row.

    Attributes
    ----------
    rows : int
        Number of rows.
    mean : float
        Mean.
    std : float or None
        Standard deviation with divisor n - 1.
    rms : float
        Root mean square.
    mean_band, rms_band : tuple of float or None
        Ends of the bands of mean and rms.
    """

    rows: int
    mean: float
    std: float | None
    rms: float
    mean_band: tuple[float, float] | None
    rms_band: tuple[float, float] | None


def point_statistics(values: Array) -> Statistics:
    """Return the statistics of one figure's values (n,), n >= 1, all finite."""
    count = len(values)
    mean = float(np.mean(values))
    rms = float(np.sqrt(np.mean(values**2)))
    if count < 2:
        return Statistics(count, mean, None, rms, None, None)
    std = float(np.std(values, ddof=1))
    quantile = reach(BAND_CONFIDENCE, count - 1)
    half = quantile * std / np.sqrt(count)
    # Standard error of the logarithm of the mean square.
    log_error = (
        float(np.linalg.norm(values**2 / np.mean(values**2) - 1.0)) / (count - 1) if rms else 0.0
    )
    factor = float(np.exp(0.5 * quantile * log_error))
    return Statistics(
        count, mean, std, rms, (mean - half, mean + half), (rms / factor, rms * factor)
    )


CONFIDENCE = 0.99  # confidence of the interval of a measured exponent or ratio
# Largest half-width of an interval with which a law of an exponent or of equality passes. The
# interval is of the exponent, or of the logarithm of the ratio.
RESOLUTION = 0.2


@dataclass(frozen=True)
class Verdict:
    """Result of the comparison of rows with a law.

    law        The law.
    verdict    "passed", "failed" or "undecided".
    measured   Measured exponent or ratio, None if nothing could be measured.
    low, high  Ends of the interval of the measured value, or None.
    rows       Number of rows used.
    reason     Reason why nothing could be measured.
    """

    law: Law
    verdict: str
    measured: float | None = None
    low: float | None = None
    high: float | None = None
    rows: int = 0
    reason: str = ""

    @property
    def entry(self) -> dict[str, Any]:
        """Entry of `summary.json` for this verdict."""
        law = {"statement": self.law.statement, "why": self.law.why, "verdict": self.verdict}
        return (
            law
            | {"expected": self.law.expected}
            | {name: value for name, value in vars(self).items() if name not in ("law", "verdict")}
        )


def check_laws(study: Study, frame: pd.DataFrame) -> list[Verdict]:
    """Return a verdict for each law of a study. Failed rows of its table are excluded."""
    done = frame[frame["error"] == ""]
    return [_check(law, study, done) for law in study.theory]


def rows_with_figures(law: Law, frame: pd.DataFrame) -> pd.DataFrame:
    """Return the rows that have all figures of a law.

    Raises StudyError if no row has one of these figures. The message names the existing figures.
    """
    needed = [name for name in (law.figure, law.per, law.equals) if name is not None]
    for name in needed:
        if name not in frame.columns:
            known = ", ".join(map(str, frame.columns)) if len(frame) else "none, as all rows failed"
            raise StudyError(f"the rows have no figure {name!r}; they have {known}")
    return frame.dropna(subset=needed)


def law_data(law: Law, frame: pd.DataFrame) -> Array:
    """Return the quantity of a law (n,) in rows that have all its figures.

    Raises StudyError if the divisor is zero in a row.
    """
    values = frame[law.figure].to_numpy(dtype=float)
    return values if law.per is None else values / _divisor(law.per, frame)


def _divisor(name: str, frame: pd.DataFrame) -> Array:
    values = frame[name].to_numpy(dtype=float)
    if zeros := int(np.sum(values == 0.0)):
        raise StudyError(
            f"{name} is zero in {zeros} of {len(values)} rows, but the law divides by it"
        )
    return values


def _check(law: Law, study: Study, frame: pd.DataFrame) -> Verdict:
    if law.exponent is not None:
        check = _exponent
    elif law.equals is not None:
        check = _equality
    else:
        check = _order
    try:
        return check(law, study, rows_with_figures(law, frame))
    except StudyError as error:
        return Verdict(law, "undecided", reason=str(error))


def _exponent(law: Law, study: Study, frame: pd.DataFrame) -> Verdict:
    """Test whether the figure's mean square is proportional to factor ** (2 exponent)."""
    factor = _numeric(str(law.factor), frame)
    _check_varied(law, frame)
    design = np.column_stack([_other_columns(law, study, frame), 2.0 * np.log(factor)])
    fit = scale_regression(law_data(law, frame) ** 2, design)
    low, high = fit.interval(design.shape[1] - 1, CONFIDENCE)
    expected = float(law.exponent or 0.0)
    half = 0.5 * (high - low)
    verdict = _verdict(low - law.tolerance <= expected <= high + law.tolerance, half)
    return Verdict(law, verdict, float(fit.coefficients[-1]), low, high, len(frame))


def _equality(law: Law, study: Study, frame: pd.DataFrame) -> Verdict:
    """Test whether two figures of the same rows are equal, by their ratio."""
    ratios = law_data(law, frame) / _divisor(str(law.equals), frame)
    fit = scale_regression(ratios**2, np.full((len(frame), 1), 2.0))
    low, high = fit.interval(0, CONFIDENCE)
    verdict = _verdict(low <= law.tolerance and high >= -law.tolerance, 0.5 * (high - low))
    measured, low, high = np.exp([fit.coefficients[0], low, high]).tolist()
    return Verdict(law, verdict, measured, low, high, len(frame))


def _order(law: Law, study: Study, frame: pd.DataFrame) -> Verdict:
    """Test by the smallest ratio of neighbours whether the figure grows along the factor."""
    if law.factor not in frame.columns:
        raise StudyError(f"the rows have no factor {law.factor!r}")
    values = list(law.order or [])
    chosen = frame[frame[law.factor].isin(values)]
    _check_varied(law, chosen)
    rank = chosen[law.factor].map(values.index).to_numpy(dtype=float)
    steps = np.column_stack([2.0 * (rank >= k) for k in range(1, len(values))])
    fit = scale_regression(
        law_data(law, chosen) ** 2, np.column_stack([_other_columns(law, study, chosen), steps])
    )
    low, middle, high = _smallest_step(fit, len(values) - 1)
    verdict = (
        "passed" if low > -law.tolerance else "failed" if high < -law.tolerance else "undecided"
    )
    measured, low, high = np.exp([middle, low, high]).tolist()
    return Verdict(law, verdict, measured, low, high, len(chosen))


def _smallest_step(fit: ScaleRegression, steps: int) -> tuple[float, float, float]:
    """Return the interval of one of the last `steps` coefficients: low end, estimate and high end.

    The interval with the lowest low end is chosen.
    """
    indices = range(len(fit.coefficients) - steps, len(fit.coefficients))
    low, k = min((fit.interval(k, CONFIDENCE)[0], k) for k in indices)
    return low, float(fit.coefficients[k]), fit.interval(k, CONFIDENCE)[1]


def _other_columns(law: Law, study: Study, frame: pd.DataFrame) -> Array:
    """Return the columns of the design for all factors but the law's.

    For a grid they are an indicator for each setting of these factors. For a sample they are a
    constant, and the covariates of each of these factors.
    """
    others = [path for path in study.factors if path != law.factor and law.factor in study.factors]
    if not others:
        return np.ones((len(frame), 1))
    if study.sample is None:
        setting = frame.groupby(others, sort=False).ngroup().to_numpy()
        return np.eye(int(setting.max(initial=0)) + 1)[setting]
    return np.column_stack([np.ones(len(frame)), *(_covariates(frame[path]) for path in others)])


def _covariates(values: pd.Series) -> Array:
    """Return the covariates (n, k) of a factor of a sample, other than the factor of the law.

    Covariates are the logarithm of the factor, or an indicator of each value except the first.
    """
    if pd.api.types.is_numeric_dtype(values) and (values > 0).all():
        return np.log(values.to_numpy(dtype=float))[:, None]
    return np.asarray(pd.get_dummies(values, drop_first=True), dtype=float)


def _numeric(name: str, frame: pd.DataFrame) -> Array:
    """Return the values (n,) of a factor or figure. Raises StudyError unless all are positive."""
    if name not in frame.columns:
        raise StudyError(f"the rows have no factor or figure {name!r}")
    values = pd.to_numeric(frame[name], errors="coerce").to_numpy(dtype=float)
    if not np.all(values > 0.0):
        raise StudyError(f"a power of {name} needs positive numbers")
    return values


def _check_varied(law: Law, frame: pd.DataFrame) -> None:
    """Raise StudyError if the factor of a law has one value in all rows."""
    values = frame[law.factor].unique()
    if len(values) == 1:
        raise StudyError(
            f"{law.factor} has one value, {values[0]}, in all rows, but the law needs two or more"
        )


def _verdict(holds: bool, half: float) -> str:
    if not holds:
        return "failed"
    return "passed" if half <= RESOLUTION else "undecided"
