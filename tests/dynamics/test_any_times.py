"""Runs under commands at any times, against runs on a grid of frames."""

import numpy as np
import pytest

from dynamics import load_robot
from dynamics.closed_loop import (
    FrameTiming,
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
