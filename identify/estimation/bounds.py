"""Bounds of a search for parameters.

No parameter is negative, except the first moments and products of inertia of full bodies, which
have no bounds. As an option, bodies must be physically possible: a rigid body has a positive mass,
and none of its principal moments of inertia exceeds the sum of the other two. With the second
moments of its mass along its axes, J_x = integral of x^2 dm and so on,

    Ixx = J_y + J_z,    Iyy = J_x + J_z,    Izz = J_x + J_y,

and the triangle inequality of the moments is equivalent to J >= 0. A search in J instead of I
therefore needs only bounds, see Traversaro et al., "Identification of fully physical consistent
inertial parameters" (IROS 2016). A full body, which has all ten inertial parameters, is possible if
its pseudo-inertia is positive definite. The search then uses log-Cholesky coordinates of the body
(see `dynamics.pseudo_inertia`). A bound keeps the body from becoming so flat that changes of these
coordinates no longer change it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynamics.inertia import SMALLEST, physical_inertias
from dynamics.parameters import ParameterLayout
from dynamics.pseudo_inertia import (
    body_fault,
    from_log_cholesky,
    log_cholesky,
    log_cholesky_slope,
    nearest_body,
)
from dynamics.spatial_inertia import MOMENTS
from identify.arrays import Array
from identify.estimation.prior import StartingGuess

# Lower bound of parameters that must be above zero, as a fraction of the initial guess. Examples
# are the platform's mass and the integral gain.
SMALLEST_SHARE = 1e-3
# At the start of a search, each second moment of a full body is at least half this fraction of
# their sum. The logarithms of a flat body are infinite.
INSIDE = 1e-3
# Smallest square of a diagonal entry of the Cholesky factor of a full body in a search, times the
# guessed mass, as a fraction of the sum of the second moments of the initial guess.
FLATTEST = 1e-4
# Matrix that maps (J_x, J_y, J_z) to (Ixx, Iyy, Izz).
MOMENTS_FROM_SECOND = np.ones((3, 3)) - np.eye(3)


def least_values(layout: ParameterLayout) -> Array:
    """Return the smallest values (p,) that parameters can have, zero or -inf.

    Only first moments and products of inertia can be negative.
    """
    least = np.zeros(len(layout.names))
    least[layout.dynamic][layout.signed] = -np.inf
    return least


@dataclass(frozen=True)
class ParameterBounds:
    """Coordinates (p,) of a search, and their lower bounds.

    matrix (p, p): parameters = matrix @ coordinates, except for full bodies that must be physically
    possible. These have log-Cholesky coordinates. lower (p,): bounds of the coordinates, -inf
    without a bound. statements: text of each bound in terms of parameters. physical: whether bodies
    must be physically possible.
    """

    layout: ParameterLayout
    matrix: Array
    lower: Array
    statements: tuple[str, ...]
    physical: bool

    def nearest(self, parameters: Array) -> Array:
        """Return these parameters (p,), moved to within the bounds.

        Parameters below their bounds are raised. With `physical`, impossible bodies are changed, if
        possible without an effect on the motion, and flat full bodies are made thicker.
        """
        allowed = np.maximum(parameters, least_values(self.layout))
        if self.physical:
            bodies = physical_inertias(self.layout, allowed, allow_changes=True).values
            allowed[self.layout.inertial] = self.layout.rigid_of(bodies)
            for own in self.log_cholesky:
                second_moments = allowed[own][4:7].sum() / 2
                allowed[own] = nearest_body(allowed[own], INSIDE * second_moments)
        return self.parameters(np.maximum(self.coordinates(allowed), self.lower))

    def outside(self, parameters: Array) -> NDArray[np.bool_]:
        """Return a mask (p,) of the parameters that are beyond a bound.

        If no rigid body can have the moments of a body, all three are marked, because each of them
        can be the cause. Of a full body that cannot exist, all ten parameters are marked.
        """
        beyond = self.linear_coordinates(parameters) < self.linear_lower
        marked = np.asarray((self.matrix != 0) | np.eye(len(beyond), dtype=bool)) @ beyond
        for own in self.log_cholesky:
            marked[own] = bool(body_fault(parameters[own]))
        return np.asarray(marked, dtype=bool)

    def coordinates(self, parameters: Array) -> Array:
        """Return the coordinates (p,) of parameters (p,) within the bounds."""
        found = self.linear_coordinates(parameters)
        for own in self.log_cholesky:
            found[own] = log_cholesky(parameters[own])
        return found

    def parameters(self, coordinates: Array) -> Array:
        """Return the parameters (p,) of coordinates (p,)."""
        found = np.asarray(self.matrix @ coordinates, dtype=float)
        for own in self.log_cholesky:
            found[own] = from_log_cholesky(coordinates[own])
        return found

    def slope(self, coordinates: Array) -> Array:
        """Return the derivatives (p, p) of the parameters with respect to the coordinates (p,)."""
        if not self.log_cholesky:
            return self.matrix
        found = self.matrix.copy()
        for own in self.log_cholesky:
            found[own, own] = log_cholesky_slope(coordinates[own])
        return found

    def spread(self, coordinates: Array, std: Array) -> Array:
        """Return a typical change (p,) of each coordinate, at coordinates (p,).

        std (p,): typical change of each parameter.
        """
        return np.asarray(np.abs(np.linalg.inv(self.slope(coordinates))) @ std, dtype=float)

    def linear_coordinates(self, parameters: Array) -> Array:
        """Return the coordinates (p,) of parameters (p,), with full bodies left unchanged."""
        return np.asarray(np.linalg.solve(self.matrix, parameters), dtype=float)

    @property
    def linear_lower(self) -> Array:
        """Lower bounds (p,) of the linear coordinates, -inf for full bodies."""
        found = self.lower.copy()
        for own in self.log_cholesky:
            found[own] = -np.inf
        return found

    @property
    def log_cholesky(self) -> tuple[slice, ...]:
        """Slices of the full bodies that have log-Cholesky coordinates."""
        pairs = zip(self.layout.body_slices, self.layout.full, strict=True)
        return tuple(own for own, full in pairs if full and self.physical)

    def least(self, rows: Array) -> Array:
        """Return the smallest allowed values (n,) of rows (n, p) @ parameters, or -inf."""
        weights = rows @ self.matrix
        # With a negative weight the value has no lower limit, because there are no upper bounds.
        lower = self.linear_lower
        bounded = np.isfinite(lower)
        free = (weights < 0) | ((weights != 0) & ~bounded)
        least = weights[:, bounded] @ lower[bounded]
        return np.where(free.any(axis=1), -np.inf, least)

    def balanced(self, gradient: Array, at_bound: NDArray[np.bool_]) -> Array:
        """Return the part (p,) of a cost's gradient (p,) that active bounds balance.

        Both are with respect to the parameters. If any coordinate of a full body is at its bound,
        the part is the body's whole gradient. at_bound (p,): True for coordinates at their bounds.
        """
        multipliers = np.where(at_bound, np.maximum(self.matrix.T @ gradient, 0.0), 0.0)
        found = np.asarray(np.linalg.solve(self.matrix.T, multipliers), dtype=float)
        for own in self.log_cholesky:
            found[own] = gradient[own] if at_bound[own].any() else 0.0
        return found


def parameter_bounds(guess: StartingGuess, physical: bool) -> ParameterBounds:
    """Return the bounds of all parameters.

    With `physical`, the bounds allow only masses and inertias that a rigid body can have.
    """
    layout = guess.layout
    names = guess.layout.names
    matrix = np.eye(len(names))
    lower = least_values(layout)
    for index in (names.index(name) for name in guess.above_zero):
        lower[index] = SMALLEST_SHARE * guess.values[index]
    lower[guess.fixed] = -1.0  # the prior fixes them at zero, so their bounds must not be active
    if physical:
        lower[layout.inertial] = np.maximum(lower[layout.inertial], SMALLEST)
        for own, full in zip(layout.body_slices, layout.full, strict=True):
            lower[own] = -np.inf if full else lower[own]
    statements = [f"{name} >= {bound:g}" for name, bound in zip(names, lower, strict=True)]
    for body, own, full in zip(layout.bodies, layout.body_slices, layout.full, strict=True):
        if full and physical:
            # With the mass m and the coordinate d of an axis of the Cholesky factor, the second
            # moment along this axis is at least m exp(2 d).
            axes = slice(own.start + 1, own.start + 4)
            second = guess.values[own][4:7].sum() / 2  # sum of the second moments
            lower[axes] = np.log(max(FLATTEST * second / guess.values[own.start], SMALLEST)) / 2
            statements[axes] = 3 * [f"pseudo-inertia of {body} > 0"]
    centred = [body for body, full in zip(layout.bodies, layout.full, strict=True) if not full]
    for body in centred if physical else ():
        first = names.index(f"{body}.Ixx")
        matrix[first : first + 3, first : first + 3] = MOMENTS_FROM_SECOND
        for axis, moment in enumerate(MOMENTS):
            others = [one for one in MOMENTS if one != moment]
            statements[first + axis] = f"{body}.{moment} <= {' + '.join(others)}"
    return ParameterBounds(layout, matrix, lower, tuple(statements), physical)
