"""Where a search may go: no negative parameter, and on demand only bodies that can exist.

A rigid body has a positive mass, and none of its principal moments of inertia exceeds the sum of the other two. With
the second moments of its mass along its axes, J_x = integral of x^2 dm and so on,

    Ixx = J_y + J_z,    Iyy = J_x + J_z,    Izz = J_x + J_y,

and the triangle inequality of the moments is nothing but J >= 0: a search in J instead of I needs bounds only, see
Traversaro et al., "Identification of fully physical consistent inertial parameters" (IROS 2016).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynamics.analysis.physical_inertia import MOMENTS, SMALLEST, physical_inertias
from dynamics.parameters import BODY_NAMES
from identify.arrays import Array
from identify.estimation.bounded_least_squares import Problem
from identify.loop_parameters import NAMES, StartingGuess, index_of

SMALLEST_SHARE = 1e-3
"""Lower bound of platform mass and integral gain, as a share of the starting guess: the model needs both."""

MOMENTS_FROM_SECOND = np.ones((3, 3)) - np.eye(3)
"""(Ixx, Iyy, Izz) from (J_x, J_y, J_z)."""


@dataclass(frozen=True)
class ParameterBounds:
    """Coordinates (p,) of a search and their lower bounds (p,), with parameters = matrix (p, p) @ coordinates.

    statements: what each bound says of the parameters; physical: only bodies that can exist.
    """

    matrix: Array
    lower: Array
    statements: tuple[str, ...]
    physical: bool

    def nearest(self, parameters: Array) -> Array:
        """Parameters (67,) within the bounds: negative ones raised, and bodies changed where they cannot exist, if it
        can be in what the motion does not feel."""
        allowed = np.maximum(parameters, 0.0)
        if self.physical:
            bodies = physical_inertias(allowed[:64], allow_changes=True).values
            allowed[: bodies.size] = bodies.ravel()
        return self.parameters(np.maximum(self.coordinates(allowed), self.lower))

    def coordinates(self, parameters: Array) -> Array:
        """Coordinates (p,) of parameters (p,)."""
        return np.asarray(np.linalg.solve(self.matrix, parameters), dtype=float)

    def parameters(self, coordinates: Array) -> Array:
        """Parameters (p,) of coordinates (p,)."""
        return np.asarray(self.matrix @ coordinates, dtype=float)

    def least(self, rows: Array) -> Array:
        """Least values (n,) that rows (n, p) @ parameters take within the bounds; -inf where there is none."""
        weights = rows @ self.matrix
        return np.where((weights >= 0).all(axis=1), weights @ self.lower, -np.inf)

    def balanced(self, gradient: Array, at_bound: NDArray[np.bool_]) -> Array:
        """The part (p,) of a cost's gradient (p,) that the coordinates (p,) at their bounds balance."""
        multipliers = np.where(at_bound, np.maximum(self.matrix.T @ gradient, 0.0), 0.0)
        return np.asarray(np.linalg.solve(self.matrix.T, multipliers), dtype=float)


@dataclass(frozen=True)
class InCoordinates:
    """A least-squares problem as a function of the coordinates; see `bounded_least_squares.Problem`."""

    problem: Problem
    bounds: ParameterBounds

    def cost(self, parameters: Array) -> float:
        """Cost at coordinates (p,)."""
        return self.problem.cost(self.bounds.parameters(parameters))

    def linearise(self, parameters: Array) -> tuple[float, Array, Array]:
        """Cost and linearisation at coordinates (p,)."""
        cost, factor, residual = self.problem.linearise(self.bounds.parameters(parameters))
        return cost, factor @ self.bounds.matrix, residual


def parameter_bounds(guess: StartingGuess, physical: bool) -> ParameterBounds:
    """Bounds of the 67 parameters; physical: only masses and inertias that a rigid body can have."""
    matrix, lower = np.eye(len(NAMES)), np.zeros(len(NAMES))
    for name in ("platform.mass", "joint_pid.li"):
        lower[index_of(name)] = SMALLEST_SHARE * guess.values[index_of(name)]
    if physical:
        lower[: 4 * len(BODY_NAMES)] = np.maximum(lower[: 4 * len(BODY_NAMES)], SMALLEST)
    statements = [f"{name} >= {bound:g}" for name, bound in zip(NAMES, lower, strict=True)]
    for body in BODY_NAMES if physical else ():
        first = index_of(f"{body}.Ixx")
        matrix[first : first + 3, first : first + 3] = MOMENTS_FROM_SECOND
        for axis, moment in enumerate(MOMENTS):
            others = [one for one in MOMENTS if one != moment]
            statements[first + axis] = f"{body}.{moment} <= {' + '.join(others)}"
    return ParameterBounds(matrix, lower, tuple(statements), physical)
