"""Figures of accuracy, each with its limit, and the object that records them in a test.

Pytest imports this module at every start. NumPy and SciPy are therefore imported only when a test
records a figure.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from math import isfinite
from typing import TYPE_CHECKING, Any, Literal, get_args

import pytest

from identify.errors import IdentifyError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    import numpy as np
    from numpy.typing import ArrayLike, NDArray

Better = Literal["lower", "higher"]
BETTER: tuple[str, ...] = get_args(Better)
# Name of the user properties that carry the figures in the reports of tests.
PROPERTY = "cmmsim_accuracy"
CONFIDENCE = 0.95  # probability with which the interval of a sample contains the true mean
FIRST = 20  # number of values that `Accuracy.sample_until` draws first
MOST = 640  # default of the largest number of values that `Accuracy.sample_until` draws


class AccuracyError(IdentifyError):
    """A value that cannot be a figure, or a file of figures that cannot be read or written."""


@dataclass(frozen=True)
class Figure:
    """One figure, recorded by one test under one name.

    Attributes
    ----------
    test : str
        Name of the test, from `identify.accuracy.session.test_name`.
    name : str
        Name of the figure, unique within its test.
    value : float
        The recorded number, or the mean of a sample.
    unit : str
        Unit of the value, of the limit and of the interval.
    better : {"lower", "higher"}
        Direction of improvement.
    limit : float or None
        Largest good value, or the smallest good value if higher is better.
    interval : tuple of float or None
        Ends (low, high) of the confidence interval of a sample's mean.
    count : int
        Number of values in the sample; 1 for a single number.
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
        """Test and name, which together are unique in a session."""
        return self.test, self.name

    @property
    def sign(self) -> int:
        """Sign of a deterioration: +1 if a larger value is worse, -1 if it is better."""
        return 1 if self.better == "lower" else -1

    @property
    def best(self) -> float:
        """Good end of the interval, or the value if there is no interval."""
        return self._end(-self.sign)

    @property
    def worst(self) -> float:
        """Bad end of the interval, or the value if there is no interval."""
        return self._end(self.sign)

    @property
    def beyond_limit(self) -> bool:
        """True if the whole interval, or the value without one, lies beyond the limit."""
        return self.limit is not None and self.sign * (self.best - self.limit) > 0

    @property
    def undecided(self) -> bool:
        """True if the interval contains the limit. The test then passes."""
        return (
            self.limit is not None
            and not self.beyond_limit
            and self.sign * (self.worst - self.limit) > 0
        )

    @property
    def limit_text(self) -> str:
        """Limit with its relation and without a unit, such as "≤ 2", or "" without a limit."""
        return (
            ""
            if self.limit is None
            else f"{'≤' if self.better == 'lower' else '≥'} {self.limit:.4g}"
        )

    @property
    def margin(self) -> float | None:
        """Distance of the value from the limit, as a fraction of the limit, negative beyond it.

        It is None if there is no limit, or if the limit is zero.
        """
        return self.sign * (self.limit - self.value) / abs(self.limit) if self.limit else None

    @property
    def verdict(self) -> str:
        """One line that states why the figure is beyond its limit."""
        side = "above" if self.better == "lower" else "below"
        limit = f"the limit of {with_unit(f'{self.limit:.6g}', self.unit)}"
        if self.interval is None:
            return f"{self.name}: {with_unit(f'{self.value:.6g}', self.unit)} is {side} {limit}"
        low, high = self.interval
        interval = with_unit(f"[{low:.6g}, {high:.6g}]", self.unit)
        return (
            f"{self.name}: mean {with_unit(f'{self.value:.6g}', self.unit)} of {self.count} "
            f"values, {CONFIDENCE:.0%} interval {interval}, lies wholly {side} {limit}"
        )

    def _end(self, side: int) -> float:
        if self.interval is None:
            return self.value
        return self.interval[1] if side > 0 else self.interval[0]


def with_unit(text: str, unit: str) -> str:
    """Append a unit to the text of a number."""
    return f"{text} {unit}".rstrip()


