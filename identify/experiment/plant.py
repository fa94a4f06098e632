"""The simulated real robot of a scenario: what it is, does and carries, and where it is not the
robot that is known.
"""

from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from dynamics import Robot, load_robot
from dynamics.closed_loop import (
    IDEAL,
    ClosedLoopRun,
    JointElasticity,
    LoopFailure,
    LoopSettings,
    Reference,
    Sensor,
    simulate_controller,
    simulate_servo,
    stability,
)
from dynamics.control.law import LawInLoop
from dynamics.parameters import ParameterLayout
from identify.arrays import Array
from identify.errors import ScenarioError
from identify.estimation.prior import starting_guess
from identify.experiment.truth import build_truth
from identify.loop_parameters import loop_settings, of_actuators
from identify.random_streams import ENCODER_OFFSETS, TRUE_GEOMETRY, child
from identify.record.covariance import factor
from identify.record.known_geometry import KnownGeometry, known_geometry
from identify.record.payload import payload_vector
from identify.scenario import Plant as PlantSwitches
from identify.scenario import Scenario


@dataclass(frozen=True, eq=False)
class Plant:
    """The true robot in its loop, made once by `build_plant`.

    nominal: the robot that servo and estimator know; robot: the true one, the same object where
    there is no geometry error; parameters (p,): the true ones; settings: of its loop, whose joints
    may be elastic; geometry_covariance (g, g): of the true geometry about the known one, where that
    is calibrated.
    """

    scenario: Scenario
    nominal: Robot
    robot: Robot
    parameters: Array
    settings: LoopSettings
    geometry_covariance: Array | None = None

    def check(self) -> None:
        """Raise dynamics.DynamicsError, with the evidence, where it cannot be simulated, and as
        `holding` at home.
        """
        self._settings_at(self.parameters, self.nominal.home_pose)
        self.holding(self.nominal.home_pose)

    def holding(self, pose: Array) -> Array:
        """Torques or forces (n,) at rest at a pose (6,). Raises ScenarioError where the actuators
        do not have them.
        """
        robot = self.robot
        limit = self.settings.drives.torque_limit
        torque = robot.static_torque(pose, self.parameters[robot.layout.dynamic])
        leg = int(np.argmax(np.abs(torque)))
        unit = robot.layout.unit("joint1.coulomb")
        if limit is not None and abs(torque[leg]) > limit:
            raise ScenarioError(
                f"leg {leg + 1} of {robot.name} takes {abs(torque[leg]):.4g} {unit} to stand "
                "still at the start, limit "
                f"control.torque_limit_{unit.replace(' ', '_')} = {limit:g}"
            )
        return torque

    def run(
        self,
        reference: Reference,
        sensor: Sensor = IDEAL,
        latencies: Array | None = None,
        load: Array | None = None,
        law: LawInLoop | None = None,
    ) -> ClosedLoopRun:
        """Follow a reference under a servo that knows the nominal robot.

        load (p,): what the platform carries, as it adds to the parameters; law: None for the servo
        alone. Raises what `dynamics.closed_loop.simulate_servo` raises; a LoopFailure says in
        addition what the linear map of the loop says.
        """
        parameters = self.parameters if load is None else self.parameters + load
        settings = self._settings_at(parameters, reference.poses[0])
        known = None if self.robot is self.nominal else self.nominal
        law = law or LawInLoop()
        settings = replace(settings, drives=replace(settings.drives, torques=law.drives.torques))
        given = self.robot, parameters, reference, settings
        try:
            if law.controller is not None:
                return simulate_controller(*given, law.controller, sensor, latencies=latencies)
            return simulate_servo(
                *given,
                sensor,
                servo_robot=known,
                feedforward=law.feedforward,
                latencies=latencies,
            )
        except LoopFailure as error:
            if law.controller is not None and not law.by_servo:
                raise
            said = stability.verdict(self.nominal, parameters, settings, reference.poses[0])
            raise LoopFailure(f"{error}; {said}", error.frame, error.saturated) from None

    def truth(self, run: ClosedLoopRun) -> xr.Dataset:
        """The truth of a run: what it did, the parameters without a load, and what the model has no
        place for.
        """
        truth = build_truth(
            time=run.time,
            pose=run.pose,
            joint_angle=self.robot.inverse_kinematics(run.pose),
            joint_velocity=np.einsum(
                "nij,nj->ni", self.robot.pose_jacobian(run.pose), run.pose_rate
            ),
            joint_torque=run.torque,
            parameter_names=list(self.robot.layout.names),
            parameters=self.parameters,
            mismatch=self._mismatch(run),
            prismatic=self.robot.layout.prismatic,
        )
        # parameters hold them
        switches = self.scenario.plant.model_dump(exclude_none=True, exclude={"drive_gains"})
        return truth.assign_attrs({f"plant_{name}": value for name, value in switches.items()})

    def _mismatch(self, run: ClosedLoopRun) -> dict[str, ArrayLike]:
        geometry = self.robot.geometry
        known = self.nominal.geometry
        found: dict[str, ArrayLike] = {}
        if geometry != known:
            found["base_joint_error"] = geometry.base_joints - known.base_joints
            found["platform_joint_error"] = geometry.platform_joints - known.platform_joints
        if run.motor_angle is not None:
            found["motor_angle"] = run.motor_angle
        return found

    def _settings_at(self, parameters: Array, pose: Array) -> LoopSettings:
        """The settings, with more steps a frame where elastic joints vibrate too fast for
        theirs."""
        settings = self.settings
        springs = self.settings.elasticity
        if springs is None:
            return settings
        period = self.scenario.timing.frame_period_s
        needed = springs.steps_needed(self.robot, parameters, pose, period, settings.friction)
        return replace(settings, steps_per_frame=max(settings.steps_per_frame, needed))


