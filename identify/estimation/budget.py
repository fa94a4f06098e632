"""Error budget: what each source of uncertainty adds to a standard deviation.

The form is that of the Guide to the Expression of Uncertainty in Measurement (GUM, JCGM 100:2008).
A source has a standard uncertainty, and a quantity has a sensitivity to the source. Their product
is what the source adds to the standard uncertainty of the quantity. The squares of the products sum
up to the square of the combined standard uncertainty. If sources are correlated, the effect of
their covariances has a separate row, whose variance can be negative (GUM, section 5.2).

`covariance` computes the part of each source as a matrix. The covariance is the sum of these parts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dynamics.parameters import ParameterLayout
from identify.arrays import Array
from identify.estimation.covariance import (
    ANCHOR,
    CORRELATED,
    GUESS,
    LOAD,
    MODEL,
    NOISE,
    ROUNDING,
)

if TYPE_CHECKING:
    import pandas as pd

COVERAGE = 1.96  # coverage factor of the expanded uncertainty, for 95 %


class Source(NamedTuple):
    """Source of uncertainty in words, and its evaluation: A by statistics, or B by other means."""

    words: str
    evaluation: str


# Sources of uncertainty by the names that the covariance gives them.
SOURCES = {
    NOISE: Source("noise of the poses (pixels)", "B"),
    "motion": Source("noise of the poses in the servo", "B"),
    "rig": Source("cameras", "B"),
    "teaching": Source("teaching of frames and stickers", "B"),
    "latency": Source("clocks: latency", "B"),
    "exposure": Source("clocks: exposures of both cameras", "B"),
    "clock": Source("clocks: poses and commands", "B"),
    "geometry": Source("geometry of the robot", "B"),
    "zeros": Source("drives: zeros of the joints", "B"),
    "scale": Source("drives: scale of the commands", "B"),
    "friction": Source("drives: constants of the law of friction", "B"),
    "start": Source("start of the record", "B"),
    "centres": Source("bodies: centres of mass", "B"),
    "products": Source("bodies: products of inertia", "B"),
    "passive_friction": Source("friction of passive joints", "B"),
    ANCHOR: Source("scale anchor", "B"),
    GUESS: Source("initial guess (prior)", "B"),
    LOAD: Source("known load", "B"),
    MODEL: Source("error of the model", "A"),
    CORRELATED: Source("covariances of these sources", "B"),
}


@dataclass(frozen=True)
class Budget:
    """Variances of q quantities by s sources.

    Attributes
    ----------
    quantities, units : tuple of str
        Names and units of the quantities.
    sources : tuple of str
        Keys of `SOURCES`.
    variances : ndarray, shape (q, s)
        What each source adds to the variance of each quantity.
    """

    quantities: tuple[str, ...]
    units: tuple[str, ...]
    sources: tuple[str, ...]
    variances: Array

    @property
    def std(self) -> Array:
        """Combined standard uncertainties (q,)."""
        return np.asarray(np.sqrt(self.variances.sum(axis=1)))

    @property
    def words(self) -> list[str]:
        """Names of the sources (s) in words."""
        return [SOURCES[key].words for key in self.sources]

    @property
    def shares(self) -> Array:
        """Fractions (q, s) of each quantity's variance, zero for a quantity without uncertainty."""
        total = self.variances.sum(axis=1, keepdims=True)
        return np.divide(self.variances, total, out=np.zeros_like(self.variances), where=total > 0)

    def to_dataframe(self) -> pd.DataFrame:
        """Return the table, with a row for each source of each quantity.

        The source that adds most comes first, and sources that add nothing are left out. The column
        `added` is the standard uncertainty that the source adds, and `share` its fraction of the
        variance. Both are negative in the row of covariances if these make the quantity better
        known. `combined` and `expanded` are the uncertainties of the quantity from all sources.
        """
        import pandas as pd

        added = np.sign(self.variances) * np.sqrt(np.abs(self.variances))
        rows = []
        for k, name in enumerate(self.quantities):
            combined = self.std[k]
            for index in np.argsort(-self.variances[k], kind="stable"):
                if self.variances[k, index]:
                    source = SOURCES[self.sources[index]]
                    effect = added[k, index], self.shares[k, index], combined, COVERAGE * combined
                    rows.append((name, self.units[k], *source, *effect))
        columns = ["quantity", "unit", "source", "evaluation", "added", "share"]
        return pd.DataFrame(rows, columns=[*columns, "combined", "expanded"])

    def to_dict(self) -> dict[str, Any]:
        """Return the budget for JSON, by quantity."""
        return {
            name: {
                "unit": self.units[k],
                "combined": self.std[k],
                "expanded": COVERAGE * self.std[k],
                "variances": dict(zip(self.sources, self.variances[k].tolist(), strict=True)),
            }
            for k, name in enumerate(self.quantities)
        }


def budget_of(
    quantities: Sequence[str],
    units: Sequence[str],
    parts: Mapping[str, Array],
    total: Array,
) -> Budget:
    """Return the budget of q quantities from the parts (q,) of their variances, by source.

    total (q,): variances of the quantities. Their excess over the sum of the parts, if it is more
    than rounding, becomes the part of covariances between sources.
    """
    excess = total - np.asarray(sum(parts.values()))
    if np.any(np.abs(excess) > ROUNDING * total):
        parts = {**parts, CORRELATED: excess}
    variances = np.stack([np.asarray(part, dtype=float) for part in parts.values()], axis=1)
    return Budget(tuple(quantities), tuple(units), tuple(parts), variances)


def parameter_budget(
    layout: ParameterLayout, covariance: Array, sources: Mapping[str, Array]
) -> Budget:
    """Return the budget of a robot's p parameters.

    The first p rows and columns of the covariance and of its parts are those of the parameters.
    """
    names = layout.names
    parts = {key: np.diag(part)[: len(names)] for key, part in sources.items()}
    units = [layout.unit(name) for name in names]
    return budget_of(names, units, parts, np.diag(covariance)[: len(names)])


def joined_budget(budgets: Sequence[Budget]) -> Budget:
    """Return one budget with the quantities and the sources of all budgets."""
    sources = [key for key in SOURCES if any(key in one.sources for one in budgets)]
    rows = [
        np.stack(
            [
                one.variances[:, one.sources.index(key)]
                if key in one.sources
                else np.zeros(len(one.quantities))
                for key in sources
            ],
            axis=1,
        )
        for one in budgets
    ]
    return Budget(
        tuple(name for one in budgets for name in one.quantities),
        tuple(unit for one in budgets for unit in one.units),
        tuple(sources),
        np.concatenate(rows),
    )
