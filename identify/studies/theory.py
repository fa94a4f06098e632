"""Whether a study's rows follow the laws that it states: the measured exponent or ratio with its interval.

A law fails when the interval excludes what the law says, give or take its own tolerance. Else it passes, unless the
rows are too few to say anything: it is undecided where the interval is wide. At 99 % one true law in a hundred fails by
chance.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from identify.arrays import Array
from identify.errors import StudyError
from identify.studies.law import Law
from identify.studies.scale_regression import ScaleRegression, scale_regression
from identify.studies.study_file import Study

CONFIDENCE = 0.99
RESOLUTION = 0.2
"""Half-width of the interval, of an exponent or of the logarithm of a ratio, beyond which a law is not decided."""


@dataclass(frozen=True)
class Verdict:
    """What the rows say about a law: verdict "passed", "failed" or "undecided".

    statement in words; expected, as an exponent or a ratio, in words; measured with its interval low to high; rows that
    counted; reason where nothing could be measured.
    """

    statement: str
    why: str
    verdict: str
    expected: str
    measured: float | None = None
    low: float | None = None
    high: float | None = None
    rows: int = 0
    reason: str = ""

    @property
    def text(self) -> str:
        """One line with the numbers."""
        if self.measured is None:
            return f"{self.verdict}: {self.statement}; {self.reason}"
        interval = f"{self.measured:.4g} ({self.low:.4g} to {self.high:.4g}, {CONFIDENCE:.0%})"
        return f"{self.verdict}: {self.statement}; measured {interval}"


def check_laws(study: Study, frame: pd.DataFrame) -> list[Verdict]:
    """A verdict for each law of a study; `frame`: its table, of which rows that failed do not count."""
    done = frame[frame["error"] == ""]
    return [_check(law, study, done) for law in study.theory]


def with_data(law: Law, frame: pd.DataFrame) -> pd.DataFrame:
    """The rows that have all figures of a law. Raises StudyError where none has one of them, with what they have."""
    needed = [name for name in (law.figure, law.per, law.equals) if name is not None]
    for name in needed:
        if name not in frame.columns:
            raise StudyError(f"the rows have no figure {name!r}; they have {', '.join(map(str, frame.columns))}")
    return frame.dropna(subset=needed)


def law_data(law: Law, frame: pd.DataFrame) -> Array:
    """The quantity of a law (n,) in each row, all of which have it. Raises StudyError where it is divided by zero."""
    values = frame[law.figure].to_numpy(dtype=float)
    return values if law.per is None else values / _divisor(law.per, frame)


def _divisor(name: str, frame: pd.DataFrame) -> Array:
    values = frame[name].to_numpy(dtype=float)
    if zeros := int(np.sum(values == 0.0)):
        raise StudyError(f"{name} is zero in {zeros} of {len(values)} rows, and nothing can be divided by it")
    return values


def _check(law: Law, study: Study, frame: pd.DataFrame) -> Verdict:
    check = _exponent if law.exponent is not None else _equality if law.equals is not None else _order
    try:
        return check(law, study, with_data(law, frame))
    except StudyError as error:
        return Verdict(_statement(law), law.why, "undecided", _expected(law), reason=str(error))


def _exponent(law: Law, study: Study, frame: pd.DataFrame) -> Verdict:
    """The figure's mean square as factor ** (2 exponent), beside the other factors."""
    factor = _numeric(str(law.factor), frame)
    design = np.column_stack([_beside(law, study, frame), 2.0 * np.log(factor)])
    fit = scale_regression(law_data(law, frame) ** 2, design)
    low, high = fit.interval(design.shape[1] - 1, CONFIDENCE)
    expected, half = float(law.exponent or 0.0), 0.5 * (high - low)
    verdict = _decided(low - law.tolerance <= expected <= high + law.tolerance, half)
    return _verdict(law, verdict, float(fit.coefficients[-1]), low, high, len(frame))


def _equality(law: Law, study: Study, frame: pd.DataFrame) -> Verdict:
    """The ratio of two figures of the same rows."""
    ratios = law_data(law, frame) / _divisor(str(law.equals), frame)
    fit = scale_regression(ratios**2, np.full((len(frame), 1), 2.0))
    low, high = fit.interval(0, CONFIDENCE)
    verdict = _decided(low <= law.tolerance and high >= -law.tolerance, 0.5 * (high - low))
    measured, low, high = np.exp([fit.coefficients[0], low, high]).tolist()
    return _verdict(law, verdict, measured, low, high, len(frame))


