"""The linear map of the sampled loop, against runs of the loop itself."""

from dataclasses import replace

import numpy as np
import pytest

from dynamics.closed_loop import (
    Drives,
    FrameTiming,
    LoopFailure,
    LoopSettings,
    ServoGains,
    equilibrium,
    stability,
)
from dynamics.closed_loop.drives import DRIVES
from tests.dynamics.conftest import at_rest

PERIOD = 1 / 60
SERVO = ServoGains(0.3, 0.001, 2.4)


@pytest.mark.parametrize(
    ("hold", "latency", "law"),
    [
        *(
            (hold, latency, "pid")
            for hold in ("zero", "linear")
            for latency in (0.0, 0.004, PERIOD, 2.7 * PERIOD)
        ),
        *(("linear", 0.004, law) for law in DRIVES[1:-1]),
        pytest.param("linear", 0.004, DRIVES[-1], marks=pytest.mark.thorough),
    ],
)
def test_small_deviations_follow_the_map_from_frame_to_frame(loop, hold, latency, law):
    """Half a second from a pose 1e-6 off, without dry friction: nothing but the square of the
    deviation is missing.
    """
    robot, values, frames, off = loop.robot, loop.parameters.copy(), 30, 1e-6
    values[robot.layout.coulomb] = 0.0
    drives = Drives(law=law, filter_time=0.008 if law == "pid_filtered" else None)
    settings = LoopSettings(
        SERVO, FrameTiming(60.0, latency, hold), steps_per_frame=20, drives=drives
    )
    start = equilibrium(robot, values, robot.home_pose, SERVO, drives=drives)
    direction = np.random.default_rng(0).standard_normal(6)
    starts = [start, replace(start, pose=start.pose + off * direction)]
    still, moved = (
        loop.run(at_rest(start.pose, frames), settings, values, start=each).pose for each in starts
    )
    one_frame = stability.frame_map(robot, values, settings, robot.home_pose)
    state, expected = np.append(direction, np.zeros(len(one_frame) - 6)), []
    for _ in range(frames):
        expected.append(state[:6])
        state = one_frame @ state
    np.testing.assert_allclose((moved - still) / off, expected, atol=2e-5)


@pytest.mark.parametrize(("radius", "ends_at"), [(0.5, 0.5), (2.0, 100.0)])
def test_the_search_for_a_limit_ends_at_its_end(radius, ends_at):
    tried = []
    found = stability.last_stable(lambda at: tried.append(at) or radius, 60.0, 0.5, 100.0)
    np.testing.assert_equal(found, ends_at if radius < 1 else np.nan)
    assert tried[-1] == ends_at


def test_no_lower_rate_is_tried_for_an_unstable_loop_of_many_frames_of_latency(loop, monkeypatch):
    tried = []
    monkeypatch.setattr(
        stability, "_radius", lambda _, given: tried.append(given.timing.frame_rate_hz) or 2.0
    )
    settings = LoopSettings(SERVO, FrameTiming(60.0, 55 * PERIOD))
    robot = loop.robot
    rate = stability.lowest_frame_rate(robot, loop.parameters, settings, robot.home_pose)
    np.testing.assert_equal((rate, min(tried)), (np.nan, 60.0))


def test_the_loop_is_lost_where_the_limits_say(loop):
    """Gains and frame rate on both sides of their limits, in runs: small deviations die out, or
    grow until the robot leaves its reach."""
    robot, values = loop.robot, loop.parameters.copy()
    values[robot.layout.coulomb] = 0.0
    given = LoopSettings(SERVO, FrameTiming(60.0, PERIOD))
    factor = stability.gain_margin(robot, values, given, robot.home_pose)
    rate = stability.lowest_frame_rate(robot, values, given, robot.home_pose)
    assert (factor > 1, rate < 60) == (True, True)

    def last_deviation(gain: float, hz: float) -> float:
        servo = ServoGains(gain * SERVO.kp, gain * SERVO.kd, gain * SERVO.ki)
        settings = LoopSettings(servo, FrameTiming(hz, PERIOD))
        start = equilibrium(robot, values, robot.home_pose, servo)
        start = replace(start, pose=start.pose + 1e-6)
        try:
            run = loop.run(at_rest(robot.home_pose, 400), settings, values, start=start)
        except LoopFailure:
            return np.inf
        return np.abs(run.pose[-1] - robot.home_pose).max()

    for inside, outside in (
        ((0.9 * factor, 60.0), (1.1 * factor, 60.0)),
        ((1.0, 1.05 * rate), (1.0, 0.95 * rate)),
    ):
        assert last_deviation(*inside) < 1e-6 < last_deviation(*outside)
