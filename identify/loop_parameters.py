"""Closed loop around a plant or a model: its settings and its parameters."""

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import ceil
from pathlib import Path
from typing import Any, cast

import numpy as np

from dynamics import Robot
from dynamics.closed_loop import (
    Drives,
    FrameTiming,
    FrictionLaw,
    LoopSettings,
    ServoGains,
    stability,
)
from dynamics.closed_loop.drives import DRIVES, DriveName
from dynamics.errors import DynamicsError, ParameterError
from dynamics.parameter_units import of_all_legs
from dynamics.parameters import JOINT_PID, may_be_absent
from identify.arrays import Array
from identify.errors import RecordError, ScenarioError
from identify.files.run_folder import load_result
from identify.scenario import Model, Plant, Timing
from identify.scenario.loop_sections import Control, Servo
from identify.scenario.payload import Payload
from identify.scenario.plant_sections import FILTERED
from identify.scenario.section import ACTUATOR_KEYS, Section

NOMINAL = "guess"  # default parameter set


def loop_settings(
    robot: Robot, servo: Servo, timing: Timing, control: Control, side: Plant | Model
) -> LoopSettings:
    """Return the settings of the loop around the plant or the model.

    The latency is the mean latency. Friction law, drive law and integration steps come from `side`,
    the plant or the model. A model takes more steps than it states if the robot needs them. The
    torque limit comes from `control`.

    Raises ScenarioError if only the key for sliding actuators is set but the robot's actuators
    turn, or the reverse.
    """
    smoothing = of_actuators(robot, side, "smoothing_velocity")
    stribeck = of_actuators(robot, side, "stribeck_velocity")
    return LoopSettings(
        servo=ServoGains(servo.kp, servo.kd, servo.ki),
        timing=FrameTiming(timing.frame_rate_hz, timing.latency_s, timing.hold),
        friction=FrictionLaw(side.friction, smoothing, side.static_ratio, stribeck),
        steps_per_frame=_steps_per_frame(robot, side, timing.frame_period_s),
        drives=drives_of(side, of_actuators(robot, control, "torque_limit")),
    )


# Longest integration step of a model, as a fraction of the time constant of its fastest motion.
LONGEST_STEP = 0.3


def _steps_per_frame(robot: Robot, side: Plant | Model, period: float) -> int:
    """Return the integration steps per frame of length `period`, s.

    A model has at least as many steps as the fastest motion of the robot needs at home, with the
    parameters of the initial guess.
    """
    if not isinstance(side, Model) or side.start_parameters not in robot.parameter_sets:
        return side.steps_per_frame
    try:
        needed = _steps_at_start(robot, side.start_parameters, drives_of(side, None), period)
    except DynamicsError:
        # a run of the model raises the same error with more detail
        return side.steps_per_frame
    return max(side.steps_per_frame, needed)


@lru_cache(maxsize=64)
def _steps_at_start(robot: Robot, set_name: str, drives: Drives, period: float) -> int:
    return steps_needed(robot, robot.parameter_sets[set_name].vector, drives, period)


def steps_needed(robot: Robot, parameters: Array, drives: Drives, period: float) -> int:
    """Return the integration steps per `period`, s, that the fastest motion at home needs.

    parameters (p + g,): dynamic parameters and gains.
    """
    rate = stability.fastest_rate(robot, parameters, drives, robot.home_pose)
    return ceil(rate * period / LONGEST_STEP)


def drives_of(side: Plant | Model, torque_limit: float | None) -> Drives:
    """Return the drives of the plant or the model with a torque limit, N m or N."""
    law = side.drive_law
    filter_time = side.derivative_filter_s if law == FILTERED else None
    return Drives(torque_limit=torque_limit, law=law, filter_time=filter_time)


def settled_drive(identification: Any) -> DriveName:
    """Return the drive law of an identification entry of a result, by default PID.

    Raises RecordError for an unknown law.
    """
    drive = identification.get("drive") if isinstance(identification, dict) else None
    law = drive.get("law") if isinstance(drive, dict) else "pid"
    if law not in DRIVES:
        raise RecordError(f"identification.drive.law is {law!r}; valid: {', '.join(DRIVES)}")
    return cast("DriveName", law)


