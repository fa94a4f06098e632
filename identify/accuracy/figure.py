"""A figure of accuracy, a value or a mean with its interval beside its limit, and what records it in a test.

Imported at every start of pytest: NumPy and SciPy are imported when a test records something.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from math import isfinite
from typing import TYPE_CHECKING, Any, Literal, get_args

import pytest

from identify.errors import IdentifyError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import ArrayLike, NDArray

Better = Literal["lower", "higher"]
BETTER: tuple[str, ...] = get_args(Better)
PROPERTY = "cmmsim_accuracy"
"""Name of the user properties that carry figures in the reports of tests."""

CONFIDENCE = 0.95
"""Probability with which the interval of a sample holds the true mean."""


class AccuracyError(IdentifyError):
    """A figure that is none, or a file of figures that cannot be read or written."""


@dataclass(frozen=True)
class Figure:
    """What one test recorded under one name.

    test: node id of the test; value, in `unit`: the recorded one, or the mean of `count` values with its `interval`
    (low, high); better: the direction of progress; limit: the largest value that is good enough, or the smallest where
    higher is better, or None.
    """

    test: str
    name: str
    value: float
    unit: str
    better: Better
    limit: float | None = None
    interval: tuple[float, float] | None = None
    count: int = 1

    @property
    def key(self) -> tuple[str, str]:
        """Test and name: what tells this figure from all others of a session."""
        return self.test, self.name

    @property
    def sign(self) -> int:
        """+1 where a larger value is worse, -1 where it is better."""
        return 1 if self.better == "lower" else -1

    @property
    def best(self) -> float:
        """The end of the interval on the good side; the value where there is no interval."""
        return self._end(-self.sign)

    @property
    def worst(self) -> float:
        """The end of the interval on the bad side; the value where there is no interval."""
        return self._end(self.sign)

    @property
    def beyond_limit(self) -> bool:
        """Whether the value, or the whole interval, lies on the bad side of the limit."""
        return self.limit is not None and self.sign * (self.best - self.limit) > 0

    @property
    def undecided(self) -> bool:
        """Whether the interval holds the limit: good enough or not, the sample does not tell."""
        return self.limit is not None and not self.beyond_limit and self.sign * (self.worst - self.limit) > 0

    @property
    def limit_text(self) -> str:
        """The limit behind its relation, without a unit; nothing where there is none."""
        return "" if self.limit is None else f"{'≤' if self.better == 'lower' else '≥'} {self.limit:.4g}"

    @property
    def margin(self) -> float | None:
        """Distance of the value from the limit as a share of the limit, negative beyond it; None without a limit."""
        return self.sign * (self.limit - self.value) / abs(self.limit) if self.limit else None

    @property
    def verdict(self) -> str:
        """One line: name, value, unit, interval and limit."""
        side = "above" if self.better == "lower" else "below"
        limit = f"the limit of {with_unit(f'{self.limit:.6g}', self.unit)}"
        if self.interval is None:
            return f"{self.name}: {with_unit(f'{self.value:.6g}', self.unit)} is {side} {limit}"
        low, high = self.interval
        interval = with_unit(f"[{low:.6g}, {high:.6g}]", self.unit)
        return (
            f"{self.name}: mean {with_unit(f'{self.value:.6g}', self.unit)} of {self.count} values, "
            f"{CONFIDENCE:.0%} interval {interval}, lies wholly {side} {limit}"
        )

    def _end(self, side: int) -> float:
        if self.interval is None:
            return self.value
        return self.interval[1] if side > 0 else self.interval[0]


def with_unit(text: str, unit: str) -> str:
    """A number's text with its unit behind it."""
    return f"{text} {unit}".rstrip()


def percent(share: float, form: str) -> str:
    """A share in per cent, its number in a form such as ".0" or "+.1"; a hundredfold or more by its power of ten."""
    return f"{share:{form}%}" if abs(share) < 100 else f"{100 * share:{form}e}%"


