"""A figure of accuracy: a value, or a mean with its interval, beside its limit."""

from dataclasses import dataclass
from typing import Literal, get_args

Better = Literal["lower", "higher"]
BETTER: tuple[str, ...] = get_args(Better)
PROPERTY = "cmmsim_accuracy"
"""Name of the user properties that carry figures in the reports of tests."""

CONFIDENCE = 0.95
"""Probability with which the interval of a sample holds the true mean."""


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
