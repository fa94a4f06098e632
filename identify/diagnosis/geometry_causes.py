"""Causes in the geometry: zeros and positions of joints, and axes and lengths of the legs."""

from dataclasses import replace

import numpy as np

from identify.arrays import Array
from identify.diagnosis.cause import (
    Cause,
    OnCommands,
    OnGeometry,
    in_each_run,
    prior_std,
    with_geometry,
)
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.model.loop_model import LoopModel

STEPS = {"m": 1e-5, "rad": 1e-4}  # change of a number for differences, by its unit
# Standard deviation of the zero of a joint in an ordinary workshop, by its unit.
ZERO_STDS = {"m": 1e-4, "rad": 1e-3}
# Geometric numbers that are zeros of joints. A shift of the commands represents them.
ZEROS = ("crank_zero", "zero_length")

# Name of the group of each kind of geometric number.
GROUPS = {
    "base_joint": "places of the base joints",
    "platform_joint": "places of the platform joints",
    "crank_axis": "axes of the cranks",
    "slider_axis": "axes of the sliders",
    "crank_length": "lengths of the cranks",
    "link_length": "lengths of the links",
}


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
            _number(name, unit, np.eye(len(geometry.number_names))[index])
            for index, (name, unit) in enumerate(numbers)
            if name.partition(".")[2] not in ZEROS
        ),
    )


def _zero(joint: int, unit: str) -> Cause:
    """Return the error of a joint's zero. The joint reads too little if the size is positive."""

    def shifted(run: LoopModel, size: float) -> LoopModel:
        # drives whose reading is too small by a value move the joint too far by it
        return replace(run, logged=run.logged + size * np.eye(run.logged.shape[1])[joint])

    def shifts(run: LoopModel, place: int) -> Array:
        return np.broadcast_to(np.eye(run.logged.shape[1])[joint], run.logged.shape)

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
        effect=OnCommands(shifts),
        exact=True,
    )


def _number(name: str, unit: str, direction: Array) -> Cause:
    leg, _, number = name.partition(".")
    kind = number.partition(".")[0]
    cause_name = f"{number.replace('_', ' ').replace('.', ' ')} of {leg.replace('leg', 'leg ')}"

    def moved(problem: OutputErrorProblem, size: float) -> OutputErrorProblem:
        return with_geometry(problem, size * direction)

    return Cause(
        name=cause_name,
        unit=unit,
        group=GROUPS.get(kind, kind.replace("_", " ")),
        change=moved,
        step=STEPS[unit],
        remedy=lambda size: (
            f"change {name} in the robot file by {size:.3g} {unit}, or calibrate the geometry: "
            "cmmsim geometry"
        ),
        effect=OnGeometry(direction),
        exact=True,
    )
