"""Base parameters: the combinations of dynamic parameters that a motion can tell apart (section
4.2).

The wrench is H Xi (eq. 26). Where columns of H depend on each other, only combinations of their
parameters act: H = H_1 (1 | beta) P, so that H Xi = H_1 (xi_1 + beta xi_2), and the base parameters
are xi_1 + beta xi_2, one for each pivot column. Columns are scaled to length one, so that the
choice does not depend on units. Pivots are deterministic: of all columns that are long enough, the
first in a stated order is taken (threshold pivoting), so that the groups are the same whatever
motion shows them.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import orth, qr, subspace_angles

from dynamics import Robot
from dynamics.closed_loop import Reference
from dynamics.errors import DynamicsError
from dynamics.legs.leg import INERTIAL
from dynamics.parameters import ParameterLayout, RigidGroups
from identify.arrays import Array, triangular_factor
from identify.errors import EstimationError
from identify.filtering import spline_derivatives

DEPENDENT = 1e-8
"""A column of length one whose part outside the pivots is shorter than this depends on them."""

LONG_ENOUGH = 1e-3
"""A column may be a pivot when what is left of it is at least this fraction of the longest one."""

NEGLIGIBLE = 1e-7
"""Coefficients below this fraction of a group's largest contribution are rounding."""

MOTIONS = 200
"""Random motions that excite whatever can be excited."""

REACH_SHARES, TURN = (0.03, 0.01, 0.003, 0.001), 0.05
"""Random poses lie within a share of the largest distance between joints (m) and a turn (rad) about
home.
"""


@dataclass(frozen=True)
class BaseParameters:
    """Base parameters of a regression matrix with columns `names`, the dynamic parameters of a
    robot.

    combinations (rank, p): base = combinations @ parameters; pivots (rank,): the parameter that
    each group is named after, with coefficient 1; unseen: names of the parameters with no effect at
    all; gap: largest column remainder that was taken as dependent and smallest that was taken as
    independent.
    """

    names: tuple[str, ...]
    combinations: Array
    pivots: tuple[int, ...]
    unseen: tuple[str, ...]
    gap: tuple[float, float]

    @property
    def rank(self) -> int:
        """Number of base parameters."""
        return len(self.pivots)

    @cached_property
    def rigid_groups(self) -> RigidGroups:
        """Those of the inertial parameters, which stand first, without friction: that is in no
        group with others.
        """
        inertial = np.flatnonzero([name.split(".")[1] in INERTIAL for name in self.names])
        rows = np.flatnonzero(np.isin(self.pivots, inertial))
        return RigidGroups(np.array(self.pivots)[rows], self.combinations[np.ix_(rows, inertial)])

    def group_names(self) -> tuple[str, ...]:
        """Name of each group: its pivot's, with a plus where other parameters belong to it."""
        lone = (np.abs(self.combinations) > 0).sum(axis=1) == 1
        return tuple(
            self.names[p] + ("" if alone else " +")
            for p, alone in zip(self.pivots, lone, strict=True)
        )

    def expressions(self) -> tuple[str, ...]:
        """Each group as a sum, such as ``crank1.Izz + 0.0009 crank1.mass``."""
        return tuple(
            self._expression(row, pivot)
            for row, pivot in zip(self.combinations, self.pivots, strict=True)
        )

    def _expression(self, row: Array, pivot: int) -> str:
        others = [k for k in np.flatnonzero(row) if k != pivot]
        terms = [
            f"{'-' if row[k] < 0 else '+'} {_coefficient(abs(row[k]))}{self.names[k]}"
            for k in others
        ]
        return " ".join([self.names[pivot], *terms])


def base_parameters(matrix: Array, layout: ParameterLayout) -> BaseParameters:
    """Base parameters of a regression matrix (rows, p) of a robot with this layout by pivoted QR.

    Among the columns of which enough is left, pivots go to friction first, then to the platform,
    the moments of the legs' bodies, and their masses, those nearest to the platform first. Raises
    EstimationError for a matrix without any effect.
    """
    names = layout.dynamic_names
    lengths = np.linalg.norm(matrix, axis=0)
    seen = np.flatnonzero(lengths > DEPENDENT * lengths.max(initial=0.0))
    if len(seen) == 0:
        raise EstimationError(
            f"the regression matrix {matrix.shape} is zero: the motion excites no parameter"
        )
    columns = matrix[:, seen] / lengths[seen]
    pivots, gap = _pivots(columns, _preferences(layout)[seen])
    others = np.setdiff1d(np.arange(len(seen)), pivots)
    beta = np.linalg.lstsq(columns[:, pivots], columns[:, others], rcond=None)[0]
    beta[np.abs(beta) < NEGLIGIBLE] = 0.0
    combinations = np.zeros((len(pivots), len(names)))
    combinations[np.arange(len(pivots)), seen[pivots]] = 1.0
    combinations[:, seen[others]] = beta * lengths[seen[others]] / lengths[seen[pivots]][:, None]
    order = np.argsort(seen[pivots])
    unseen = tuple(name for k, name in enumerate(names) if k not in seen)
    return BaseParameters(
        names, combinations[order], tuple(int(k) for k in seen[pivots][order]), unseen, gap
    )


