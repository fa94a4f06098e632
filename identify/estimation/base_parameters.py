"""Base parameters: combinations of dynamic parameters that a motion can identify (section 4.2).

The wrench is H Xi (eq. 26). If columns of H are linearly dependent, the wrench depends only on
combinations of their parameters. Let H_1 be linearly independent columns of H, the pivots, and let
the permutation P sort the parameters Xi into xi_1 of the pivots and xi_2 of the other columns. With
H = H_1 (1 | beta) P, the wrench is H Xi = H_1 (xi_1 + beta xi_2). The base parameters are xi_1 +
beta xi_2, one for each pivot column. Columns are scaled to length one, so that the choice of pivots
does not depend on units. The next pivot is the first column, in a fixed order, of those that are
long enough without their parts along the earlier pivots (threshold pivoting). The groups are
therefore the same for all motions.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import orth, qr, subspace_angles

from dynamics import Robot
from dynamics.closed_loop import Reference
from dynamics.errors import DynamicsError
from dynamics.parameter_units import PASSIVE_JOINT
from dynamics.parameters import ParameterLayout, RigidGroups
from dynamics.spatial_inertia import FIRST_MOMENTS, FULL_INERTIAL
from identify.arrays import Array, triangular_factor
from identify.errors import EstimationError
from identify.filtering import spline_derivatives

# Remainder below which a column of length one counts as linearly dependent on the pivots. The
# remainder of a column is the length of its part that is orthogonal to the pivots.
DEPENDENT = 1e-8
LONG_ENOUGH = 1e-3  # smallest remainder of a pivot column, as a fraction of the longest remainder
# Coefficient below which a parameter is left out of a group. It is for columns of length one, and
# the pivot of the group has the coefficient 1.
NEGLIGIBLE = 1e-7
MOTIONS = 200  # number of random motions. They excite every parameter that can be excited.
# Ranges of random positions about home, as fractions of the platform's size, the largest coordinate
# of its joints. The largest range in which the robot reaches all drawn poses is used.
REACH_SHARES = (0.03, 0.01, 0.003, 0.001)
# Range of random angles about home, rad, for the first of REACH_SHARES. For the others it is
# smaller in proportion.
TURN = 0.05


@dataclass(frozen=True)
class BaseParameters:
    """Base parameters of a regression matrix.

    names                   Names of the columns, the p dynamic parameters of a robot.
    combinations (rank, p)  Matrix with base parameters = combinations @ parameters.
    pivots                  Index of the parameter that names each group, in ascending order. In its
                            group it has the coefficient 1.
    unseen                  Names of the parameters without any effect on the wrench.
    gap                     Largest remainder of a dependent column, and smallest remainder of a
                            pivot column when it was chosen.
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
        """Groups of the inertial parameters and of the friction of passive joints.

        Friction of actuated joints is left out, because it is in no group with other parameters.
        """
        # inertial parameters and friction of passive joints come first in the layout
        inertial = np.flatnonzero(
            [
                entry in FULL_INERTIAL or joint.endswith(PASSIVE_JOINT.format(""))
                for joint, entry in (name.split(".") for name in self.names)
            ]
        )
        rows = np.flatnonzero(np.isin(self.pivots, inertial))
        return RigidGroups(np.array(self.pivots)[rows], self.combinations[np.ix_(rows, inertial)])

    def group_names(self) -> tuple[str, ...]:
        """Return the name of each group: the name of its pivot, and a plus for further members."""
        lone = (np.abs(self.combinations) > 0).sum(axis=1) == 1
        return tuple(
            self.names[p] + ("" if alone else " +")
            for p, alone in zip(self.pivots, lone, strict=True)
        )

    def expressions(self) -> tuple[str, ...]:
        """Return each group as a sum, such as ``crank1.Izz + 0.0009 crank1.mass``."""
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
    """Return the base parameters of a regression matrix (rows, p), by pivoted QR.

    Columns that are long enough become pivots in this order: friction; parameters of the platform;
    then, of the legs' bodies, moments and products of inertia, masses (those near the platform
    first), and first moments. Raises EstimationError if the matrix is zero.
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
    # The columns had length one. This converts beta to the units of the parameters.
    combinations[:, seen[others]] = beta * lengths[seen[others]] / lengths[seen[pivots]][:, None]
    order = np.argsort(seen[pivots])
    unseen = tuple(name for k, name in enumerate(names) if k not in seen)
    return BaseParameters(
        names, combinations[order], tuple(int(k) for k in seen[pivots][order]), unseen, gap
    )


@lru_cache(maxsize=8)
def structure(robot: Robot) -> BaseParameters:
    """Return the base parameters of a robot for any motion, from a cache.

    Raises the EstimationError of `structural_regressor`.
    """
    return base_parameters(structural_regressor(robot), robot.layout)


def structural_regressor(robot: Robot, motions: int = MOTIONS, seed: int = 0) -> Array:
    """Return the regression matrix (m * motions, p) of random motions about home.

    Random poses, twists and accelerations excite every parameter that can be excited. The rows of a
    motion are the components of the wrench along the m coordinates in which the platform can move.
    Raises EstimationError if the robot reaches the drawn poses for none of REACH_SHARES, with the
    reason for the smallest.
    """
    rng = np.random.default_rng(seed)
    chart = robot.geometry.chart
    size = float(np.abs(robot.geometry.platform_joints).max())
    draws = chart.lifted(rng.uniform(-1.0, 1.0, (3, motions, len(chart.freedoms))))
    reason: Exception | None = None
    for share in REACH_SHARES:
        ranges = [share * size, TURN * share / REACH_SHARES[0]]
        poses = robot.home_pose + draws[0] * np.repeat(ranges, 3)
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
    """Return the rank of a regression matrix from singular values, with columns of length one."""
    lengths = np.linalg.norm(matrix, axis=0)
    singular = np.linalg.svd(matrix / np.where(lengths > 0, lengths, 1.0), compute_uv=False)
    return int(np.sum(singular > DEPENDENT * singular[0]))


def angle_to_singular_vectors(matrix: Array, found: BaseParameters) -> float:
    """Return the largest angle, rad, between the groups and the row space of a regression matrix.

    The row space of the matrix (rows, p), with columns of length one, is computed from its singular
    vectors. The angle is pi / 2 if the two spaces have different dimensions.
    """
    lengths = np.linalg.norm(matrix, axis=0)
    scale = np.where(lengths > DEPENDENT * lengths.max(), lengths, 1.0)
    groups = found.combinations / scale
    rows = orth((matrix / scale).T, rcond=DEPENDENT)
    if len(groups) != rows.shape[1]:
        return np.pi / 2
    return float(subspace_angles(groups.T, rows).max())


def rank_by_threshold(matrix: Array, threshold: float) -> int:
    """Return the paper's count of base parameters (section 4.2).

    It is the number of diagonal entries of R above `threshold`, in the pivoted QR of the unscaled
    H. The entries have the regressor's units (N or N m per unit of a parameter) and grow with the
    root of the number of samples, so the count depends on units and samples. A count above the rank
    means that the threshold is below the rounding errors.
    """
    # The triangular factor has the same R, and far fewer rows.
    entries = np.diag(qr(triangular_factor(matrix), mode="r", pivoting=True)[0])
    return int(np.sum(np.abs(entries) > threshold))


def reference_regressor(robot: Robot, reference: Reference, rate_hz: float) -> Array:
    """Return the regression matrix H (m n, p) of a reference with n frames, for m coordinates."""
    acceleration, _ = spline_derivatives(reference.rates, rate_hz)
    twist = robot.twist(reference.poses, reference.rates)
    twist_dot = robot.twist_dot(reference.poses, reference.rates, acceleration)
    regressor = robot.geometry.chart.projected(robot.regressor(reference.poses, twist, twist_dot))
    return np.asarray(regressor.reshape(-1, regressor.shape[2]), dtype=float)


def _pivots(columns: Array, preference: NDArray[np.intp]) -> tuple[Array, tuple[float, float]]:
    """Return the indices of the pivots among columns of length one, and `BaseParameters.gap`."""
    remainder = columns.copy()
    smallest = 1.0
    chosen: list[int] = []
    while True:
        lengths = np.linalg.norm(remainder, axis=0)
        longest = float(lengths.max())
        if longest <= DEPENDENT:
            return np.array(chosen), (longest, smallest)
        allowed = np.flatnonzero(lengths >= LONG_ENOUGH * longest)
        # The longest column would depend on the motion, so the one with the lowest number is used.
        pivot = int(allowed[np.argmin(preference[allowed])])
        smallest = min(smallest, float(lengths[pivot]))
        chosen.append(pivot)
        direction = remainder[:, pivot] / lengths[pivot]
        for _ in range(2):  # the second pass removes rounding errors of the first
            remainder -= np.outer(direction, direction @ remainder)
        remainder[:, chosen] = 0.0


def _preferences(layout: ParameterLayout) -> NDArray[np.intp]:
    """Return a number (p,) for each dynamic parameter, the lower the earlier it becomes a pivot."""
    friction, platform, moment, mass = range(4)
    kinds = np.full(len(layout.dynamic_names), friction)
    in_leg = {body: index for bodies in layout.of_leg for index, body in enumerate(bodies)}
    nearest = max(in_leg.values())
    for body, own in enumerate(layout.body_slices):
        names = [name.split(".")[1] for name in layout.rigid_names[own]]
        # The last body of a leg is nearest to the platform, and its mass comes first.
        kinds[own] = moment
        kinds[own.start] = mass + nearest - in_leg.get(body, nearest)
        kinds[own][np.isin(names, FIRST_MOMENTS)] = mass + nearest + 1
    kinds[layout.body_slices[0]] = platform
    return np.asarray(kinds * len(kinds) + np.arange(len(kinds)))


def _coefficient(value: float) -> str:
    return "" if abs(value - 1.0) < 5e-7 else f"{value:.6g} "
