"""Test your own controller: any callable from measurement and reference to a command.

This one is proportional: the crank angles of the desired pose, corrected by what the sensor still
sees of the error. The stereo sensor is in the loop, as it is for the built-in visual servo beside
which it is judged.
"""

import numpy as np
import pytest

import dynamics
from dynamics.closed_loop import (
    FrameTiming,
    LoopSettings,
    Reference,
    ServoGains,
    simulate_controller,
    simulate_servo,
)

RATE_HZ, FRAMES = 60.0, 90
AMPLITUDE = np.array([0.004, 0.003, 0.003, 0.012, 0.012, 0.015])  # m and rad
FREQUENCY = 2 * np.pi * np.array([0.6, 0.8, 1.0, 0.7, 0.9, 0.5])  # rad/s


class ProportionalController:
    """Map (frame, time, measured pose, desired pose, desired rate) to a joint command (6,) [rad]."""

    def __init__(self, robot: dynamics.Robot, gain: float) -> None:
        self.robot, self.gain = robot, gain

    def __call__(
        self,
        frame: int,
        time: float,
        measured: np.ndarray,
        desired: np.ndarray,
        desired_rate: np.ndarray,
    ) -> np.ndarray:
        correction = self.robot.pose_jacobian(measured) @ (desired - measured)
        return self.robot.inverse_kinematics(desired) + self.gain * correction


@pytest.fixture
def reference(cmmsim_robot):
    """Sines that start gently from rest."""
    time = np.arange(FRAMES)[:, None] / RATE_HZ
    growth, growth_rate = (
        1 - np.exp(-((time / 0.3) ** 3)),
        3 * time**2 / 0.3**3 * np.exp(-((time / 0.3) ** 3)),
    )
    wave, wave_rate = np.sin(FREQUENCY * time), FREQUENCY * np.cos(FREQUENCY * time)
    poses = cmmsim_robot.home_pose + AMPLITUDE * growth * wave
    return Reference(poses, AMPLITUDE * (growth_rate * wave + growth * wave_rate))


def test_tracking_error(accuracy, cmmsim_robot, cmmsim_sensor, cmmsim_seed, reference):
    plant = cmmsim_robot.parameter_sets["truth"].vector
    settings = LoopSettings(ServoGains(kp=0.3, kd=0.001, ki=2.4), FrameTiming(RATE_HZ))

    def track(controller=None):
        cmmsim_sensor.start_run(cmmsim_seed)
        given = cmmsim_robot, plant, reference, settings
        sensor = lambda _frame, _time, pose: cmmsim_sensor.measure(pose).pose  # noqa: E731
        if controller is None:
            run = simulate_servo(*given, sensor)
        else:
            run = simulate_controller(*given, controller, sensor)
        return 1e6 * np.sqrt(np.mean((run.pose - reference.poses) ** 2, axis=0))

    own, built_in = track(ProportionalController(cmmsim_robot, gain=0.5)), track()
    accuracy.record("tracking position, proportional", own[:3].max(), unit="um", limit=1000)
    accuracy.record("tracking orientation, proportional", own[3:].max(), unit="urad", limit=4000)
    accuracy.record("tracking position, built-in servo", built_in[:3].max(), unit="um")
    accuracy.record("tracking orientation, built-in servo", built_in[3:].max(), unit="urad")