def percent(share: float, form: str) -> str:
    """Format a fraction in per cent, in a form such as ".0" or "+.1".

    Fractions from 100 (10,000 %) on are written with a power of ten.
    """
    return f"{share:{form}%}" if abs(share) < 100 else f"{100 * share:{form}e}%"


class Accuracy:
    """Recorder of the figures of one test, the value of the fixture `accuracy`.

    A figure beyond its limit fails the test at once.
    """

    def __init__(
        self,
        test: str,
        properties: list[tuple[str, object]],
        saved_counts: Mapping[tuple[str, str], int] | None = None,
    ) -> None:
        self._test = test
        self._properties = properties
        self._saved_counts = saved_counts or {}
        self._names: set[str] = set()

    def record(
        self,
        name: str,
        value: ArrayLike,
        unit: str = "",
        limit: float | None = None,
        better: Better = "lower",
    ) -> None:
        """Record one number.

        Parameters
        ----------
        name : str
            Name of the figure. It must be new in this test.
        value : float
            The number.
        unit : str, optional
            Unit of the value, for tables.
        limit : float, optional
            Largest value with which the test passes, or the smallest value if higher is better.
        better : {"lower", "higher"}, optional
            Direction of improvement.

        Raises
        ------
        AccuracyError
            The value or limit is not a finite number, the name was recorded already, or `name`,
            `unit` or `better` is not valid.

        Examples
        --------
        >>> def test_centre(accuracy):
        ...     accuracy.record("centre error", 0.013, unit="px", limit=0.02)
        """
        __tracebackhide__ = True
        number = float(_numbers(name, "value", value, dimensions=0))
        self._add(name, unit, limit, better, value=number)

    def sample(
        self,
        name: str,
        values: ArrayLike,
        unit: str = "",
        limit: float | None = None,
        better: Better = "lower",
    ) -> None:
        """Record the mean of independent values with Student's 95 % interval.

        The test fails only if the whole interval lies beyond the limit.

        Parameters
        ----------
        name : str
            Name of the figure. It must be new in this test.
        values : array_like, shape (n,)
            At least two independent values.
        unit : str, optional
            Unit of the values, for tables.
        limit : float, optional
            Largest mean with which the test passes, or the smallest mean if higher is better.
        better : {"lower", "higher"}, optional
            Direction of improvement.

        Raises
        ------
        AccuracyError
            There are fewer than two values, or their interval is not finite. Further causes are
            those of `record`.

        Examples
        --------
        >>> def test_distance(accuracy):
        ...     accuracy.sample("distance error", [1.9, 2.2, 2.0], unit="um", limit=3.0)
        """
        __tracebackhide__ = True
        numbers = _numbers(name, "values", values, dimensions=1)
        if len(numbers) < 2:
            raise AccuracyError(f"{name}: a sample needs at least 2 values, got {len(numbers)}")
        mean, (low, high) = mean_interval(numbers)
        if not (isfinite(low) and isfinite(high)):
            raise AccuracyError(
                f"{name}: the interval of the mean is {low:.4g} .. {high:.4g}, not finite"
            )
        self._add(name, unit, limit, better, value=mean, interval=(low, high), count=len(numbers))

    def sample_until(
        self,
        name: str,
        draw: Callable[[int], ArrayLike],
        limit: float,
        unit: str = "",
        better: Better = "lower",
        most: int = MOST,
    ) -> None:
        """Record the mean of independent values, which are drawn until the limit is decided.

        From 20 on, the number of values is doubled as long as the interval of the mean contains the
        limit. If the interval of `most` values still does, the figure is undecided, and the test
        passes. The intervals are wider than that of `sample`, because several of them are judged
        (Bonferroni).

        With ``--accuracy-compare``, at least as many values are drawn as the saved figure has, if
        `most` allows. A better method needs fewer values to decide its limit, but with fewer values
        its interval would be too wide to show a small deterioration.

        Parameters
        ----------
        name : str
            Name of the figure. It must be new in this test.
        draw : callable
            Function of a number n that returns n values, independent of all earlier values.
        limit : float
            Largest mean with which the test passes, or the smallest mean if higher is better.
        unit : str, optional
            Unit of the values, for tables.
        better : {"lower", "higher"}, optional
            Direction of improvement.
        most : int, optional
            Largest number of values, at least 20.

        Raises
        ------
        AccuracyError
            `draw` returns a wrong number of values, or `most` is not a whole number of at least 20.
            Further causes are those of `record`.

        Examples
        --------
        >>> def test_distance(accuracy, cmmsim_seed):
        ...     rng = np.random.default_rng(cmmsim_seed)
        ...     accuracy.sample_until(
        ...         "distance error", lambda n: measure(rng, n), limit=3.0, unit="um"
        ...     )
        """
        __tracebackhide__ = True
        import numpy as np

        if isinstance(most, bool) or not isinstance(most, int) or most < FIRST:
            raise AccuracyError(f"{name}: most is {most!r}, must be a whole number >= {FIRST}")
        counts = [FIRST]
        while counts[-1] < most:
            counts.append(min(2 * counts[-1], most))
        least = self._saved_counts.get((self._test, name), FIRST)
        confidence = 1 - (1 - CONFIDENCE) / len(counts)
        numbers = np.empty(0)
        for count in counts:
            drawn = _numbers(name, "values", draw(count - len(numbers)), dimensions=1)
            if len(drawn) != count - len(numbers):
                raise AccuracyError(
                    f"{name}: draw({count - len(numbers)}) returned {len(drawn)} values"
                )
            numbers = np.concatenate([numbers, drawn])
            mean, interval = mean_interval(numbers, confidence)
            if count >= least and not interval[0] <= limit <= interval[1]:
                break
        self._add(name, unit, limit, better, value=mean, interval=interval, count=len(numbers))

    def _add(self, name: str, unit: str, limit: float | None, better: Better, **found: Any) -> None:
        __tracebackhide__ = True
        for what, text in (("name", name), ("unit", unit)):
            if not isinstance(text, str) or (what == "name" and not text.strip()) or "\n" in text:
                raise AccuracyError(f"the {what} of a figure is a line of text, got {text!r}")
        if better not in BETTER:
            raise AccuracyError(
                f"{name}: better is {better!r}, must be {' or '.join(map(repr, BETTER))}"
            )
        if name in self._names:
            raise AccuracyError(f"{name}: recorded already in this test")
        checked = None if limit is None else float(_numbers(name, "limit", limit, dimensions=0))
        figure = Figure(self._test, name, unit=unit, better=better, limit=checked, **found)
        self._names.add(name)
        self._properties.append((PROPERTY, asdict(figure)))
        if figure.beyond_limit:
            pytest.fail(figure.verdict)


