"""Runs under commands at any times, against runs on a grid of frames."""

from dataclasses import replace

import numpy as np
import pytest

from dynamics import load_robot
from dynamics.closed_loop import (
    FrameTiming,
    FrictionLaw,
    LoopSettings,
    Reference,
    ServoGains,
    differentiate_commands,
    simulate_commands,
    simulate_servo,
)
from dynamics.errors import SimulationError

FRAMES = 90
RATE_HZ = 60.0
SERVO = ServoGains(kp=0.3, kd=0.001, ki=2.4)


@pytest.fixture(scope="module")
def robot():
    return load_robot("rss6")


@pytest.fixture(scope="module")
def parameters(robot):
    return robot.parameter_sets["truth"].vector


def moving(robot, frames=FRAMES, rate_hz=RATE_HZ):
    """A reference that begins at rest and moves up and down."""
    time = np.arange(frames) / rate_hz
    poses = np.tile(robot.home_pose, (frames, 1))
    rates = np.zeros((frames, 6))
    poses[:, 2] += 0.01 * (1 - np.cos(5 * time))
    rates[:, 2] = 0.05 * np.sin(5 * time)
    return Reference(poses, rates)


def still(robot, frames):
    return Reference(np.tile(robot.home_pose, (frames, 1)), np.zeros((frames, 6)))


@pytest.mark.parametrize(
    ("latency_s", "hold"), [(0.0, "zero"), (0.007, "zero"), (0.007, "linear"), (0.03, "linear")]
)
def test_events_at_frames_and_arrivals_of_commands_repeat_the_run_on_the_grid(
    robot, parameters, latency_s, hold
):
    """Poses, and their derivatives by parameters and start, to rounding."""
    reference = moving(robot)
    settings = LoopSettings(SERVO, FrameTiming(RATE_HZ, latency_s, hold))
    commands = simulate_servo(robot, parameters, reference, settings).command
    known = differentiate_commands(robot, parameters, reference, settings, commands, by_start=True)
    directions = np.random.default_rng(3).standard_normal((FRAMES, 6, 2))
    moved = differentiate_commands(
        robot, parameters, reference, settings, commands, directions=directions
    )
    frames = np.arange(FRAMES) / RATE_HZ
    acting = frames + latency_s
    acting = acting[acting < frames[-1]]
    times = np.union1d(frames, acting)
    sent = np.full((len(times), 6), np.nan)
    sent[np.searchsorted(times, acting)] = commands[: len(acting)]
    at_once = LoopSettings(SERVO, FrameTiming(RATE_HZ, 0.0, hold))
    found = differentiate_commands(
        *(robot, parameters, still(robot, len(times)), at_once, sent),
        start=known.start,
        times=times,
        by_start=True,
    )
    rows = np.searchsorted(times, frames)
    assert np.abs(found.pose[rows] - known.pose).max() < 1e-12
    for name in ("pose_sensitivity", "start_sensitivity"):
        one, other = getattr(found, name)[rows], getattr(known, name)
        assert np.abs(one - other).max() < 1e-9 * np.abs(other).max()
    # each row has the direction of the command that was sent last
    last = np.searchsorted(acting, times, side="right") - 1
    held = np.where((last >= 0)[:, None, None], directions[last], 0.0)
    along = differentiate_commands(
        *(robot, parameters, still(robot, len(times)), at_once, sent),
        start=known.start,
        times=times,
        directions=held,
    ).command_sensitivity[rows]
    most = np.abs(moved.command_sensitivity).max()
    assert np.abs(along - moved.command_sensitivity).max() < 1e-9 * most


def test_a_sensor_is_told_the_times_of_the_run(robot, parameters):
    told = []
    times = np.array([0.0, 0.01, 0.04, 0.045])
    sent = np.tile(robot.inverse_kinematics(robot.home_pose), (4, 1))
    settings = LoopSettings(SERVO, FrameTiming(RATE_HZ))
    sensor = lambda frame, time, pose: told.append(time)  # noqa: E731
    simulate_commands(
        robot, parameters, still(robot, 4), settings, sent, sensor=sensor, times=times
    )
    assert told == times.tolist()


