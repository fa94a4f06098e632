"""The fixture `accuracy`: checks what a test hands in, keeps it as a figure, and fails the test beyond the limit."""

from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from scipy.special import stdtrit

from identify.accuracy.errors import AccuracyError
from identify.accuracy.figure import BETTER, CONFIDENCE, PROPERTY, Better, Figure


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
        mean, interval = mean_interval(numbers)
        if not np.isfinite([mean, *interval]).all():
            low, high = interval
            raise AccuracyError(f"{name}: the interval of the mean is {low:.4g} .. {high:.4g}, not finite")
        self._keep(name, unit, limit, better, value=mean, interval=interval, count=len(numbers))

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
