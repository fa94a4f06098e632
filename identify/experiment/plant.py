"""True robot of a scenario in its simulated loop, and the load that it carries.

Its geometry, friction law and drives may differ from those that the estimator knows.
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
from identify.record.known_geometry import KnownGeometry, known_geometry
from identify.record.payload import payload_vector
from identify.record.pose_covariance import factor
from identify.scenario import Plant as PlantSwitches
from identify.scenario import Scenario


@dataclass(frozen=True, eq=False)
class Plant:
    """The true robot in its loop, made by `build_plant`.

    Attributes
    ----------
    scenario : Scenario
        Scenario that describes the plant.
    nominal : Robot
        Robot that servo and estimator know.
    robot : Robot
        True robot. It is the same object as `nominal` if the geometry has no error.
    parameters : ndarray, shape (p,)
        True parameters, SI.
    settings : LoopSettings
        True loop, whose joints may be elastic.
    geometry_covariance : ndarray, shape (g, g), optional
        Covariance of the true geometry about the known one, where that is calibrated.
    """

    scenario: Scenario
    nominal: Robot
    robot: Robot
    parameters: Array
    settings: LoopSettings
    geometry_covariance: Array | None = None

    def check(self) -> None:
        """Raise an error, with the evidence, if the plant cannot be simulated or stay at home.

        The error is a dynamics.DynamicsError, or the ScenarioError of `holding`.
        """
        self._settings_at(self.parameters, self.nominal.home_pose)
        self.holding(self.nominal.home_pose)

    def holding(self, pose: Array) -> Array:
        """Return the actuators' torques or forces (n,) at rest at a pose (6,).

        Raises ScenarioError if one exceeds the torque limit.
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

        Parameters
        ----------
        reference : Reference
            Desired motion, one row a frame.
        sensor : Sensor
            Source of the measured poses.
        latencies : ndarray, shape (frames,), optional
            Latency of each frame's command, s. The default is that of the timing.
        load : ndarray, shape (p,), optional
            Change of the parameters by the load on the platform.
        law : LawInLoop, optional
            Control law. The default is the servo alone.

        Returns
        -------
        ClosedLoopRun
            One row a frame.

        Raises
        ------
        LoopFailure
            If the robot leaves its reach. Under the servo, the message adds the verdict of the
            linear map of the loop.
        DynamicsError
            As for `dynamics.closed_loop.simulate_servo`.
        """
        parameters = self.parameters if load is None else self.parameters + load
        settings = self._settings_at(parameters, reference.poses[0])
        known = None if self.robot is self.nominal else self.nominal
        law = law or LawInLoop()
        settings = replace(settings, drives=replace(settings.drives, torques=law.drives.torques))
        given = (self.robot, parameters, reference, settings)
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
            # The linear map describes the servo alone.
            if law.controller is not None and not law.by_servo:
                raise
            said = stability.verdict(self.nominal, parameters, settings, reference.poses[0])
            raise LoopFailure(f"{error}; {said}", error.frame, error.saturated) from None

    def truth(self, run: ClosedLoopRun) -> xr.Dataset:
        """Return the truth of a run: motion, parameters without a load, and model mismatch."""
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
        # The drive gains are among the parameters already.
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
        """Settings with enough steps a frame for the vibration of elastic joints."""
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
    """Build the plant of a scenario.

    Parameters
    ----------
    scenario : Scenario
        Scenario that describes the plant.
    nominal : Robot, optional
        Robot of the scenario. The default loads it.
    seed : int
        Seed of the run. The true values of a calibrated geometry are drawn from it.
    known : KnownGeometry, optional
        Geometry that the estimator knows. The default is that of the scenario.

    Raises
    ------
    ScenarioError
        If there is no such parameter set (the message lists the valid names), or as for
        `known_geometry`.
    """
    nominal = nominal or load_robot(scenario.robot)
    switches = scenario.plant
    known = known or known_geometry(nominal, scenario.geometry)
    settings = loop_settings(nominal, scenario.servo, scenario.timing, scenario.control, switches)
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
    """Return the true parameters (p,): those of a named set, with the drive gains of the plant."""
    values = starting_guess(nominal, switches.parameters, 1.0, drive=switches.drive).values
    layout = nominal.layout
    for name, gain in switches.drive_gains.items():
        values[layout.names.index(f"joint_pid.{name}")] = gain
    return values


def true_robot(nominal: Robot, scenario: Scenario, seed: int, known: KnownGeometry) -> Robot:
    """Return the robot with its true geometry.

    A geometry that no calibration covers has the errors that the plant states. If this run
    calibrates it, the offsets of the encoders are added. If it was calibrated before, the true
    geometry is drawn about the calibrated one with its covariance.

    Raises ScenarioError if the plant states errors for a geometry that was calibrated before.
    """
    if known.covariance is None:
        return misplaced(nominal, scenario.plant)
    if scenario.geometry.known == "calibrated":
        return nominal.moved(true_deviations(nominal, scenario, seed))
    for name in ("geometry_error_m", "length_error_m", "axis_error_rad"):
        if getattr(scenario.plant, name):
            raise ScenarioError(
                f"plant.{name} = {getattr(scenario.plant, name):g} with geometry.known = "
                f"{scenario.geometry.known!r}: the true geometry is drawn from the covariance of "
                "that calibration; set one of both"
            )
    drawn = np.random.default_rng(child(seed, TRUE_GEOMETRY)).standard_normal(len(known.covariance))
    return known.robot.moved(factor(known.covariance) @ drawn)


def true_deviations(robot: Robot, scenario: Scenario, seed: int) -> Array:
    """Return the deviations (g,) of the true geometric numbers from the nominal ones, m and rad.

    They include the offsets of the encoders, which are drawn from the seed.
    """
    drawn = np.random.default_rng(child(seed, ENCODER_OFFSETS)).standard_normal(robot.layout.joints)
    true = misplaced(robot, scenario.plant).geometry
    offset = of_actuators(robot, scenario.geometry, "encoder_offset")
    # An offset of an encoder is the opposite shift of its joint.
    return true.shifted(-offset * drawn).deviations_from(robot.geometry)


def misplaced(nominal: Robot, plant: PlantSwitches) -> Robot:
    """Return the robot with the geometric errors that a scenario's plant states."""
    rng = np.random.default_rng(plant.geometry_seed)
    geometry = nominal.geometry.with_errors(
        plant.geometry_error_m, rng, plant.length_error_m, plant.axis_error_rad
    )
    return nominal.with_geometry(geometry)


@dataclass(frozen=True)
class PlatformLoad:
    """Load on the platform, as changes of the parameters (p,).

    ``stated`` are the stated values, ``std`` their standard deviations, and ``true`` the true
    values.
    """

    stated: Array
    std: Array
    true: Array


def drawn_load(
    layout: ParameterLayout, scenario: Scenario, rng: np.random.Generator
) -> PlatformLoad:
    """Draw the scenario's load.

    The true values scatter about the stated ones with the stated standard deviations. Draws with a
    negative value are repeated.
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
