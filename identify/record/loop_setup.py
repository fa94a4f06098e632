"""From scenario and trajectory to the closed loop that plant and model both run."""

from dataclasses import replace

import numpy as np

from dynamics.closed_loop import FrameTiming, FrictionLaw, JointElasticity, LoopSettings, Reference, ServoGains
from identify.arrays import Array
from identify.scenario import Model, Plant, Scenario
from identify.trajectory import FourierTrajectory


def plant_settings(scenario: Scenario) -> LoopSettings:
    """The loop around the simulated real robot, whose joints may be elastic."""
    plant = scenario.plant
    settings = _settings(scenario, plant)
    if plant.joint_stiffness_N_m_rad is None:
        return settings
    springs = JointElasticity(plant.joint_stiffness_N_m_rad, plant.motor_inertia_kg_m2, plant.joint_damping_N_m_s_rad)
    return replace(settings, elasticity=springs)


def model_settings(scenario: Scenario) -> LoopSettings:
    """The loop around the estimator's model: the same servo and timing, its own friction law and steps.

    Of the latency it knows the mean only.
    """
    return _settings(scenario, scenario.model)


def frame_times(scenario: Scenario, duration_s: float) -> Array:
    """Instants of exposure (N,) [s], each the middle of one, of a run: whole frames, the end of the run excluded."""
    return np.arange(scenario.timing.frames(duration_s), dtype=float) * scenario.timing.frame_period_s


def reference_motion(trajectory: FourierTrajectory, times: Array) -> Reference:
    """Desired poses and pose rates at the frames."""
    return Reference(trajectory.pose(times), trajectory.pose_rate(times))


def _settings(scenario: Scenario, side: Plant | Model) -> LoopSettings:
    servo, timing = scenario.servo, scenario.timing
    return LoopSettings(
        servo=ServoGains(servo.kp, servo.kd, servo.ki),
        timing=FrameTiming(timing.frame_rate_hz, timing.latency_s, timing.hold),
        friction=FrictionLaw(
            side.friction, side.smoothing_velocity_rad_s, side.static_ratio, side.stribeck_velocity_rad_s
        ),
        steps_per_frame=side.steps_per_frame,
    )
