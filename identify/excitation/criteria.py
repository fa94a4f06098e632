"""Criteria of exciting trajectories: what one is, and the paper's, the observability index (eq.
39).

A criterion is a function (robot, scenario, unknowns, typical) -> Criterion, named in
`identify.plugins` or given as ``module:function``. `typical` is the z of a trajectory that excites
everything, from which it may take its scale.

The observability index is the geometric mean of the singular values of H over sqrt(m). Of the p
columns of H only those of the base parameters are independent: H = H_1 C with H_1 the pivot columns
and C the base combinations (rank, p), so the product of the singular values that are not zero is
sqrt(det(H_1^T H_1) det(C C^T)), whichever pivots were chosen:

    ln O_in = (ln det(H_1^T H_1) + ln det(C C^T)) / (2 rank) - ln(m) / 2.

The rank, the paper's zeta, is that of the robot and not of a trajectory, so that all trajectories
are judged on the same subspace. H is not scaled by columns, as in the paper, and like there only
the dynamic parameters count, not the gains of the joint controller.

H_1 is divided by the triangular factor R of one trajectory, which takes out the units of the
parameters and keeps H_1^T H_1 well conditioned. Its inverse is rounded to what all processors agree
on; the constant is that of the rounded one. One period is sampled where a run plays whole ones: the
index does not depend on their number. Another run is sampled from its start to its end.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import cast

import casadi as ca
import numpy as np
from scipy.linalg import qr, solve_triangular

from dynamics import Robot
from identify.arrays import Array, agreed
from identify.errors import ScenarioError, TrajectoryError
from identify.estimation.base_parameters import structure
from identify.excitation.motion import Unknowns, log_determinant, motion, played_times, regressor
from identify.plugins import CRITERIA, Telling, chosen, is_own
from identify.scenario import Scenario
from identify.trajectory import FourierTrajectory

SMOOTHING_RAD_S, SMOOTHING_M_S = 0.02, 0.002
"""v_s in tanh(theta_dot / v_s) where derivatives are asked for: as much as a velocity changes
between two samples.
"""


def smoothing_of(robot: Robot) -> float:
    """v_s for a robot's actuators, rad/s or m/s."""
    return SMOOTHING_M_S if robot.layout.prismatic else SMOOTHING_RAD_S


@dataclass(frozen=True)
class Criterion:
    """What searches maximise: value, z -> its logarithm; smooth, as value, but with derivatives
    everywhere.

    judge: what ranks the few trajectories that a gradient search ends in, where there is something
    better than value; larger is better, and TrajectoryError where a trajectory cannot be judged.
    """

    value: ca.Function
    smooth: ca.Function
    judge: Callable[[FourierTrajectory], float] | None = None


def criterion_of(robot: Robot, scenario: Scenario, unknowns: Unknowns, typical: Array) -> Criterion:
    """The scenario's criterion. Raises ScenarioError, with the valid names, where there is none of
    its name.
    """
    name = scenario.excitation.criterion
    make = chosen(name, "excitation.criterion", CRITERIA)
    if is_own(name):
        known = (ScenarioError, TrajectoryError)
        part = f"excitation.criterion {name!r}"
        make = Telling(part, make, ScenarioError, known, _check_made)
        made: Criterion = make(robot, scenario, unknowns, typical)
        judge = made.judge and Telling(
            f"judge of {part}", made.judge, ScenarioError, known, _judged
        )
        return replace(made, judge=judge)
    return cast(Criterion, make(robot, scenario, unknowns, typical))


def _check_made(
    part: str, made: object, robot: Robot, scenario: Scenario, unknowns: Unknowns, typical: Array
) -> None:
    """Raise ScenarioError unless a criterion of a user's own is one of these unknowns."""
    if not isinstance(made, Criterion):
        raise ScenarioError(f"{part} must return a Criterion, returned {type(made).__name__}")
    for name in ("value", "smooth"):
        function = getattr(made, name)
        wanted = f"{part} must have a CasADi function {name} of z ({unknowns.size},) to one number"
        if not isinstance(function, ca.Function):
            raise ScenarioError(f"{wanted}, has {type(function).__name__}")
        sizes = (function.n_in(), function.n_out())
        if sizes != (1, 1) or function.numel_in(0) != unknowns.size or function.numel_out(0) != 1:
            raise ScenarioError(f"{wanted}, has {function}")
        if np.isnan(float(function(typical))):
            raise ScenarioError(f"{wanted}, which is NaN at an admissible trajectory")
    if made.judge is not None and not callable(made.judge):
        raise ScenarioError(f"{part} must have a function for judge, or None")


def _judged(part: str, value: object, trajectory: FourierTrajectory) -> None:
    """Raise ScenarioError unless a judgement is a number."""
    if not isinstance(value, (int, float, np.number)) or not np.isfinite(value):
        raise ScenarioError(f"{part} must return a finite number, returned {value!r}")


def observability(
    robot: Robot, scenario: Scenario, unknowns: Unknowns, typical: Array
) -> Criterion:
    """The observability index (eq. 39) of the run that the scenario plays."""
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
    """z -> ln O_in (eq. 39) of a run of `duration_s`; -inf or NaN where it is too short to show
    every base parameter.

    `typical` is the z of a trajectory that excites everything; it only sets the scale. `smoothing`
    [rad/s or m/s] smooths the sign of Coulomb friction, which makes the function differentiable.
    """
    base = structure(robot)
    times = played_times(unknowns.fundamental_hz, unknowns.harmonics, duration_s)
    z = ca.MX.sym("z", unknowns.size)
    if unknowns.coordinates * len(times) < base.rank:
        return ca.Function("log_observability", [z], [ca.MX(-np.inf)], ["z"], ["value"])
    sampled = regressor(robot, smoothing, "wrench").map(len(times))(*motion(unknowns, z, times))
    columns = ca.Function("pivots", [z], [sampled[list(base.pivots), :]])
    index = log_index(columns(z), base.combinations, np.array(columns(typical)), len(times))
    return ca.Function("log_observability", [z], [index], ["z"], ["value"])


def log_index(columns: ca.MX, combinations: Array, typical: Array, samples: int) -> ca.MX:
    """ln O_in (eq. 39) of H = columns^T combinations over `samples` poses.

    `columns` (rank, rows) is H_1 transposed, `combinations` (rank, p) is C; `typical` is as
    `columns`, of full rank.
    """
    rank = len(combinations)
    lengths = 2.0 ** np.rint(np.log2(np.linalg.norm(typical, axis=1)))
    factor = qr((typical / lengths[:, None]).T, mode="r")[0][:rank]
    inverse = agreed(solve_triangular(factor, np.eye(rank))) / lengths[:, None]
    scaled = ca.DM(inverse.T) @ columns
    constant = np.linalg.slogdet(combinations @ combinations.T)[1]
    constant -= 2 * np.log(np.abs(np.diag(inverse))).sum()
    determinant = log_determinant(rank)(scaled @ scaled.T)
    return (determinant + float(agreed(constant))) / (2 * rank) - np.log(samples) / 2


def observability_index(logarithm: ca.Function, z: Array) -> float:
    """O_in (eq. 39) of a trajectory's z by `log_observability`; 0 where a base parameter does not
    show.
    """
    value = float(logarithm(z))
    return 0.0 if np.isnan(value) else float(np.exp(value))