def check_parameter_set(robot: Robot, set_name: str) -> None:
    """Raise ScenarioError, with the valid names, if the robot file has no such parameter set."""
    if set_name not in robot.parameter_sets:
        valid = ", ".join(sorted(robot.parameter_sets))
        raise ScenarioError(
            f"robot {robot.name} has no parameter set {set_name!r}; it has {valid}: name one as "
            "the true robot of a simulated run with --set plant.parameters=guess, or as the "
            "initial guess with model.start_parameters"
        )


def of_actuators(robot: Robot, section: Section, name: str) -> Any:
    """Return the value of a setting with one key for turning and one for sliding actuators.

    Raises ScenarioError if only the key for the other kind of actuators is set. The message names
    both keys.
    """
    turning, sliding = ACTUATOR_KEYS[name]
    own, other = (sliding, turning) if robot.layout.prismatic else (turning, sliding)
    if (
        other in section.model_fields_set
        and own not in section.model_fields_set
        and getattr(section, other) is not None
    ):
        raise ScenarioError(
            f"{type(section).__name__.lower()}.{other} = {getattr(section, other)} is for "
            f"actuators that {'turn' if robot.layout.prismatic else 'slide'}; the actuators of "
            f"{robot.name} {'slide' if robot.layout.prismatic else 'turn'}: set {own}"
        )
    return getattr(section, own)


def in_form(robot: Robot, side: Plant | Model) -> Robot:
    """Return the robot with the bodies and the passive friction that the plant or model states.

    Bodies without a statement stay as they are. Joints share their gains, or each has its own, as
    the plant or the model states. Raises ScenarioError, with the valid names, for a body or a
    passive joint that the robot does not have, and for shared gains that are unequal.
    """
    robot = _with_gains(robot, side)
    if side.passive_friction is not None:
        try:
            robot = robot.with_passive_friction(side.passive_friction)
        except ParameterError as error:
            raise ScenarioError(
                f"{type(side).__name__.lower()}.passive_friction: {error}"
            ) from None
    if side.inertia is None:
        return robot
    layout = robot.layout
    kinds = [kind.name for kind in layout.kinds]
    stated = dict.fromkeys(kinds, side.inertia) if isinstance(side.inertia, str) else side.inertia
    for name in stated:
        if name not in (*kinds, *layout.bodies):
            valid = ", ".join(dict.fromkeys(kinds))
            raise ScenarioError(
                f"{type(side).__name__.lower()}.inertia names {name!r}; {robot.name} has {valid}, "
                f"or single bodies such as {layout.bodies[-1]}"
            )
    forms = [
        stated.get(body, stated.get(kind, "full" if full else "centred"))
        for body, kind, full in zip(layout.bodies, kinds, layout.full, strict=True)
    ]
    names = [body for body, form in zip(layout.bodies, forms, strict=True) if form == "full"]
    return robot.with_full_bodies(names)


def carrying(robot: Robot, load: Payload, anchor: str) -> Robot:
    """Return the robot, with a full body as platform if the load is off the platform's origin.

    anchor: scale anchor. There is a load only with the anchor payload.
    """
    full = robot.layout.full_bodies
    if anchor != "payload" or not load.off_origin or "platform" in full:
        return robot
    return robot.with_full_bodies((*full, "platform"))


def _with_gains(robot: Robot, side: Plant | Model) -> Robot:
    """Return the robot with shared gains, or gains of each joint, as the plant or the model states.

    Raises ScenarioError if the gains are shared, but unequal in the parameter set of this side.
    """
    own = side.gains == "each"
    layout = robot.layout
    if own == layout.own_gains:
        return robot
    set_name = side.parameters if isinstance(side, Plant) else side.start_parameters
    if not own and set_name in robot.parameter_sets:
        gains = layout.each_gains(robot.parameter_sets[set_name].joint_pid)
        joint, kind = np.unravel_index(np.argmax(np.abs(gains - gains[0])), gains.shape)
        if gains[joint, kind] != gains[0, kind]:
            where = type(side).__name__.lower()
            names = [f"joint{k + 1}.{JOINT_PID[kind]} = {gains[k, kind]:g}" for k in (0, joint)]
            raise ScenarioError(
                f"{where}.gains = 'shared', but the parameter set {set_name!r} of robot "
                f"{robot.name} has {' and '.join(names)}: set {where}.gains = 'each'"
            )
    return robot.with_own_gains(own)


