"""Criteria of exciting trajectories, among them the paper's observability index (eq. 39).

A criterion is a function (robot, scenario, unknowns, typical) -> Criterion, named in
`identify.own_parts` or given as ``module:function``. `typical` is the z of a trajectory that
excites all parameters. It can be used to scale the criterion.

Let H be the stacked regressor of N samples, with one column for each of the p parameters. The
observability index is the geometric mean of the nonzero singular values of H, divided by sqrt(N).
Only the columns of the base parameters are linearly independent: H = H_1 C with the pivot columns
H_1 and the base combinations C (rank, p). The product of the nonzero singular values is therefore
sqrt(det(H_1^T H_1) det(C C^T)), for any choice of pivots, and

    ln O_in = (ln det(H_1^T H_1) + ln det(C C^T)) / (2 rank) - ln(N) / 2.

The rank (zeta in the paper) depends on the robot and not on the trajectory, so all trajectories are
judged on the same subspace. As in the paper, the columns of H are not scaled, and the gains of the
joint controller are not included.

H_1 is divided by a triangular matrix R, the factor of the QR factorisation of H_1 for the
trajectory `typical`. This removes the units of the parameters and makes H_1^T H_1 well conditioned.
The inverse of R is rounded to numbers on which all processors agree. To keep the index unchanged,
twice the logarithm of the determinant of this rounded inverse is subtracted from ln det.

A run of whole periods is sampled over one period, because the index does not depend on the number
of periods. Any other run is sampled from start to end.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, cast

import casadi as ca
import numpy as np
from scipy.linalg import qr, solve_triangular

from dynamics import Robot
from identify.arrays import Array, agreed
from identify.errors import ScenarioError, TrajectoryError
from identify.estimation.base_parameters import structure
from identify.excitation.trajectory_unknowns import (
    Unknowns,
    log_determinant,
    motion,
    regressor,
    run_times,
)
from identify.own_parts import CRITERIA, PluginFunction, chosen, is_plugin_name
from identify.scenario import Scenario
from identify.trajectory import FourierTrajectory

# Velocity v_s in tanh(theta_dot / v_s), a differentiable replacement of the sign. A velocity
# changes by about this amount between two samples.
SMOOTHING_RAD_S = 0.02
SMOOTHING_M_S = 0.002


def smoothing_of(robot: Robot) -> float:
    """Return v_s for a robot's actuators, rad/s or m/s."""
    return SMOOTHING_M_S if robot.layout.prismatic else SMOOTHING_RAD_S


@dataclass(frozen=True)
class Criterion:
    """Objective of a search.

    value   Function z -> logarithm of the criterion.
    smooth  Differentiable approximation of `value`.
    judge   More accurate measure, or None for `value`, that ranks the results of a gradient search.
            Larger is better. It raises TrajectoryError for a trajectory that cannot be judged.
    """

    value: ca.Function
    smooth: ca.Function
    judge: Callable[[FourierTrajectory], float] | None = None


def criterion_of(robot: Robot, scenario: Scenario, unknowns: Unknowns, typical: Array) -> Criterion:
    """Return the scenario's criterion.

    Raises ScenarioError, with the valid names, if there is no criterion of this name, and for a
    user's own function that makes no valid criterion.
    """
    name = scenario.excitation.criterion
    make = chosen(name, "excitation.criterion", CRITERIA)
    if is_plugin_name(name):
        known = (ScenarioError, TrajectoryError)
        part = f"excitation.criterion {name!r}"
        make = PluginFunction(part, make, ScenarioError, known, _check_criterion)
        criterion: Criterion = make(robot, scenario, unknowns, typical)
        judge = criterion.judge and PluginFunction(
            f"judge of {part}", criterion.judge, ScenarioError, known, _check_judgement
        )
        return replace(criterion, judge=judge)
    return cast(Criterion, make(robot, scenario, unknowns, typical))


