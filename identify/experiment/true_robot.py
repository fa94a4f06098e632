"""True robot of a scenario: its geometry, its bodies and its parameters."""

from dataclasses import replace

import numpy as np

from dynamics import Robot
from dynamics.closed_loop.drives import READS
from dynamics.errors import ParameterError
from dynamics.parameters import (
    JOINT_PID,
    SIGNED,
    ParameterLayout,
    own_passive_parameters,
    parameter_layout,
    passive_parameters,
)
from dynamics.pseudo_inertia import body_fault
from dynamics.spatial_inertia import FULL_INERTIAL
from identify.arrays import Array
from identify.errors import ScenarioError
from identify.estimation.prior import starting_guess
from identify.loop_parameters import in_form, is_gain, of_actuators
from identify.random_streams import ENCODER_OFFSETS, JOINT_ZEROS, TRUE_GEOMETRY, child
from identify.record.known_geometry import KnownGeometry
from identify.record.run_error_covariance import factor
from identify.scenario import Plant as PlantSwitches
from identify.scenario.section import ACTUATOR_KEYS
from identify.scenario.sections import Geometry


def with_true_bodies(robot: Robot, in_file: Robot, switches: PlantSwitches) -> Robot:
    """Return the true robot with the full bodies, the passive friction and the gains of the plant.

    Full bodies and passive friction are those of the robot file, unless the plant states others. A
    body is also full if the plant states a true first moment or product of inertia of it, and a
    passive joint has friction if the plant states its true value. Raises ScenarioError, with the
    valid names, for a true value of a parameter that the robot or the law of its drives does not
    have.
    """
    of_plant = in_form(in_file, switches)
    stated = of_plant.layout
    full = set(stated.full_bodies)
    passive = list(stated.passive_names)
    legs = in_file.geometry.legs
    shared = passive_parameters(legs)
    own = own_passive_parameters(legs)
    known = (*parameter_layout(legs, ("all",), stated.own_gains, shared).names, *own)
    for name in switches.values:
        if name not in known:
            raise ScenarioError(
                f"plant.values names {name!r}; {robot.name} has {', '.join(stated.bodies)}, each "
                f"with {', '.join(FULL_INERTIAL)} (such as platform.mcz), "
                f"{', '.join(stated.joint_names)} with coulomb and viscous, "
                f"{', '.join(shared)}, or of one leg, such as {own[0]}, and {_gains(stated)}"
            )
        body, entry = name.split(".")
        if is_gain(name) and entry not in READS[switches.drive]:
            raise ScenarioError(
                f"plant.values.{name} = {switches.values[name]:g}, but the law {switches.drive} of "
                f"the drives has only {', '.join(READS[switches.drive])}"
            )
        if entry in SIGNED:
            full.add(body)
        if name in (*shared, *own):
            passive.append(name)
    layout = robot.layout
    same_bodies = full == set(layout.full_bodies) and stated.own_gains == layout.own_gains
    if same_bodies and set(passive) == set(layout.passive_names):
        return robot
    geometry = replace(
        robot.geometry,
        full_bodies=of_plant.geometry.full_bodies,
        own_gains=stated.own_gains,
        passive_friction=of_plant.geometry.passive_friction,
    )
    true = of_plant.with_geometry(geometry)
    return true.with_full_bodies(sorted(full)).with_passive_friction(passive)


def _gains(layout: ParameterLayout) -> str:
    """Return text with the names of a plant's gains, and the setting for gains of each joint."""
    names = ", ".join(JOINT_PID)
    if layout.own_gains:
        return f"with plant.gains = 'each' also with {names}"
    return f"joint_pid with {names}, or with plant.gains = 'each' each joint"


def true_parameters(robot: Robot, switches: PlantSwitches) -> Array:
    """Return the true parameters (p,): a named set, changed by the plant's drive gains and values.

    Raises ScenarioError for a body that cannot exist, or a value that is not allowed.
    """
    # Only the values of this guess are used, so its standard deviation is arbitrary.
    values = starting_guess(robot, switches.parameters, 1.0, drive=switches.drive).values
    layout = robot.layout
    # A view of the values, with one row per joint, or one row of shared gains.
    gains = values[layout.joint_pid].reshape(-1, len(JOINT_PID))
    for name, gain in switches.drive_gains.items():
        gains[:, JOINT_PID.index(name)] = gain
    for name, value in switches.values.items():
        values[layout.names.index(name)] = value
    changed = {name.split(".")[0] for name in switches.values}
    bodies = layout.bodies_of(values[layout.rigid])
    for body, full, row in zip(layout.bodies, layout.full, bodies, strict=True):
        if full and body in changed and (fault := body_fault(row)):
            raise ScenarioError(f"plant.values: {body} cannot exist: {fault} (kg, m, kg m^2)")
    try:
        layout.check(values[layout.dynamic])
    except ParameterError as error:
        raise ScenarioError(f"plant.values: {error}") from None
    return values


