"""Figures of this session beside those of a saved one: what got worse, what is held to another limit, what is gone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from identify.accuracy.figure import Figure, percent, with_unit

Key = tuple[str, str]


@dataclass(frozen=True)
class Comparison:
    """A figure, and the one that was saved under the same test and name."""

    now: Figure
    saved: Figure

    @property
    def mismatch(self) -> str:
        """Why the two cannot be compared, or nothing."""
        for what, new, old in (
            ("unit", self.now.unit, self.saved.unit),
            ("better", self.now.better, self.saved.better),
        ):
            if new != old:
                return f"{what} is {new!r}, was {old!r}"
        return ""

    @property
    def limit_change(self) -> str:
        """One line: name, limit and the saved one, where they differ; or nothing."""
        now, saved = (
            "none" if figure.limit is None else with_unit(figure.limit_text, figure.unit)
            for figure in (self.now, self.saved)
        )
        return "" if now == saved else f"{self.now.test}: the limit of {self.now.name} is {now}, was {saved}"

    @property
    def evidence_change(self) -> str:
        """One line: name, and what stands behind its value now and before, where that is something else or less; or
        nothing. An interval of fewer values is wider, and would hold what the saved one did not."""
        now, saved = self.now, self.saved
        if (now.interval is None) == (saved.interval is None) and now.count >= saved.count:
            return ""
        return f"{now.test}: {now.name} is {_evidence(now)}, was {_evidence(saved)}"

    @property
    def change(self) -> float:
        """Growth of the value as a share of the saved one's size; infinite from zero to anything else."""
        grown = self.now.value - self.saved.value
        if not grown:
            return 0.0
        return grown / abs(self.saved.value) if self.saved.value else float("inf") * grown

    def worse_by_more_than(self, ratio: float) -> bool:
        """Whether the value got worse by more than this share of the saved one's size.

        Where there are intervals, only if even the good end of the new one is that much worse than the bad end of the
        saved one.
        """
        sign = self.now.sign
        return sign * (self.now.best - self.saved.worst) > ratio * abs(self.saved.value)

    @property
    def regression(self) -> str:
        """One line: name, both values and the change."""
        now, saved = (with_unit(f"{figure.value:.6g}", self.now.unit) for figure in (self.now, self.saved))
        return f"{self.now.test}: {self.now.name} is {now}, was {saved}, {percent(self.change, '+.1')}"


def _evidence(figure: Figure) -> str:
    return "one number" if figure.interval is None else f"a sample of {figure.count} values"


def compare(figures: Sequence[Figure], saved: Sequence[Figure]) -> Mapping[Key, Comparison]:
    """Pairs of figures by their key; figures that have no partner are left out."""
    before = {figure.key: figure for figure in saved}
    return {figure.key: Comparison(figure, before[figure.key]) for figure in figures if figure.key in before}


def missing(figures: Sequence[Figure], saved: Sequence[Figure]) -> Mapping[str, list[str]]:
    """Names of the saved figures that are not among these, by their test."""
    measured = {figure.key for figure in figures}
    gone: dict[str, list[str]] = {}
    for figure in saved:
        if figure.key not in measured:
            gone.setdefault(figure.test, []).append(figure.name)
    return gone