def _check_criterion(part: str, returned: object, *given: Any) -> None:
    """Raise ScenarioError if the object that a user's own function returned is no criterion of z.

    given: arguments of the function, which are robot, scenario, unknowns and typical z.
    """
    unknowns, typical = given[2:]
    if not isinstance(returned, Criterion):
        raise ScenarioError(f"{part} must return a Criterion, returned {type(returned).__name__}")
    for name in ("value", "smooth"):
        function = getattr(returned, name)
        wanted = f"{part} must have a CasADi function {name} of z ({unknowns.size},) to one number"
        if not isinstance(function, ca.Function):
            raise ScenarioError(f"{wanted}, but has {type(function).__name__}")
        counts = (function.n_in(), function.n_out())
        if counts != (1, 1) or function.numel_in(0) != unknowns.size or function.numel_out(0) != 1:
            raise ScenarioError(f"{wanted}, but has {function}")
        if np.isnan(float(function(typical))):
            raise ScenarioError(f"{wanted}, but its value is NaN at an admissible trajectory")
    if returned.judge is not None and not callable(returned.judge):
        raise ScenarioError(f"{part} must have a function for judge, or None")


def _check_judgement(part: str, value: object, trajectory: FourierTrajectory) -> None:
    """Raise ScenarioError if the value of a user's own judge is not a finite number."""
    if not isinstance(value, (int, float, np.number)) or not np.isfinite(value):
        raise ScenarioError(f"{part} must return a finite number, returned {value!r}")


def observability(
    robot: Robot, scenario: Scenario, unknowns: Unknowns, typical: Array
) -> Criterion:
    """Return the observability index (eq. 39) of the scenario's run as a criterion."""
    duration_s = scenario.excitation.duration_s
    value, smooth = (
        log_observability(robot, unknowns, duration_s, typical, v)
        for v in (None, smoothing_of(robot))
    )
    return Criterion(value, smooth)


def log_observability(
    robot: Robot,
    unknowns: Unknowns,
    duration_s: float,
    typical: Array,
    smoothing: float | None = None,
) -> ca.Function:
    """Return the function z -> ln O_in (eq. 39) of a run of `duration_s`.

    Its value is -inf or NaN if the run is too short to identify every base parameter. `typical` is
    the z of a trajectory that excites all parameters. It is used only for scaling. `smoothing`
    [rad/s or m/s] smooths the sign of Coulomb friction and makes the function differentiable.
    """
    base = structure(robot)
    times = run_times(unknowns.fundamental_hz, unknowns.harmonics, duration_s)
    z = ca.MX.sym("z", unknowns.size)
    # Fewer equations than base parameters make the determinant zero.
    if unknowns.coordinates * len(times) < base.rank:
        return ca.Function("log_observability", [z], [ca.MX(-np.inf)], ["z"], ["value"])
    sampled = regressor(robot, smoothing, "wrench").map(len(times))(*motion(unknowns, z, times))
    columns = ca.Function("pivots", [z], [sampled[list(base.pivots), :]])
    index = log_index(columns(z), base.combinations, np.array(columns(typical)), len(times))
    return ca.Function("log_observability", [z], [index], ["z"], ["value"])


def log_index(columns: ca.MX, combinations: Array, typical: Array, samples: int) -> ca.MX:
    """Return ln O_in (eq. 39) of H = columns^T combinations over `samples` poses.

    `columns` (rank, rows) is H_1 transposed, `combinations` (rank, p) is C. `typical` has the shape
    of `columns` and full rank.
    """
    rank = len(combinations)
    # Powers of two scale without rounding.
    scales = 2.0 ** np.rint(np.log2(np.linalg.norm(typical, axis=1)))
    factor = qr((typical / scales[:, None]).T, mode="r")[0][:rank]
    inverse = _rounded_triangle(solve_triangular(factor, np.eye(rank))) / scales[:, None]
    scaled = ca.DM(inverse.T) @ columns
    constant = np.linalg.slogdet(combinations @ combinations.T)[1]
    constant -= 2 * np.log(np.abs(np.diag(inverse))).sum()
    determinant = log_determinant(rank)(scaled @ scaled.T)
    return (determinant + float(agreed(constant))) / (2 * rank) - np.log(samples) / 2


def _rounded_triangle(inverse: Array) -> Array:
    """Round an inverse triangular factor by `agreed`, without making it singular.

    If a motion hardly excites some parameter, entries can be so large that other diagonal entries
    would be rounded to zero. Such a diagonal entry is rounded relative to its own size.
    """
    rounded = agreed(inverse)
    for k in np.flatnonzero(np.diag(rounded) == 0.0):
        rounded[k, k] = agreed(inverse[k, k : k + 1])[0]
    return rounded


def observability_index(logarithm: ca.Function, z: Array) -> float:
    """Return O_in (eq. 39) of a trajectory's z from the function of `log_observability`.

    It is 0 if a base parameter is not excited.
    """
    value = float(logarithm(z))
    return 0.0 if np.isnan(value) else float(np.exp(value))