def true_zeros(robot: Robot, switches: PlantSwitches) -> Array:
    """Return the true coordinate minus the reading of each joint (n,) of a plant, rad or m.

    The plant states a list of these zeros, or the standard deviation with which they are drawn.
    Raises ScenarioError for a list of a wrong length.
    """
    error = of_actuators(robot, switches, "joint_zero_error")
    joints = robot.layout.joints
    if isinstance(error, list):
        if len(error) != joints:
            raise ScenarioError(
                f"plant.joint_zero_error_{robot.layout.joint_unit} has {len(error)} values, but "
                f"{robot.name} has {joints} joints"
            )
        return np.array(error, dtype=float)
    rng = np.random.default_rng(child(switches.geometry_seed, JOINT_ZEROS))
    return np.asarray(error * rng.standard_normal(joints))


def true_friction_offsets(robot: Robot, switches: PlantSwitches) -> Array:
    """Return the offset of the friction of each joint (n,) of a plant, N m or N.

    Raises ScenarioError for a list of a wrong length, and for an offset beyond the Coulomb
    friction, with which a joint would move by itself.
    """
    offset = of_actuators(robot, switches, "friction_offset")
    joints = robot.layout.joints
    unit = robot.layout.unit("joint1.coulomb")
    key = f"plant.friction_offset_{unit.replace(' ', '_')}"
    if isinstance(offset, list) and len(offset) != joints:
        raise ScenarioError(f"{key} has {len(offset)} values, but {robot.name} has {joints} joints")
    offsets = np.broadcast_to(np.array(offset, dtype=float), joints).copy()
    coulomb = true_parameters(robot, switches)[robot.layout.coulomb]
    if (beyond := np.abs(offsets) > coulomb).any():
        joint = int(np.argmax(beyond))
        raise ScenarioError(
            f"{key} of joint {joint + 1} is {offsets[joint]:g} {unit}, beyond its Coulomb friction "
            f"of {coulomb[joint]:g} {unit}: friction would be negative in one direction"
        )
    return offsets


def true_robot(
    nominal: Robot, switches: PlantSwitches, calibration: Geometry, known: KnownGeometry, seed: int
) -> Robot:
    """Return the robot with its true geometry.

    Without a calibration the geometry has the errors that the plant states. If this run calibrates
    the geometry, the zeros of the joints and the offsets of the encoders are added. With an earlier
    calibration, the true geometry is drawn about the calibrated geometry from its covariance.

    Raises ScenarioError if the plant states errors and there is an earlier calibration.
    """
    if known.covariance is None:
        return misplaced(nominal, switches)
    if calibration.known == "calibrated":
        return nominal.moved(true_deviations(nominal, switches, calibration, seed))
    for name in (
        *("geometry_error_m", "length_error_m", "axis_error_rad"),
        *ACTUATOR_KEYS["joint_zero_error"],
    ):
        if getattr(switches, name):
            raise ScenarioError(
                f"plant.{name} = {getattr(switches, name)} with geometry.known = "
                f"{calibration.known!r}: the true geometry is drawn from the covariance of "
                "that calibration; set only one of the two"
            )
    drawn = np.random.default_rng(child(seed, TRUE_GEOMETRY)).standard_normal(len(known.covariance))
    return known.robot.moved(factor(known.covariance) @ drawn)


def true_deviations(
    robot: Robot, switches: PlantSwitches, calibration: Geometry, seed: int
) -> Array:
    """Return the deviations (g,) of the true from the nominal geometric numbers, m and rad.

    The deviations include the zeros of the joints and the offsets of the encoders. The offsets are
    drawn with the seed.
    """
    drawn = np.random.default_rng(child(seed, ENCODER_OFFSETS)).standard_normal(robot.layout.joints)
    true = misplaced(robot, switches).geometry
    offset = of_actuators(robot, calibration, "encoder_offset")
    # An offset of an encoder is the opposite shift of its joint.
    zeros = true_zeros(robot, switches)
    return true.shifted(zeros - offset * drawn).deviations_from(robot.geometry)


def misplaced(nominal: Robot, plant: PlantSwitches) -> Robot:
    """Return the robot with the geometric errors that a scenario's plant states."""
    # The geometry has a separate seed, so that runs with other noise have the same robot.
    rng = np.random.default_rng(plant.geometry_seed)
    geometry = nominal.geometry.with_errors(
        plant.geometry_error_m, rng, plant.length_error_m, plant.axis_error_rad
    )
    return nominal.with_geometry(geometry)
