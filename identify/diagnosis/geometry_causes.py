"""Causes in the geometry: zeros of the joints, and places, axes and lengths of the legs.

A robot with other numbers moves under the same commands. Its column follows without a run of it.
At the same joint coordinates the pose is off by what closes the loops, J_g. A run begins at the
pose of rest, where the joints then are at other coordinates by d, and the drives take them from
there to where the commands want them. That response is known from the zeros of the joints, whose
columns Z have the same one: a joint whose zero is off by s begins at its command less s. So

    column = J_g + (J_theta - Z) d,    d = -J_theta^-1 J_g at the first pose.

What the changed lever arms do to the torques is left out. It shows in the fit, where the robot
itself is moved.
"""

from dataclasses import replace

import numpy as np

from dynamics.closure import Closure
from identify.arrays import Array
from identify.diagnosis.cause import Cause, in_each_run, pose_columns, prior_std, with_geometry
from identify.estimation.output_error import OutputErrorProblem
from identify.model.loop_model import LoopModel
from identify.runtime import in_threads

STEPS = {"m": 1e-5, "rad": 1e-4}
"""Change of a number for differences, by its unit."""

ZERO_STDS = {"m": 1e-4, "rad": 1e-3}
"""Standard deviation of the zero of a joint in an ordinary workshop, by its unit."""

ZEROS = ("crank_zero", "zero_length")
"""Numbers that are zeros of joints, which a shift of the commands stands for."""

GROUPS = {
    "base_joint": "places of the base joints",
    "platform_joint": "places of the platform joints",
    "crank_axis": "axes of the cranks",
    "slider_axis": "axes of the sliders",
    "crank_length": "lengths of the cranks",
    "link_length": "lengths of the links",
}
"""Names of the groups of numbers, by their kinds."""


def geometry_causes(problem: OutputErrorProblem) -> tuple[Cause, ...]:
    """Return the zeros of the joints, then the other geometric numbers of a problem's robot."""
    robot = problem.runs[0].robot
    joints = robot.layout.joints
    unit = robot.layout.joint_unit
    geometry = robot.geometry
    numbers = zip(geometry.number_names, geometry.number_units, strict=True)
    return (
        *(_zero(joint, unit) for joint in range(joints)),
        *(
            _number(name, unit, joints + place, np.eye(len(geometry.number_names))[place])
            for place, (name, unit) in enumerate(numbers)
            if name.partition(".")[2] not in ZEROS
        ),
    )


def _zero(joint: int, unit: str) -> Cause:
    """Return the zero of a joint, which reads less than it should where the size is positive."""

    def shifted(run: LoopModel, size: float) -> LoopModel:
        # drives that read less by a value go further by it
        return replace(run, logged=run.logged + size * np.eye(run.logged.shape[1])[joint])

    return Cause(
        name=f"zero of joint {joint + 1}",
        unit=unit,
        group="zeros of the joints",
        change=in_each_run(shifted),
        step=STEPS[unit],
        remedy=lambda size: (
            f"--set model.joint_zero_std_{unit}={prior_std(size, ZERO_STDS[unit]):g}; cmmsim "
            "geometry finds all zeros from poses at rest"
        ),
        quick=(geometry_columns, joint),
    )


def _number(name: str, unit: str, place: int, direction: Array) -> Cause:
    leg, _, number = name.partition(".")
    kind = number.partition(".")[0]
    words = f"{number.replace('_', ' ').replace('.', ' ')} of {leg.replace('leg', 'leg ')}"

    def moved(problem: OutputErrorProblem, size: float) -> OutputErrorProblem:
        return with_geometry(problem, size * direction)

    return Cause(
        name=words,
        unit=unit,
        group=GROUPS.get(kind, kind.replace("_", " ")),
        change=moved,
        step=STEPS[unit],
        remedy=lambda size: (
            f"change {name} in the robot file by {size:.3g} {unit}, or calibrate the geometry: "
            "cmmsim geometry"
        ),
        quick=(geometry_columns, place),
        deviations=direction,
    )


def geometry_columns(problem: OutputErrorProblem, parameters: Array) -> Array:
    """Return the columns (m, n + g) of the zeros of n joints, then of all geometric numbers."""
    changes = []
    for run in problem.runs:
        by_zeros = _zero_poses(run, parameters)
        by_numbers = _moved_poses(run, run.model_poses(parameters), by_zeros)
        changes.append(np.concatenate([by_zeros, by_numbers], axis=2))
    return pose_columns(problem, parameters, changes)


def _moved_poses(run: LoopModel, poses: Array, by_zeros: Array) -> Array:
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


def _zero_poses(run: LoopModel, parameters: Array) -> Array:
    """Return derivatives (N, 6, n) of a run's poses with respect to the zeros of the joints."""
    layout = run.robot.layout
    step = STEPS[layout.joint_unit]
    ends = [
        replace(run, logged=run.logged + by)
        for one in np.eye(layout.joints)
        for by in (step * one, -step * one)
    ]
    poses = in_threads(lambda end: end.model_poses(parameters), ends)
    pairs = zip(poses[::2], poses[1::2], strict=True)
    return np.stack([(more - less) / (2 * step) for more, less in pairs], axis=2)