def build_plant(
    scenario: Scenario,
    nominal: Robot | None = None,
    seed: int = 0,
    known: KnownGeometry | None = None,
) -> Plant:
    """The plant of a scenario; nominal: its robot, where it is at hand; seed: of the run, which
    decides what is true of a geometry that is calibrated; known: what is known of it, where that is
    at hand.

    Raises ScenarioError: no such parameter set (with the valid names), or as `known_geometry`.
    """
    nominal = nominal or load_robot(scenario.robot)
    switches = scenario.plant
    known = known or known_geometry(scenario, nominal=nominal)
    settings = loop_settings(nominal, scenario, switches)
    stiffness = of_actuators(nominal, switches, "joint_stiffness")
    if stiffness is not None:
        inertia, damping = (
            of_actuators(nominal, switches, name) for name in ("motor_inertia", "joint_damping")
        )
        settings = replace(settings, elasticity=JointElasticity(stiffness, inertia, damping))
    return Plant(
        scenario=scenario,
        nominal=known.robot,
        robot=true_robot(nominal, scenario, seed, known),
        parameters=true_parameters(nominal, switches),
        settings=settings,
        geometry_covariance=known.covariance,
    )


def true_parameters(nominal: Robot, switches: PlantSwitches) -> Array:
    """The true parameters (p,): of a named set, with the gains of the drives that the plant
    states."""
    values = starting_guess(nominal, switches.parameters, 1.0, drive=switches.drive).values
    layout = nominal.layout
    for name, gain in switches.drive_gains.items():
        values[layout.names.index(f"joint_pid.{name}")] = gain
    return values


def true_robot(nominal: Robot, scenario: Scenario, seed: int, known: KnownGeometry) -> Robot:
    """The true robot: off the scenario's by the errors of its plant, or, where a calibration done
    before says what is known, drawn about that with its covariance."""
    if known.covariance is None:
        return misplaced(nominal, scenario.plant)
    if scenario.geometry.known == "calibrated":
        return nominal.moved(true_deviations(nominal, scenario, seed))
    for name in ("geometry_error_m", "length_error_m", "axis_error_rad"):
        if getattr(scenario.plant, name):
            raise ScenarioError(
                f"plant.{name} = {getattr(scenario.plant, name):g} with geometry.known = "
                f"{scenario.geometry.known!r}: "
                "the true geometry is drawn from the covariance of that calibration; set one of "
                "both"
            )
    drawn = np.random.default_rng(child(seed, TRUE_GEOMETRY)).standard_normal(len(known.covariance))
    return known.robot.moved(factor(known.covariance) @ drawn)


def true_deviations(robot: Robot, scenario: Scenario, seed: int) -> Array:
    """How far the true geometric numbers (g,) of a robot that is calibrated are from its own, m and
    rad, with the offsets of its encoders, which are the seed's."""
    drawn = np.random.default_rng(child(seed, ENCODER_OFFSETS)).standard_normal(robot.layout.joints)
    true = misplaced(robot, scenario.plant).geometry
    offset = of_actuators(robot, scenario.geometry, "encoder_offset")
    return true.shifted(-offset * drawn).deviations_from(robot.geometry)


def misplaced(nominal: Robot, plant: PlantSwitches) -> Robot:
    """The true robot, with the errors of geometry of a scenario's plant."""
    rng = np.random.default_rng(plant.geometry_seed)
    geometry = nominal.geometry.with_errors(
        plant.geometry_error_m, rng, plant.length_error_m, plant.axis_error_rad
    )
    return nominal.with_geometry(geometry)


@dataclass(frozen=True)
class PlatformLoad:
    """What a load adds to the parameters (p,): the stated values with their standard deviations,
    and the true ones.
    """

    stated: Array
    std: Array
    true: Array


def drawn_load(
    layout: ParameterLayout, scenario: Scenario, rng: np.random.Generator
) -> PlatformLoad:
    """The scenario's load, whose true figures miss the stated ones by the stated deviations; no
    figure is negative.
    """
    load = scenario.payload
    stated = payload_vector(layout, load.mass_kg, (load.Ixx_kg_m2, load.Iyy_kg_m2, load.Izz_kg_m2))
    std = payload_vector(
        layout, load.mass_std_kg, (load.Ixx_std_kg_m2, load.Iyy_std_kg_m2, load.Izz_std_kg_m2)
    )
    true = stated + std * rng.standard_normal(stated.shape)
    while (true < 0).any():
        true = stated + std * rng.standard_normal(stated.shape)
    return PlatformLoad(stated, std, true)