def known_value(values: Mapping[str, float], name: str) -> float | None:
    """Return the value of a parameter by name, also if `values` have another form of parameters.

    A first moment or product of inertia without a value is zero. If a gain or a passive friction of
    one joint has no value, the shared value is returned. If the shared one has no value, the mean
    over the joints is returned. Without any value, a passive friction is zero. In all other cases
    without a value, the result is None.
    """
    if name in values:
        return float(values[name])
    owner, _, entry = name.rpartition(".")
    if may_be_absent(name):
        of_all = of_all_legs(name)
        total = sum(float(value) for one, value in values.items() if of_all_legs(one) == name)
        count = sum(one.startswith("joint") and one.endswith(".coulomb") for one in values)
        return float(values.get(of_all, total / max(count, 1)))
    if entry not in JOINT_PID:
        return None
    if owner != "joint_pid":
        shared = values.get(f"joint_pid.{entry}")
        return None if shared is None else float(shared)
    of_joints = [float(value) for one, value in values.items() if one.rpartition(".")[2] == entry]
    if not of_joints:
        return None
    # the mean of equal numbers can differ from them in the last digit
    return of_joints[0] if len(set(of_joints)) == 1 else float(np.mean(of_joints))


def is_gain(name: str) -> bool:
    """Return True for a gain of the joint PID, shared or of one joint."""
    return name.rpartition(".")[2] in JOINT_PID


@dataclass(frozen=True)
class ParameterChoice:
    """Dynamic parameters (p,) [SI], and a text that names their source."""

    values: Array
    source: str


def choose_parameters(robot: Robot, choice: str | None = None) -> ParameterChoice:
    """Return the parameters of a named set or of a result file, by default the nominal set.

    Raises ScenarioError, with the valid names, if there is neither such a set nor such a file.
    Raises RecordError if a result file lacks estimates, or if an estimate is not a number in its
    range.
    """
    name = NOMINAL if choice is None else choice
    if name in robot.parameter_sets:
        return ParameterChoice(robot.parameter_sets[name].dynamic, f"parameter set {name}")
    if not Path(name).is_file():
        valid = ", ".join(sorted(robot.parameter_sets))
        raise ScenarioError(
            f"{name!r} is neither a parameter set of robot {robot.name} ({valid}) nor a result.json"
        )
    result = load_result(name)
    try:
        values = robot.layout.check(
            parameter_column(result.get("identification"), "estimate", robot.parameter_names)
        )
    except (RecordError, ParameterError) as error:
        raise RecordError(f"{name}: {error}") from None
    return ParameterChoice(values, f"estimates of {name}")


def parameter_entries(identification: Any) -> dict[str, Any]:
    """Return the parameters of an identification entry of a result, by name.

    Raises RecordError if there are none.
    """
    entries = identification.get("parameters") if isinstance(identification, dict) else None
    if not isinstance(entries, dict):
        raise RecordError("there is no identification.parameters; write it with: cmmsim identify")
    return entries


def parameter_column(identification: Any, column: str, names: Sequence[str]) -> list[float]:
    """Return the parameters of one column ("initial", "estimate", ...) of an identification entry.

    Raises RecordError if a parameter is missing or is not a finite number. The message names it.
    """
    entries = parameter_entries(identification)
    given: dict[str, Any] = {
        n: one.get(column) if isinstance(one := entries.get(n), dict) else None for n in names
    }
    absent = [name for name, value in given.items() if value is None]
    if absent:
        more = f" and {len(absent) - 3} more" if len(absent) > 3 else ""
        raise RecordError(f"there is no {column} of {', '.join(absent[:3])}{more}")
    for name, value in given.items():
        # bool is a subclass of int.
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not (number and abs(value) <= sys.float_info.max):
            raise RecordError(
                f"{column} of {name} is {json.dumps(value):.60}, must be a finite number"
            )
    return list(given.values())
