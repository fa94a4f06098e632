"""True robot of a scenario in its simulated loop, and the load on its platform.

Its geometry, friction law and drives can differ from those that the estimator knows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from dynamics import Robot
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
from dynamics.control.law_interface import LawInLoop
from dynamics.parameters import ParameterLayout
from identify.arrays import Array
from identify.errors import ScenarioError
from identify.experiment.true_robot import true_friction_offsets, true_zeros
from identify.experiment.truth import build_truth
from identify.loop_parameters import of_actuators
from identify.model.model_side import ModelSide
from identify.record.load import load_errors, load_parameters
from identify.scenario import Plant as PlantSwitches
from identify.scenario import PriorValue, Timing
from identify.scenario.loop_sections import Control
from identify.scenario.payload import Payload
from identify.scenario.sections import Rig


@dataclass(frozen=True)
class KnownLoop:
    """Closed loop as an experimenter without knowledge of the plant knows it.

    side         Nominal robot and the loop around its model.
    prior        More accurate priors of single parameters, by name.
    filter_time  Time constant of drives with a filter, s, if one is stated.
    control      Settings of control laws, and limits of the drives.
    """

    side: ModelSide
    prior: Mapping[str, PriorValue]
    filter_time: float | None
    control: Control


@dataclass(frozen=True)
class RunSettings:
    """Settings of all runs of a plant.

    timing              Frames and latencies.
    limits              Limits that keep the robot away from singularities, for `check_travel`.
    rig                 Errors and drift of the cameras, and the drift watch.
    anchor, anchor_std  Measurement that fixes the scale of the parameters, and its standard
                        deviation.
    scenario_toml       Text of the scenario for the records.
    """

    timing: Timing
    limits: Mapping[str, float]
    rig: Rig
    anchor: str
    anchor_std: float | None
    scenario_toml: str


@dataclass(frozen=True, eq=False)
class Plant:
    """The true robot in its loop. `identify.setup` makes it from a scenario.

    Attributes
    ----------
    nominal : Robot
        Robot that servo and estimator know.
    robot : Robot
        True robot. It is the same object as `nominal` if geometry and names of parameters agree.
    parameters : ndarray, shape (p,)
        True parameters, SI.
    settings : LoopSettings
        True loop. Its joints can be elastic.
    switches : PlantSwitches
        Settings of the plant. They are stored with the truth.
    loop : KnownLoop
        Loop as control laws know it.
    runs : RunSettings
        Settings of all runs of the plant.
    geometry_covariance : ndarray, shape (g, g), optional
        Covariance of the true geometry about the known geometry, if that is calibrated.
    """

    nominal: Robot
    robot: Robot
    parameters: Array
    settings: LoopSettings
    switches: PlantSwitches
    loop: KnownLoop
    runs: RunSettings
    geometry_covariance: Array | None = None

    def parameters_of(self, layout: ParameterLayout) -> Array:
        """Return the true parameters (p,) in the layout of a model.

        First moments and products of inertia that the plant has and the model lacks are left out.
        If the model shares gains and the plant does not, the gains are the mean over all joints.
        """
        own = self.robot.layout
        dynamic = own.converted(self.parameters[own.dynamic], layout)
        gains = own.converted_gains(self.parameters[own.joint_pid], layout)
        return np.concatenate([dynamic, gains])

    def check(self) -> None:
        """Check that the plant can be simulated and stand still at home.

        Raises dynamics.DynamicsError, or the ScenarioError of `holding`.
        """
        self._settings_at(self.parameters, self.nominal.home_pose)
        self.holding(self.nominal.home_pose)

    def holding(self, pose: Array) -> Array:
        """Return the actuators' torques or forces (n,) at rest at a pose (6,).

        Raises ScenarioError if an actuator would exceed the torque limit.
        """
        robot = self.robot
        limit = self.settings.drives.torque_limit
        torque = robot.static_torque(pose, self.parameters[robot.layout.dynamic])
        leg = int(np.argmax(np.abs(torque)))
        unit = robot.layout.unit("joint1.coulomb")
        if limit is not None and abs(torque[leg]) > limit:
            raise ScenarioError(
                f"leg {leg + 1} of {robot.name} needs {abs(torque[leg]):.4g} {unit} to stand "
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
        """Follow a reference under a control law, by default a servo that knows the nominal robot.

        Parameters
        ----------
        reference : Reference
            Desired motion, one row per frame.
        sensor : Sensor
            Source of the measured poses.
        latencies : ndarray, shape (frames,), optional
            Latency of each frame's command, s. The default is the latency of the timing.
        load : ndarray, shape (p,), optional
            Change of the parameters by the load on the platform.
        law : LawInLoop, optional
            Control law, possibly with a feedforward to the servo. The default is the servo alone.

        Returns
        -------
        ClosedLoopRun
            Run with one row per frame.

        Raises
        ------
        LoopFailure
            If the loop is unstable or the robot leaves its reach. Under the servo, the message adds
            whether the linearised loop is stable.
        DynamicsError
            Errors of `dynamics.closed_loop.simulate_servo`.
        ScenarioError
            If the law commands torques, but the plant has gains of each joint.
        """
        parameters = self.parameters if load is None else self.parameters + load
        settings = self._settings_at(parameters, reference.poses[0])
        known = None if self.robot is self.nominal else self.nominal
        law = law or LawInLoop()
        if law.drives.torques and self.robot.layout.own_gains:
            raise ScenarioError(
                "plant.gains = 'each', but under this control law the drives take torques, and no "
                "gain of a joint acts: set plant.gains = 'shared'"
            )
        # The law decides whether commands are torques. All other drive settings are the plant's.
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
            # The linearised loop describes only the servo.
            if law.controller is not None and not law.by_servo:
                raise
            verdict = stability.verdict(self.robot, parameters, settings, reference.poses[0])
            raise LoopFailure(f"{error}; {verdict}", error.frame, error.saturated) from None

    def without_latency(self) -> Plant:
        """Return the plant in a loop without latency and dropout, of which control laws know."""
        none = ("latency_s", "latency_jitter_s", "latency_std_s", "dropout")
        timing = self.runs.timing.model_copy(update=dict.fromkeys(none, 0.0))
        settings, known = (
            replace(loop, timing=replace(loop.timing, latency_s=0.0))
            for loop in (self.settings, self.loop.side.settings)
        )
        return replace(
            self,
            settings=settings,
            loop=replace(self.loop, side=replace(self.loop.side, settings=known, timing=timing)),
            runs=replace(self.runs, timing=timing),
        )

    def truth(self, run: ClosedLoopRun) -> xr.Dataset:
        """Return the truth of a run: motion, parameters without load, and model mismatch."""
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
        # These are already among the parameters or variables.
        stated = {"drive_gains", "values", "inertia", "gains", "passive_friction"}
        stated |= {"joint_zero_error_rad", "joint_zero_error_m"}
        switches = self.switches.model_dump(exclude_none=True, exclude=stated)
        return truth.assign_attrs({f"plant_{name}": value for name, value in switches.items()})

    def _mismatch(self, run: ClosedLoopRun) -> dict[str, ArrayLike]:
        geometry = self.robot.geometry
        known = self.nominal.geometry
        mismatch: dict[str, ArrayLike] = {}
        if geometry != known:
            mismatch["base_joint_error"] = geometry.base_joints - known.base_joints
            mismatch["platform_joint_error"] = geometry.platform_joints - known.platform_joints
        if run.motor_angle is not None:
            mismatch["motor_angle"] = run.motor_angle
        if self.settings.drives.joint_zeros:
            mismatch["joint_zero_error"] = np.array(self.settings.drives.joint_zeros)
        return mismatch

    def _settings_at(self, parameters: Array, pose: Array) -> LoopSettings:
        """Return the settings with enough steps per frame for the vibration of elastic joints."""
        settings = self.settings
        springs = self.settings.elasticity
        if springs is None:
            return settings
        period = self.runs.timing.frame_period_s
        needed = springs.steps_needed(self.robot, parameters, pose, period, settings.friction)
        return replace(settings, steps_per_frame=max(settings.steps_per_frame, needed))


def with_command_errors(
    settings: LoopSettings, nominal: Robot, switches: PlantSwitches, zeros: bool
) -> LoopSettings:
    """Return the settings of a loop with the errors of commands on their way to a plant's drives.

    They are joint zeros, scale, resolution and limits. zeros: False if the true geometry already
    contains the zeros of the joints, as for a plant whose geometry is calibrated. Raises the
    ScenarioErrors of `true_zeros`.
    """
    errors = true_zeros(nominal, switches)
    limits = of_actuators(nominal, switches, "command_limits")
    drives = replace(
        settings.drives,
        joint_zeros=tuple(errors.tolist()) if zeros and errors.any() else (),
        command_scale=switches.command_scale,
        command_step=of_actuators(nominal, switches, "command_quantum"),
        command_limits=None if limits is None else tuple(limits),
    )
    return replace(settings, drives=drives)


def with_uneven_friction(
    settings: LoopSettings, robot: Robot, switches: PlantSwitches
) -> LoopSettings:
    """Return the settings of a loop with the offsets of the friction of a plant's robot.

    Raises the ScenarioErrors of `true_friction_offsets`, and dynamics.SimulationError for a law of
    the drives that balances no offset.
    """
    offsets = true_friction_offsets(robot, switches)
    if not offsets.any():
        return settings
    drives = replace(settings.drives, friction_offset=tuple(offsets.tolist()))
    return replace(settings, drives=drives)


def with_springs(settings: LoopSettings, nominal: Robot, switches: PlantSwitches) -> LoopSettings:
    """Return the settings of a loop with the elastic joints of a plant, if it has any."""
    stiffness = of_actuators(nominal, switches, "joint_stiffness")
    if stiffness is None:
        return settings
    inertia = of_actuators(nominal, switches, "motor_inertia")
    damping = of_actuators(nominal, switches, "joint_damping")
    return replace(settings, elasticity=JointElasticity(stiffness, inertia, damping))


@dataclass(frozen=True)
class PlatformLoad:
    """Load on the platform.

    ``figures`` and ``figures_std`` (7,) are the stated figures of `record.load` and their standard
    deviations, and ``true_figures`` (7,) the true ones. ``stated`` and ``true`` are the changes of
    the parameters (p,) by the stated and the true load, and ``std`` (p,) the standard deviations of
    these changes.
    """

    figures: Array
    figures_std: Array
    true_figures: Array
    stated: Array
    std: Array
    true: Array


def drawn_load(layout: ParameterLayout, load: Payload, rng: np.random.Generator) -> PlatformLoad:
    """Draw the true load about a stated load, with the stated standard deviations.

    Draws with a negative mass or moment are repeated. Raises the RecordError of `load_parameters`.
    """
    figures = np.array(load.figures)
    std = np.array(load.figures_std)

    def drawn() -> Array:
        # As in earlier versions, a number is drawn for each parameter, so a seed keeps its load.
        numbers = rng.standard_normal(len(layout.names))
        return figures + std * numbers[[0, 4, 5, 6, 1, 2, 3]]

    true = drawn()
    while (true[[0, 4, 5, 6]] < 0).any():
        true = drawn()
    changes_std = np.linalg.norm(load_errors(layout, figures, std), axis=1)
    return PlatformLoad(
        figures,
        std,
        true,
        load_parameters(layout, figures),
        changes_std,
        load_parameters(layout, true),
    )
