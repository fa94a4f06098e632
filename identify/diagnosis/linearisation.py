"""Linearisation of a problem with causes: residuals, and their columns by parameters and causes.

One run of the model is differentiated with respect to the parameters and the gains of each joint,
and along all directions of the commands that causes have. A torque that joints need beside those of
the model is a direction, too (`identify.model.joint_torques`). So are the zeros of the joints.

The column of a geometric number follows without a run of a robot with that number. Let J_g and X be
the derivatives of the pose with respect to the number and to the joint coordinates, both with
closed loops. A run of such a robot begins at the same pose of rest, so that its joint coordinates
differ by d. The drives then move the joints by -d, to where the commands want them. The columns Z
of the zeros of the joints contain the same response: a joint whose zero is off by s begins at its
command less s.

    column = J_g + (X - Z) d,    d = -X^-1 J_g at the first pose

The effect of changed lever arms on the torques is left out.

A change of measured poses is a column by itself. All other columns are differences of runs.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dynamics import DynamicsError
from dynamics.closure import Closure
from dynamics.parameters import JOINT_PID
from identify.arrays import Array
from identify.diagnosis.cause import (
    Cause,
    Effect,
    OnCommands,
    OnGain,
    OnGeometry,
    OnPoses,
    OnTorques,
    with_causes,
)
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.model.error_modes import differentiated
from identify.model.loop_model import LoopModel
from identify.model.unequal_gains import UnequalGains, with_unequal_gains
from identify.runtime import in_threads


@dataclass(frozen=True)
class Linearisation:
    """Residuals (m,) of a problem, with their columns by parameters (m, p) and causes (m, k).

    Rows of what is known beside the poses come first, then those of each run. The column of a cause
    is NaN if the model is unstable on both sides of the size, and zero if it has no derivative.
    """

    residual: Array
    by_parameters: Array
    by_causes: Array


def linearisation(
    problem: OutputErrorProblem,
    parameters: Array,
    causes: Sequence[Cause],
    sizes: Array,
    asked: Sequence[int],
    step: float = 1.0,
) -> Linearisation:
    """Return the linearisation of a problem with causes at parameters (p,) and sizes (k,).

    asked: indices of the causes whose columns are wanted. step: step of differences, in units of
    the causes' steps. Raises LoopFailure if the model is unstable.
    """
    there = with_causes(problem, causes, sizes)
    known, known_rows = there.known(parameters)
    residual = [known]
    by_parameters = [known_rows]
    by_causes = [np.zeros((len(known), len(asked)))]
    effects = [causes[place].effect for place in asked]
    for place, run in enumerate(there.runs):
        missed, slopes, columns = _of_run(run, place, parameters, effects)
        residual.append(missed.ravel())
        by_parameters.append(slopes)
        by_causes.append(columns)
    linear = Linearisation(np.concatenate(residual), np.vstack(by_parameters), np.vstack(by_causes))
    by_differences = [
        k
        for k, place in enumerate(asked)
        # a cause with trial sizes has no derivative at size zero
        if causes[place].differentiable and (sizes[place] or not causes[place].tried)
    ]
    places = [asked[k] for k in by_differences]
    differences = _differences(problem, parameters, causes, sizes, places, step, linear.residual)
    for k, column in zip(by_differences, differences, strict=True):
        linear.by_causes[:, k] = column
    return linear


def _of_run(
    run: LoopModel, place: int, parameters: Array, effects: Sequence[Effect | None]
) -> tuple[Array, Array, Array]:
    """Return residuals (n, 6) of a run's good frames, and their columns (6 n, p) and (6 n, k).

    place: index of the run. effects: those of the k causes.
    """
    joints = run.robot.layout.joints
    geometric = [k for k, one in enumerate(effects) if isinstance(one, OnGeometry)]
    gains = [k for k, one in enumerate(effects) if isinstance(one, OnGain)]
    driven, directions = _directions(run, place, parameters, effects)
    if geometric:
        zeros = np.broadcast_to(np.eye(joints), (len(run.logged), joints, joints))
        directions = np.concatenate([directions, zeros], axis=2)
    model = with_unequal_gains(run, np.zeros((joints, len(JOINT_PID)))) if gains else run
    found, by_commands = differentiated(model, parameters, directions)
    sensitivity = found.pose_sensitivity
    assert sensitivity is not None
    changes = np.zeros((*found.pose.shape, len(effects)))
    if isinstance(model, UnequalGains):
        sensitivity, by_gains = model.by_gains(sensitivity)
        for k in gains:
            one = effects[k]
            assert isinstance(one, OnGain)
            changes[:, :, k] = by_gains[:, :, one.joint, one.kind]
    changes[:, :, driven] = by_commands[:, :, : len(driven)]
    if geometric:
        by_numbers = geometry_changes(run, found.pose, by_commands[:, :, len(driven) :])
        deviations = [one.deviations for one in effects if isinstance(one, OnGeometry)]
        changes[:, :, geometric] = by_numbers @ np.stack(deviations, axis=1)
    for k, one in enumerate(effects):
        if isinstance(one, OnPoses):
            changes[:, :, k] = one.changes(run, place)
    rows = np.concatenate([sensitivity, changes], axis=2)[run.ok]
    shown = sensitivity.shape[2]
    white = run.without_common(np.asarray(run.whitener @ rows))
    slopes = run.of_all(white[:, :, :shown])
    missed = run.without_common(run.run_residuals(found))
    return missed, slopes.reshape(missed.size, -1), white[:, :, shown:].reshape(missed.size, -1)


def _directions(
    run: LoopModel, place: int, parameters: Array, effects: Sequence[Effect | None]
) -> tuple[list[int], Array]:
    """Return the indices of effects on commands and torques, and their directions (N, n, k)."""
    commands = {k: one for k, one in enumerate(effects) if isinstance(one, OnCommands)}
    torques = {k: one for k, one in enumerate(effects) if isinstance(one, OnTorques)}
    parts = [np.zeros((*run.logged.shape, 0))]
    if commands:
        parts.append(np.stack([one.changes(run, place) for one in commands.values()], axis=2))
    if torques:
        needed = np.stack([one.torques[place] for one in torques.values()], axis=1)
        added = run.commands_for(needed, run.drive_law(parameters))
        parts.append(-added.transpose(0, 2, 1))
    return [*commands, *torques], np.concatenate(parts, axis=2)


def geometry_changes(run: LoopModel, poses: Array, by_zeros: Array) -> Array:
    """Return derivatives (N, 6, g) of a run's poses (N, 6) with respect to the geometric numbers.

    by_zeros (N, 6, n): derivatives with respect to the zeros of the joints.
    """
    robot = run.robot
    chart = robot.geometry.chart
    nominal = robot.functions_of
    poses = chart.pose(chart.coordinates(poses))
    by_numbers, by_joints = (
        chart.lifted(part, axis=1)
        for part in Closure(nominal).derivatives(
            poses, robot.inverse_kinematics(poses), robot.geometry.deviations_from(nominal)
        )
    )
    begin = -np.linalg.pinv(by_joints[0]) @ by_numbers[0]
    return np.asarray(by_numbers + (by_joints - by_zeros) @ begin)


def _differences(
    problem: OutputErrorProblem,
    parameters: Array,
    causes: Sequence[Cause],
    sizes: Array,
    places: Sequence[int],
    step: float,
    residual: Array,
) -> list[Array | float]:
    """Return the central difference (m,) for each cause at `places`.

    It is one-sided at the least size, and where the model is unstable on one side. It is NaN where
    the model is unstable on both. residual (m,): residuals at the sizes.
    """
    steps = [step * causes[k].step for k in places]
    spans = [
        (max(-own, causes[k].least - sizes[k]), own) for k, own in zip(places, steps, strict=True)
    ]
    moves = np.eye(len(causes))[list(places)]
    # a cause at its least size is not moved down, and the residuals there are known
    ends = [
        with_causes(problem, causes, sizes + by * move)
        for span, move in zip(spans, moves, strict=True)
        for by in span
        if by
    ]
    found = iter(each_residuals(ends, parameters))
    slopes = []
    for low, high in spans:
        less = next(found) if low else residual
        more = next(found) if high else residual
        slopes.append(_slope(residual, less, more, low, high))
    return slopes


def _slope(
    residual: Array, less: Array | None, more: Array | None, low: float, high: float
) -> Array | float:
    """Return the slope between residuals (m,) at two changes of size. None stands for no change."""
    if less is None:
        less, low = residual, 0.0
    if more is None:
        more, high = residual, 0.0
    return (more - less) / (high - low) if high > low else np.nan


def residuals(problem: OutputErrorProblem, parameters: Array) -> Array:
    """Return all residuals (m,): of what is known beside the poses, then of each run.

    Raises LoopFailure if the model is unstable.
    """
    known, _ = problem.known(parameters)
    return np.concatenate([known, *(run.residuals(parameters).ravel() for run in problem.runs)])


def each_residuals(problems: Sequence[OutputErrorProblem], parameters: Array) -> list[Array | None]:
    """Return the `residuals` (m,) of each problem at `allowed` parameters, None if unstable."""

    def of(problem: OutputErrorProblem) -> Array | None:
        try:
            return residuals(problem, allowed(problem, parameters))
        except DynamicsError:
            return None

    return [*in_threads(of, problems)]


def allowed(problem: OutputErrorProblem, parameters: Array) -> Array:
    """Return parameters (p,), raised to their lower bounds where they must be above zero."""
    bounds = problem.bounds
    above = np.isin(bounds.layout.names, problem.guess.above_zero)
    return np.where(above, np.maximum(parameters, bounds.lower), parameters)
