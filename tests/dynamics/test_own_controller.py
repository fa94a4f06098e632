"""A controller of the caller's in the place of the servo, against the servo itself, and what it may not return."""

import numpy as np
import pytest

from dynamics.closed_loop import simulate
from dynamics.errors import SimulationError

FRAMES = 40


class PaperServo:
    """Eq. 30, written down once more from the robot's public Jacobian; it starts as the loop's equilibrium does."""

    def __init__(self, robot, settings, start):
        self.robot, self.gains = robot, settings.servo
        self.period = 1 / settings.timing.frame_rate_hz
        self.before, self.before_at = start, -self.period
        angles = robot.inverse_kinematics(start)
        self.integral = np.linalg.solve(robot.pose_jacobian(start), angles) / self.gains.ki

    def __call__(self, frame, t, measured, desired, desired_rate):
        error = desired - measured
        self.integral = self.integral + self.period * error
        rate = (measured - self.before) / (t - self.before_at)
        self.before, self.before_at = measured, t
        demand = self.gains.kp * error + self.gains.kd * (desired_rate - rate) + self.gains.ki * self.integral
        return self.robot.pose_jacobian(measured) @ demand


def noisy(frame, t, pose):
    return None if frame in (5, 6, 17) else pose + 1e-5 * np.sin(1.7 * frame + np.arange(6))


@pytest.mark.parametrize("latency_s", [0.0, 0.025])
@pytest.mark.parametrize("compiled", [None, False])
def test_the_servo_written_by_a_user_runs_as_the_built_in_one(
    robot, identified, make_reference, make_settings, latency_s, compiled
):
    """With a noisy sensor that loses frames, late commands, against both paths."""
    reference, settings = make_reference(FRAMES), make_settings(latency_s=latency_s)
    own = simulate(
        robot, identified, reference, settings, noisy, controller=PaperServo(robot, settings, reference.poses[0])
    )
    built_in = simulate(robot, identified, reference, settings, noisy, compiled=compiled)
    np.testing.assert_allclose(own.command, built_in.command, atol=1e-11)
    np.testing.assert_allclose(own.pose, built_in.pose, atol=1e-11)
    assert np.abs(np.diff(own.command, axis=0)).max() > 1e-3


def test_a_controller_is_asked_with_copies_where_the_frame_was_measured(
    robot, identified, make_reference, make_settings
):
    reference, asked, command = make_reference(20), [], np.zeros(6)

    def spoiling(frame, t, measured, desired, desired_rate):
        asked.append((frame, t))
        assert np.array_equal(desired, reference.poses[frame])
        assert np.array_equal(desired_rate, reference.rates[frame])
        command[:] = robot.inverse_kinematics(desired)
        measured[:] = np.nan
        return command

    run = simulate(robot, identified, reference, make_settings(), noisy, controller=spoiling)
    good = [frame for frame in range(20) if frame not in (5, 6, 17)]
    assert asked == [(frame, frame * (1 / 60)) for frame in good]
    assert np.isfinite(run.measured[good]).all()
    np.testing.assert_array_equal(run.command[good], robot.inverse_kinematics(reference.poses[good]))
    np.testing.assert_array_equal(run.command[[5, 6, 17]], run.command[[4, 4, 16]])


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (None, r"what the controller returned at frame 0 must be numbers .*None"),
        (np.zeros(5), r"what the controller returned at frame 0 must have shape \(6,\), got \(5,\)"),
        (np.full(6, np.nan), r"what the controller returned at frame 0\[0\] is nan, must be finite"),
        ("still", r"what the controller returned at frame 0 must be numbers"),
    ],
    ids=["nothing", "five", "nan", "text"],
)
def test_what_is_no_command_is_refused(robot, identified, make_reference, make_settings, answer, message):
    with pytest.raises(SimulationError, match=message):
        simulate(robot, identified, make_reference(3), make_settings(), controller=lambda *_: answer)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"controller": 3}, "controller must be a function, or None for the servo, got 3"),
        ({"sensitivities": True}, "sensitivities are those of the servo: pass controller=None"),
        ({"commands": np.zeros((3, 6))}, "commands take the place of any controller: pass controller=None"),
        ({"compiled": True}, "a controller runs on the plain path: pass compiled=None or False"),
    ],
)
def test_what_does_not_go_with_a_controller_is_refused(
    robot, identified, make_reference, make_settings, options, message
):
    chosen = {"controller": lambda *_: np.zeros(6)} | options
    with pytest.raises(SimulationError, match=message):
        simulate(robot, identified, make_reference(3), make_settings(), **chosen)
