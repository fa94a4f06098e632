"""The closed loop of a scenario: its settings, its parameters, and those that a command line
names."""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from dynamics import Robot
from dynamics.closed_loop import Drives, FrameTiming, FrictionLaw, LoopSettings, ServoGains
from dynamics.closed_loop.drives import DRIVES, DriveName
from dynamics.errors import ParameterError
from identify.arrays import Array
from identify.errors import RecordError, ScenarioError
from identify.files.run_folder import load_result
from identify.scenario import Model, Plant, Scenario
from identify.scenario.plant_sections import AUTO, FILTERED
from identify.scenario.section import ACTUATOR_KEYS, Section

NOMINAL = "initial"
"""The parameter set that is meant where none is named."""


def model_settings(robot: Robot, scenario: Scenario) -> LoopSettings:
    """The loop around the estimator's model: of the latency it knows the mean, where no record says
    when commands acted. Raises as `loop_settings`."""
    return loop_settings(robot, scenario, scenario.model)


def loop_settings(robot: Robot, scenario: Scenario, side: Plant | Model) -> LoopSettings:
    """The scenario's servo, timing and torque limit, with the laws of friction and of the drives
    and the steps of the plant or of the model.

    Raises ScenarioError for a constant that is one of the other kind of actuators.
    """
    servo = scenario.servo
    timing = scenario.timing
    velocities = [
        of_actuators(robot, side, name) for name in ("smoothing_velocity", "stribeck_velocity")
    ]
    return LoopSettings(
        servo=ServoGains(servo.kp, servo.kd, servo.ki),
        timing=FrameTiming(timing.frame_rate_hz, timing.latency_s, timing.hold),
        friction=FrictionLaw(side.friction, velocities[0], side.static_ratio, velocities[1]),
        steps_per_frame=side.steps_per_frame,
        drives=Drives(
            torque_limit=of_actuators(robot, scenario.control, "torque_limit"),
            law=side.drive_law,
            filter_time=side.derivative_filter_s if side.drive_law == FILTERED else None,
        ),
    )


def with_drive(scenario: Scenario, law: DriveName) -> Scenario:
    """The scenario with the law of the drives that an identification settled, where it leaves that
    to the record.
    """
    return (
        scenario.with_overrides(drive_settings(law)) if scenario.model.drive == AUTO else scenario
    )


def drive_settings(law: DriveName) -> dict[str, str | None]:
    """Settings of a model whose drives have a law, where the scenario leaves it to the record, by
    dotted path.
    """
    return {"model.drive": law} | ({} if law == FILTERED else {"model.derivative_filter_s": None})


def settled_drive(identification: Any) -> DriveName:
    """The law of the drives of an identification entry of a result: the PID where it says none.

    Raises RecordError: an unknown one.
    """
    drive = identification.get("drive") if isinstance(identification, dict) else None
    law = drive.get("law") if isinstance(drive, dict) else "pid"
    if law not in DRIVES:
        raise RecordError(f"identification.drive.law is {law!r}; valid: {', '.join(DRIVES)}")
    return cast("DriveName", law)


def check_parameter_set(robot: Robot, set_name: str) -> None:
    """Raise ScenarioError, with the valid names, when the robot file has no such parameter set."""
    if set_name not in robot.parameter_sets:
        valid = ", ".join(sorted(robot.parameter_sets))
        raise ScenarioError(
            f"robot {robot.name} has no parameter set {set_name!r}; it has {valid} "
            "(plant.parameters names the truth, model.start_parameters what identification starts "
            "from)"
        )


def of_actuators(robot: Robot, section: Section, name: str) -> Any:
    """The value of a setting that has one key for actuators that turn and one for those that slide.

    Raises ScenarioError where only the key of the other kind is set, with both.
    """
    turning, sliding = ACTUATOR_KEYS[name]
    own, other = (sliding, turning) if robot.layout.prismatic else (turning, sliding)
    if (
        other in section.model_fields_set
        and own not in section.model_fields_set
        and getattr(section, other) is not None
    ):
        raise ScenarioError(
            f"{type(section).__name__.lower()}.{other} = {getattr(section, other):g} is of "
            "actuators that "
            f"{'turn' if robot.layout.prismatic else 'slide'}; those of {robot.name} "
            f"{'slide' if robot.layout.prismatic else 'turn'}: set {own}"
        )
    return getattr(section, own)


@dataclass(frozen=True)
class ParameterChoice:
    """Dynamic parameters (p,) [SI] and, in words, where they come from."""

    values: Array
    source: str


def choose_parameters(robot: Robot, choice: str | None = None) -> ParameterChoice:
    """Parameters by the name of a set, or the estimates of a result file; the nominal set when
    nothing is named.

    Raises ScenarioError: neither a set of the robot (with the valid names) nor a file. Raises
    RecordError: a result file without a complete set of estimates, or one that is no number in its
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
    """The parameters of an identification entry of a result, by name. Raises RecordError: there are
    none.
    """
    entries = identification.get("parameters") if isinstance(identification, dict) else None
    if not isinstance(entries, dict):
        raise RecordError("there is no identification.parameters; write it with: cmmsim identify")
    return entries


def parameter_column(identification: Any, column: str, names: Sequence[str]) -> list[float]:
    """Parameters of one column ("initial", "estimate", ...) of an identification entry.

    Raises RecordError: naming those that are missing, or one that is no finite number.
    """
    entries = parameter_entries(identification)
    found: dict[str, Any] = {
        n: one.get(column) if isinstance(one := entries.get(n), dict) else None for n in names
    }
    absent = [name for name, value in found.items() if value is None]
    if absent:
        more = f" and {len(absent) - 3} more" if len(absent) > 3 else ""
        raise RecordError(f"there is no {column} of {', '.join(absent[:3])}{more}")
    for name, value in found.items():
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not (number and abs(value) <= sys.float_info.max):
            raise RecordError(
                f"{column} of {name} is {json.dumps(value):.60}, must be a finite number"
            )
    return list(found.values())