@lru_cache(maxsize=8)
def structure(robot: Robot) -> BaseParameters:
    """Base parameters of a robot, whatever moves it, found once. Raises EstimationError as
    `structural_regressor`.
    """
    return base_parameters(structural_regressor(robot), robot.layout)


def structural_regressor(robot: Robot, motions: int = MOTIONS, seed: int = 0) -> Array:
    """Regression matrix (m motions, p) of random poses about home, twists and accelerations: what
    can be excited is. Rows are wrenches along the platform's m coordinates: what the chart forbids
    moves nothing.

    Raises EstimationError, with the last reason, where no neighbourhood of home is in reach.
    """
    rng = np.random.default_rng(seed)
    chart = robot.geometry.chart
    size = float(np.abs(robot.geometry.platform_joints).max())
    draws = chart.lifted(rng.uniform(-1.0, 1.0, (3, motions, len(chart.freedoms))))
    reason: Exception | None = None
    for share in REACH_SHARES:
        poses = robot.home_pose + draws[0] * np.repeat(
            [share * size, TURN * share / REACH_SHARES[0]], 3
        )
        try:
            robot.inverse_kinematics(poses)
        except DynamicsError as error:
            reason = error
            continue
        unit = np.repeat([size, 1.0], 3)
        regressor = chart.projected(robot.regressor(poses, draws[1] * unit, 10.0 * draws[2] * unit))
        return np.asarray(regressor, dtype=float).reshape(-1, regressor.shape[2])
    raise EstimationError(f"robot {robot.name} reaches no neighbourhood of its home pose: {reason}")


def rank_by_singular_values(matrix: Array) -> int:
    """Rank of a regression matrix whose columns are scaled to length one, from its singular
    values."""
    lengths = np.linalg.norm(matrix, axis=0)
    singular = np.linalg.svd(matrix / np.where(lengths > 0, lengths, 1.0), compute_uv=False)
    return int(np.sum(singular > DEPENDENT * singular[0]))


def angle_to_singular_vectors(matrix: Array, found: BaseParameters) -> float:
    """Largest angle [rad] between what the groups span and the row space of a regression matrix
    (rows, p) by its singular vectors, with columns of length one; pi / 2 where one has a direction
    more than the other."""
    lengths = np.linalg.norm(matrix, axis=0)
    scale = np.where(lengths > DEPENDENT * lengths.max(), lengths, 1.0)
    groups = found.combinations / scale
    rows = orth((matrix / scale).T, rcond=DEPENDENT)
    return (
        float(subspace_angles(groups.T, rows).max()) if len(groups) == rows.shape[1] else np.pi / 2
    )


def rank_by_threshold(matrix: Array, threshold: float) -> int:
    """The paper's count: diagonal entries of R above `threshold` in the pivoted QR of the unscaled
    H (section 4.2).

    The entries have the regressor's units (N, N m per unit of a parameter) and grow with the root
    of the number of samples, so the count depends on both; where it exceeds the rank, the threshold
    lies below rounding.
    """
    return int(
        np.sum(
            np.abs(np.diag(qr(triangular_factor(matrix), mode="r", pivoting=True)[0])) > threshold
        )
    )


def reference_regressor(robot: Robot, reference: Reference, rate_hz: float) -> Array:
    """Regression matrix H (m n, p) of a reference motion sampled at `rate_hz`."""
    acceleration, _ = spline_derivatives(reference.rates, rate_hz)
    twist = robot.twist(reference.poses, reference.rates)
    twist_dot = robot.twist_dot(reference.poses, reference.rates, acceleration)
    regressor = robot.geometry.chart.projected(robot.regressor(reference.poses, twist, twist_dot))
    return np.asarray(regressor.reshape(-1, regressor.shape[2]), dtype=float)


def _pivots(columns: Array, preference: NDArray[np.intp]) -> tuple[Array, tuple[float, float]]:
    """Indices of independent columns, and the remainders on both sides of the limit."""
    left = columns.copy()
    smallest = 1.0
    chosen: list[int] = []
    while True:
        lengths = np.linalg.norm(left, axis=0)
        longest = float(lengths.max())
        if longest <= DEPENDENT:
            return np.array(chosen), (longest, smallest)
        able = np.flatnonzero(lengths >= LONG_ENOUGH * longest)
        pivot = int(able[np.argmin(preference[able])])
        smallest = min(smallest, float(lengths[pivot]))
        chosen.append(pivot)
        direction = left[:, pivot] / lengths[pivot]
        for _ in range(2):  # the second pass removes what rounding left
            left -= np.outer(direction, direction @ left)
        left[:, chosen] = 0.0


def _preferences(layout: ParameterLayout) -> NDArray[np.intp]:
    """Place (p,) of each dynamic parameter among columns that are long enough."""
    friction, platform, moment, mass = range(4)
    kinds = np.full(len(layout.dynamic_names), friction)
    rigid = layout.bodies_of(kinds)
    rigid[:] = moment
    places = {body: place for bodies in layout.of_leg for place, body in enumerate(bodies)}
    last = max(places.values())
    rigid[:, 0] = [mass + last - places.get(body, last) for body in range(len(rigid))]
    rigid[0] = platform
    return np.asarray(kinds * len(kinds) + np.arange(len(kinds)))


def _coefficient(value: float) -> str:
    return "" if abs(value - 1.0) < 5e-7 else f"{value:.6g} "