class Accuracy:
    """Records figures of accuracy of one test; get it from the fixture `accuracy`.

    A figure beyond its limit fails the test at the call. Raises AccuracyError for what is no figure: a value that is
    not a finite number, an empty sample, a name that this test has recorded already.
    """

    def __init__(self, test: str, properties: list[tuple[str, object]]) -> None:
        self._test, self._properties = test, properties
        self._names: set[str] = set()

    def record(
        self, name: str, value: ArrayLike, unit: str = "", limit: float | None = None, better: Better = "lower"
    ) -> None:
        """Record one number. It fails the test when it is above the limit (below it, where better="higher")."""
        __tracebackhide__ = True
        number = float(_numbers(name, "value", value, dimensions=0))
        self._keep(name, unit, limit, better, value=number)

    def sample(
        self, name: str, values: ArrayLike, unit: str = "", limit: float | None = None, better: Better = "lower"
    ) -> None:
        """Record the mean of independent values (n,), n >= 2, with Student's 95 % interval.

        It fails the test only when the whole interval is beyond the limit.
        """
        __tracebackhide__ = True
        numbers = _numbers(name, "values", values, dimensions=1)
        if len(numbers) < 2:
            raise AccuracyError(f"{name}: a sample needs at least 2 values, got {len(numbers)}")
        mean, (low, high) = mean_interval(numbers)
        if not (isfinite(low) and isfinite(high)):
            raise AccuracyError(f"{name}: the interval of the mean is {low:.4g} .. {high:.4g}, not finite")
        self._keep(name, unit, limit, better, value=mean, interval=(low, high), count=len(numbers))

    def _keep(self, name: str, unit: str, limit: float | None, better: Better, **found: Any) -> None:
        __tracebackhide__ = True
        for what, text in (("name", name), ("unit", unit)):
            if not isinstance(text, str) or (what == "name" and not text.strip()) or "\n" in text:
                raise AccuracyError(f"the {what} of a figure is a line of text, got {text!r}")
        if better not in BETTER:
            raise AccuracyError(f"{name}: better is {better!r}, must be {' or '.join(map(repr, BETTER))}")
        if name in self._names:
            raise AccuracyError(f"{name}: recorded already in this test")
        checked = None if limit is None else float(_numbers(name, "limit", limit, dimensions=0))
        figure = Figure(self._test, name, unit=unit, better=better, limit=checked, **found)
        self._names.add(name)
        self._properties.append((PROPERTY, asdict(figure)))
        if figure.beyond_limit:
            pytest.fail(figure.verdict)


def mean_interval(values: NDArray[np.float64]) -> tuple[float, tuple[float, float]]:
    """Mean of values (n,), n >= 2, and the interval that holds the true mean with probability CONFIDENCE.

    An end beyond the largest float is infinite.
    """
    import numpy as np
    from scipy.special import stdtrit

    count, (_, exponent) = len(values), np.frexp(np.abs(values).max())
    scaled = np.ldexp(values, -exponent)  # exactly, to within +-1: no square of them overflows
    mean = np.mean(scaled)
    reach = stdtrit(count - 1, 0.5 + 0.5 * CONFIDENCE) * np.std(scaled, ddof=1) / np.sqrt(count)
    with np.errstate(over="ignore"):
        mean, low, high = np.ldexp([mean, mean - reach, mean + reach], exponent).tolist()
    return mean, (low, high)


def _numbers(name: object, what: str, given: ArrayLike, dimensions: int) -> NDArray[np.float64]:
    """The given as finite floats with so many dimensions. Raises AccuracyError."""
    __tracebackhide__ = True
    import numpy as np

    wanted = "one number" if dimensions == 0 else "a row of numbers"
    try:
        array = np.asarray(given)
    except ValueError:
        raise AccuracyError(f"{name}: {what} must be {wanted}, got rows of different lengths") from None
    if array.size and array.dtype.kind not in "iuf":
        raise AccuracyError(f"{name}: {what} must be {wanted}, got {given!r:.80}")
    if array.ndim != dimensions:
        raise AccuracyError(f"{name}: {what} must be {wanted}, got an array of shape {array.shape}")
    with np.errstate(over="ignore"):
        numbers = array.astype(float)
    bad = np.flatnonzero(~np.isfinite(numbers))
    if len(bad):
        where = f"[{bad[0]}]" if dimensions else ""
        raise AccuracyError(f"{name}: {what}{where} is {numbers.flat[bad[0]]}, not a finite number")
    return numbers
