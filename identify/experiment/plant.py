"""The simulated real robot of a scenario: what it does and carries, and where it is not the robot that is known."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from dynamics import Robot
from dynamics.analysis.geometry_error import with_geometry_error
from dynamics.closed_loop import ClosedLoopRun, LoopSettings, PoseSensor, RateSensor, Reference, simulate
from identify.arrays import Array
from identify.record.loop_setup import plant_settings
from identify.record.payload import payload_vector
from identify.scenario import Scenario

# The load on the platform in the second run of an experiment: as its experimenter states it, and as it is.


@dataclass(frozen=True)
class PlatformLoad:
    """What a load adds to the parameters (67,): the stated values with their standard deviations, and the true ones."""

    stated: Array
    std: Array
    true: Array


def drawn_load(scenario: Scenario, rng: np.random.Generator) -> PlatformLoad:
    """The scenario's load, whose true figures miss the stated ones by the stated deviations; no figure is negative."""
    stated, std = scenario_payload(scenario), scenario_payload_std(scenario)
    true = stated + std * rng.standard_normal(stated.shape)
    while (true < 0).any():
        true = stated + std * rng.standard_normal(stated.shape)
    return PlatformLoad(stated, std, true)


def scenario_payload(scenario: Scenario) -> Array:
    """What the scenario's load adds to the parameters (67,), as stated."""
    load = scenario.payload
    return payload_vector(load.mass_kg, (load.Ixx_kg_m2, load.Iyy_kg_m2, load.Izz_kg_m2))


def scenario_payload_std(scenario: Scenario) -> Array:
    """Standard deviations (67,) of what the scenario's load adds to the parameters."""
    load = scenario.payload
    return payload_vector(load.mass_std_kg, (load.Ixx_std_kg_m2, load.Iyy_std_kg_m2, load.Izz_std_kg_m2))


# The simulated real robot of a scenario: what it does, and where it is not the robot that servo and estimator know.


def plant_robot(scenario: Scenario, nominal: Robot) -> Robot:
    """The nominal robot with the scenario's geometry error; itself where there is none."""
    plant = scenario.plant
    return with_geometry_error(nominal, plant.geometry_error_m, np.random.default_rng(plant.geometry_seed))


def check_plant(scenario: Scenario, nominal: Robot, parameters: Array) -> None:
    """Raise dynamics.DynamicsError, with the evidence, where a plant with parameters (67,) cannot be simulated."""
    _with_steps_enough(plant_settings(scenario), plant_robot(scenario, nominal), parameters, nominal.home_pose)


def simulate_plant(
    scenario: Scenario,
    nominal: Robot,
    parameters: Array,
    reference: Reference,
    sensor: PoseSensor | RateSensor | None = None,
    latencies: Array | None = None,
) -> ClosedLoopRun:
    """Run the plant with parameters (67,) under a servo that knows the nominal robot; sensor None: an ideal one.

    Raises what `dynamics.closed_loop.simulate` does.
    """
    plant = plant_robot(scenario, nominal)
    settings = _with_steps_enough(plant_settings(scenario), plant, parameters, reference.poses[0])
    known = None if plant is nominal else nominal
    return simulate(plant, parameters, reference, settings, sensor, latencies=latencies, servo_robot=known)


def mismatch(scenario: Scenario, nominal: Robot, run: ClosedLoopRun) -> dict[str, ArrayLike]:
    """What of the plant's truth the model has no place for, by the names of `identify.experiment.truth.MISMATCH`."""
    geometry, known = plant_robot(scenario, nominal).geometry, nominal.geometry
    found: dict[str, ArrayLike] = {}
    if geometry != known:
        found["base_joint_error"] = geometry.base_joints - known.base_joints
        found["platform_joint_error"] = geometry.platform_joints - known.platform_joints
    if run.motor_angle is not None:
        found["motor_angle"] = run.motor_angle
    return found


def _with_steps_enough(settings: LoopSettings, plant: Robot, parameters: Array, pose: Array) -> LoopSettings:
    """The settings, with more steps a frame where elastic joints vibrate too fast for theirs."""
    if settings.elasticity is None:
        return settings
    period = 1 / settings.timing.frame_rate_hz
    needed = settings.elasticity.steps_needed(plant, parameters, pose, period, settings.friction)
    return replace(settings, steps_per_frame=max(settings.steps_per_frame, needed))