def _order(law: Law, study: Study, frame: pd.DataFrame) -> Verdict:
    """The smallest step of the logarithm from one value of the factor to the next, beside the other factors."""
    if law.factor not in frame.columns:
        raise StudyError(f"the rows have no factor {law.factor!r}")
    values = list(law.order or [])
    chosen = frame[frame[law.factor].isin(values)]
    place = chosen[law.factor].map(values.index).to_numpy(dtype=float)
    steps = np.column_stack([2.0 * (place >= k) for k in range(1, len(values))])
    fit = scale_regression(law_data(law, chosen) ** 2, np.column_stack([_beside(law, study, chosen), steps]))
    low, middle, high = _smallest_step(fit, len(values) - 1)
    verdict = "passed" if low > -law.tolerance else "failed" if high < -law.tolerance else "undecided"
    measured, low, high = np.exp([middle, low, high]).tolist()
    return _verdict(law, verdict, measured, low, high, len(chosen))


def _smallest_step(fit: ScaleRegression, steps: int) -> tuple[float, float, float]:
    """Of the last coefficients, that which is the least certainly positive: low, middle, high."""
    places = range(len(fit.coefficients) - steps, len(fit.coefficients))
    low, k = min((fit.interval(k, CONFIDENCE)[0], k) for k in places)
    return low, float(fit.coefficients[k]), fit.interval(k, CONFIDENCE)[1]


def _beside(law: Law, study: Study, frame: pd.DataFrame) -> Array:
    """Columns for what else varies: a level for each setting of the other factors, or their logarithms in a sample."""
    if law.factor not in study.factors and len(study.factors) > 1:
        raise StudyError(f"a law against the figure {law.factor!r} needs a study of one factor")
    others = [path for path in study.factors if path != law.factor and law.factor in study.factors]
    if not others:
        return np.ones((len(frame), 1))
    if study.sample is None:
        setting = frame.groupby(others, sort=False).ngroup().to_numpy()
        return np.eye(int(setting.max(initial=0)) + 1)[setting]
    return np.column_stack([np.ones(len(frame)), *(_covariates(frame[path]) for path in others)])


def _covariates(values: pd.Series) -> Array:
    """Columns (n, k) of another factor of a sample: its logarithm, or one for each value but the first."""
    if pd.api.types.is_numeric_dtype(values) and (values > 0).all():
        return np.log(values.to_numpy(dtype=float))[:, None]
    return np.asarray(pd.get_dummies(values, drop_first=True), dtype=float)


def _numeric(name: str, frame: pd.DataFrame) -> Array:
    """Values (n,) of a factor or figure, all positive."""
    if name not in frame.columns:
        raise StudyError(f"the rows have no factor or figure {name!r}")
    values = pd.to_numeric(frame[name], errors="coerce").to_numpy(dtype=float)
    if not np.all(values > 0.0):
        raise StudyError(f"a power of {name} needs positive numbers")
    return values


def _decided(holds: bool, half: float) -> str:
    if not holds:
        return "failed"
    return "passed" if half <= RESOLUTION else "undecided"


def _verdict(law: Law, verdict: str, measured: float, low: float, high: float, rows: int) -> Verdict:
    return Verdict(_statement(law), law.why, verdict, _expected(law), measured, low, high, rows)


def _statement(law: Law) -> str:
    if law.equals is not None:
        return f"{law.quantity} = {law.equals}"
    if law.order is not None:
        return f"{law.quantity} grows along {law.factor} = {', '.join(map(str, law.order))}"
    return f"{law.quantity} ~ {law.factor} ^ {law.exponent:g}"


def _expected(law: Law) -> str:
    if law.order is not None:
        return "ratio > 1"
    value = "ratio 1" if law.exponent is None else f"{law.exponent:g}"
    return f"{value} ± {law.tolerance:g}" if law.tolerance else value


def as_entry(verdict: Verdict) -> dict[str, Any]:
    """A verdict as `summary.json` holds it."""
    return dict(vars(verdict))