def mean_interval(
    values: NDArray[np.float64], confidence: float = CONFIDENCE
) -> tuple[float, tuple[float, float]]:
    """Return the mean of values (n,), n >= 2, and its confidence interval.

    The interval contains the true mean with the probability `confidence`. An end beyond the largest
    float is infinite.
    """
    import numpy as np
    from scipy.special import stdtrit

    count = len(values)
    # Scaling by a power of two causes no rounding, and avoids an overflow of squares.
    exponent = np.frexp(np.abs(values).max())[1]
    scaled = np.ldexp(values, -exponent)
    mean = np.mean(scaled)
    reach = stdtrit(count - 1, 0.5 + 0.5 * confidence) * np.std(scaled, ddof=1) / np.sqrt(count)
    with np.errstate(over="ignore"):
        mean, low, high = np.ldexp([mean, mean - reach, mean + reach], exponent).tolist()
    return mean, (low, high)


def _numbers(name: object, what: str, given: ArrayLike, dimensions: int) -> NDArray[np.float64]:
    """Convert the argument to finite floats.

    Raises AccuracyError if it is not numeric, not finite, or has other dimensions.
    """
    __tracebackhide__ = True
    import numpy as np

    wanted = "one number" if dimensions == 0 else "a row of numbers"
    try:
        array = np.asarray(given)
    except ValueError:
        raise AccuracyError(
            f"{name}: {what} must be {wanted}, got rows of different lengths"
        ) from None
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