def test_commands_from_before_the_start_have_a_direction_of_their_own(robot, parameters):
    """The derivative is the difference of two runs, without friction of joints that stick."""
    smooth = FrictionLaw("smoothed", smoothing_velocity=0.1)
    settings = LoopSettings(SERVO, FrameTiming(RATE_HZ), smooth)
    known = simulate_servo(robot, parameters, moving(robot), settings)
    times = np.arange(FRAMES) / RATE_HZ
    sent = np.full((FRAMES, 6), np.nan)
    sent[20::3] = known.command[20::3]
    direction = np.random.default_rng(4).standard_normal((6, 1))
    given = robot, parameters, still(robot, FRAMES), settings, sent
    start = replace(known.start, commands=np.tile(known.start.commands, (2, 1)), latencies=None)
    held = np.zeros((FRAMES, 6, 1))
    held[:20] = direction
    found = differentiate_commands(
        *given, start=start, times=times, directions=held, start_directions=direction
    ).command_sensitivity[:, :, 0]
    more, less = (
        simulate_commands(
            *given,
            start=replace(start, commands=start.commands + sign * 1e-5 * direction[:, 0]),
            times=times,
        ).pose
        for sign in (1, -1)
    )
    assert np.abs(found).max() > 1e-3
    assert np.abs(found - (more - less) / 2e-5).max() < 1e-6 * np.abs(found).max()


def test_poses_at_any_times_are_those_of_a_grid_that_contains_them(robot, parameters):
    """A grid of 60 Hz with commands, and the same commands on a grid sixteen times finer."""
    reference = moving(robot)
    settings = LoopSettings(SERVO, FrameTiming(RATE_HZ))
    commands = simulate_servo(robot, parameters, reference, settings).command
    fine = 16
    ticks = np.arange(fine * (FRAMES - 1) + 1)
    sent = np.full((len(ticks), 6), np.nan)
    sent[::fine] = commands
    every = simulate_commands(
        robot, parameters, still(robot, len(ticks)), settings, sent, times=ticks / (fine * RATE_HZ)
    )
    rng = np.random.default_rng(0)
    drawn = np.sort(rng.choice(ticks[1:], 60, replace=False))
    chosen = np.union1d(drawn, ticks[::fine])
    written = np.full((len(chosen), 6), np.nan)
    written[np.isin(chosen, ticks[::fine])] = commands
    some = simulate_commands(
        *(robot, parameters, still(robot, len(chosen)), settings, written),
        times=chosen / (fine * RATE_HZ),
    )
    assert np.count_nonzero(drawn % fine) > 40
    assert np.abs(some.pose - every.pose[chosen]).max() < 1e-8
    np.testing.assert_array_equal(some.time, chosen / (fine * RATE_HZ))


@pytest.mark.parametrize(
    ("times", "row", "says"),
    [
        ([0.0, 0.02, 0.02], None, "frame 2 is at 0.02 s and frame 1 at 0.02 s"),
        ([0.0, np.nan, 0.02], None, r"times\[1\] is nan"),
        ([0.0, 0.01, 0.02], (1, slice(2, 3)), "commands of frame 1 .* or NaN as a whole"),
        ([0.0, 0.01, 0.02], (0, slice(None)), "first frame issues no command needs a start"),
    ],
)
def test_wrong_times_and_half_commands_are_refused(robot, parameters, times, row, says):
    commands = np.zeros((3, 6))
    if row is not None:
        commands[row] = np.nan
    settings = LoopSettings(SERVO, FrameTiming(RATE_HZ))
    with pytest.raises(SimulationError, match=says):
        simulate_commands(
            robot, parameters, still(robot, 3), settings, commands, times=np.array(times)
        )
