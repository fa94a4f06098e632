"""95 % intervals of estimates within bounds.

The covariance of an estimate is computed without bounds. Active bounds move all parameters away
from the unheld estimate, which is the estimate without bounds. Linearised about the bounded
estimate, the unheld estimate is

    unheld = estimate - W^-1 g,

with the information W, whose inverse is the covariance for white residuals, and the part g of the
cost's gradient that the active bounds balance. At a flat body, all of the gradient with respect to
its ten numbers is balanced. The interval of the unheld estimate, truncated at the bounds, has the
stated coverage whatever the truth. But it can be empty, or not contain the estimate. Averaged over
all truths within the bounds, it is also in the wrong position, because a bound that a quantity
cannot cross moves all correlated quantities, too. The stated distribution is therefore truncated at
all bounds, see `truncated_normal`. Its interval alone would not do either. For a sum of many
quantities whose true values are at their bounds, this interval is too high by more than its
standard deviation.

The estimate weighs poses and initial guess as if the residuals were white. In a closed loop the
noise also moves the robot, and the covariance of the estimate is larger than that of white noise.
The bounds act like the initial guess: by the weights of white noise. The distribution that is
truncated therefore has the covariance of white noise, and the rest of the covariance is an excess
of `TruncatedNormal`. If the excess were truncated as well, errors due to noise would be taken for
knowledge of how the truth is related to its bounds.

The returned interval is the shortest that contains both intervals and the estimate, truncated at
the smallest allowed value. It is never empty, and has at least the stated coverage. Without bounds
nearby, both intervals are the same.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtri

from identify.arrays import Array
from identify.estimation.bounds import ParameterBounds
from identify.estimation.truncated_normal import TruncatedNormal, truncated

HALF_WIDTH = float(ndtri(0.975))  # half the width of a 95 % interval, in standard deviations


def combined_std(rows: Array, covariance: Array) -> Array:
    """Return the standard deviations (n,) of the combinations rows (n, p) @ parameters.

    covariance (p, p): covariance of the parameters.
    """
    return np.asarray(np.sqrt(np.einsum("gi,ij,gj->g", rows, covariance, rows)))


@dataclass(frozen=True)
class BoundedEstimate:
    """Estimate (p,) within bounds.

    at_bound (p,): True for coordinates at their bounds. unheld (p,): estimate without bounds.
    covariance (p, p): covariance of the unheld estimate. white (p, p): what it would be if the
    residuals were white.
    """

    estimate: Array
    at_bound: NDArray[np.bool_]
    unheld: Array
    covariance: Array
    white: Array
    bounds: ParameterBounds

    def intervals(self, rows: Array) -> Array:
        """Return the 95 % intervals (n, 2) of the quantities rows (n, p) @ parameters.

        They are truncated at the smallest allowed values of the quantities.
        """
        unheld = rows @ self.unheld
        mean, std = self.within.marginals(rows)
        # The estimate counts as an interval without width, see the module docstring.
        middles = np.stack([unheld, mean, rows @ self.estimate])
        stds = np.stack([combined_std(rows, self.covariance), std, np.zeros(len(rows))])
        low = (middles - HALF_WIDTH * stds).min(axis=0)
        high = (middles + HALF_WIDTH * stds).max(axis=0)
        return np.stack([np.maximum(low, self.bounds.least(rows)), high], axis=1)

    @cached_property
    def within(self) -> TruncatedNormal:
        """Stated distribution: that of the unheld estimate, truncated at all bounds."""
        lower = self.bounds.linear_lower
        bounded = np.isfinite(lower)
        directions = np.asarray(np.linalg.inv(self.bounds.matrix)[bounded], dtype=float)
        excess = self.covariance - self.white
        return truncated(self.unheld, self.white, directions, lower[bounded], excess)

    def probabilities(self, rows: Array, values: Array) -> Array:
        """Return the probabilities (n,) of rows (n, p) @ parameters < values (n,).

        The stated distribution of each of these quantities is normal with the moments of
        `TruncatedNormal.marginals`, truncated at the smallest allowed value.
        """
        centre, std = self.within.marginals(rows)
        # Logarithms of upper tails keep their digits far below a bound.
        tail = log_ndtr((centre - values) / std)
        whole = log_ndtr((centre - self.bounds.least(rows)) / std)
        return np.asarray(np.clip(-np.expm1(tail - whole), 0.0, 1.0))

    @property
    def active_bounds(self) -> tuple[str, ...]:
        """Statements of the active bounds, such as "platform.Izz <= Ixx + Iyy"."""
        held = (self.bounds.statements[k] for k in np.flatnonzero(self.at_bound))
        return tuple(dict.fromkeys(held))

    def warnings(self) -> tuple[str, ...]:
        """Return a warning if bounds are active, with the distance of the unheld estimate."""
        if not self.at_bound.any():
            return ()
        beyond = self.bounds.linear_lower - self.bounds.linear_coordinates(self.unheld)
        to_coordinates = np.asarray(np.linalg.inv(self.bounds.matrix), dtype=float)
        distances = beyond / combined_std(to_coordinates, self.covariance)
        moved = self.unheld - self.estimate
        for own in self.bounds.log_cholesky:
            to_body = np.linalg.solve(self.covariance[own, own], moved[own])
            distances[own] = np.sqrt(moved[own] @ to_body)
        said = ", ".join(
            dict.fromkeys(
                f"{self.bounds.statements[k]} ({max(distances[k], 0):.2g})"
                for k in np.flatnonzero(self.at_bound)
            )
        )
        count = len(self.active_bounds)
        bounds = "a bound" if count == 1 else f"{count} bounds"
        return (
            f"the estimate is held at {bounds} that no robot can pass: {said}; without the bound, "
            "the estimate would lie beyond it by the number of standard deviations in brackets; "
            "the intervals allow for this",
        )


def bounded_estimate(
    estimate: Array,
    at_bound: NDArray[np.bool_],
    gradient: Array,
    covariance: Array,
    white: Array,
    bounds: ParameterBounds,
) -> BoundedEstimate:
    """Return the estimate (p,) of a search within bounds.

    gradient (p,): J^T r of poses and prior. For the other arguments see `BoundedEstimate`.
    """
    unheld = estimate - white @ bounds.balanced(gradient, at_bound)
    return BoundedEstimate(estimate, at_bound, unheld, covariance, white, bounds)
