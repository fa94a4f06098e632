"""95 % intervals of what is estimated within bounds.

The covariance of an estimate is that of the problem without bounds. Where bounds hold the estimate back, they pull all
of it from where the record and the starting guess alone would have it. Linearised about the estimate, that is

    unheld = estimate - W^-1 g,

with the information W and that part g of the cost's gradient which the active bounds balance. The interval of the
unheld estimate, cut to what is allowed, holds the truth as often as it says; but it may be empty, or leave the estimate
outside. The interval given spans that of the unheld and that of the held estimate, cut at the least allowed value: it
is never empty, holds the estimate, and covers at least as often. (The interval of the held estimate alone, cut there,
would not: a sum of many quantities near their bounds is estimated too high by more than its standard deviation.)
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from identify.arrays import Array
from identify.estimation.parameter_bounds import ParameterBounds
from identify.estimation.propagation import combined_std

HALF_WIDTH = float(norm.ppf(0.975))
"""Of a 95 % interval, in standard deviations."""


@dataclass(frozen=True)
class BoundedEstimate:
    """An estimate (p,) within bounds, and where it is at them (p,) bool, in the order of the bounds' coordinates.

    unheld (p,): where record and starting guess alone would have it; covariance (p, p): of that.
    """

    estimate: Array
    at_bound: NDArray[np.bool_]
    unheld: Array
    covariance: Array
    bounds: ParameterBounds

    def intervals(self, rows: Array) -> Array:
        """95 % intervals (n, 2) of the quantities rows (n, p) @ parameters, cut at the least value allowed."""
        half = HALF_WIDTH * combined_std(rows, self.covariance)
        centres = np.stack([rows @ self.estimate, rows @ self.unheld])
        low = np.maximum(centres.min(axis=0) - half, self.bounds.least(rows))
        return np.stack([low, centres.max(axis=0) + half], axis=1)

    @property
    def active_bounds(self) -> tuple[str, ...]:
        """What the bounds that hold the estimate say of the parameters, as "platform.Izz <= Ixx + Iyy"."""
        return tuple(self.bounds.statements[k] for k in np.flatnonzero(self.at_bound))

    def warnings(self) -> tuple[str, ...]:
        """One line where bounds hold the estimate: which, and how far beyond them it would go."""
        if not self.at_bound.any():
            return ()
        beyond = self.bounds.lower - self.bounds.coordinates(self.unheld)
        std = combined_std(np.asarray(np.linalg.inv(self.bounds.matrix), dtype=float), self.covariance)
        said = ", ".join(
            f"{self.bounds.statements[k]} ({max(beyond[k] / std[k], 0):.2g})" for k in np.flatnonzero(self.at_bound)
        )
        return (
            f"the estimate is held at {self.at_bound.sum()} bounds; in brackets the standard deviations by which "
            f"record and starting guess would go beyond: {said}; the intervals allow for it",
        )


def bounded_estimate(
    estimate: Array,
    at_bound: NDArray[np.bool_],
    gradient: Array,
    information: Array,
    covariance: Array,
    bounds: ParameterBounds,
) -> BoundedEstimate:
    """The estimate (p,) of a search within bounds, where J^T r is `gradient` (p,) and J^T J is `information` (p, p)."""
    unheld = estimate - np.linalg.solve(information, bounds.balanced(gradient, at_bound))
    return BoundedEstimate(estimate, at_bound, unheld, covariance, bounds)
