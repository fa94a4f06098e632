"""Latencies that differ from frame to frame: when each command acts, against the definition written out for a clock."""

import numpy as np
import pytest

from dynamics import closed_loop, compilation
from dynamics.closed_loop.command_schedule import command_schedule
from dynamics.errors import SimulationError

PERIOD = 1 / 60
FRAMES = 24
JITTERED = PERIOD * np.random.default_rng(3).uniform(0.0, 3.2, FRAMES)
RECORDS = ("pose", "pose_rate", "torque", "command", "joint_integral", "servo_integral")


@pytest.fixture(scope="module", autouse=True)
def compiler():
    if compilation.find_compiler() is None:
        pytest.skip("needs a C compiler")


def acting_command(t, latencies, usual, hold, commands, start):
    """Command (6,) at time t: the definition, by a clock. `commands` (frames, 6), before them `start` (6,)."""
    before = 6
    issued = PERIOD * np.arange(-before, len(commands))
    arrival = np.maximum.accumulate(issued + np.concatenate([np.full(before, usual), latencies]))
    values = np.vstack([np.tile(start, (before, 1)), commands])
    newest = np.flatnonzero(arrival <= t + 1e-12)[-1]
    if hold == "zero":
        return values[newest]
    done = min((t - arrival[newest]) / PERIOD, 1.0)
    return values[newest - 1] + done * (values[newest] - values[newest - 1])


def scheduled_command(t, spans, commands, start):
    """The same from a schedule: the span that holds t, and the straight line in it."""
    begins = np.concatenate([[0.0], np.cumsum(spans.duration)])
    span = np.searchsorted(begins, t + 1e-12, side="right") - 1
    number, ramp = spans.command[span], spans.ramp[span]
    now, before = (commands[n] if n >= 0 else start for n in (number, number - 1))
    return now if ramp == 1 else before + (ramp + (t - begins[span]) / PERIOD) * (now - before)


def problem_of(settings, latencies):
    """As much of a problem as a schedule needs."""

    class Problem:
        frames, period = FRAMES, PERIOD

    problem = Problem()
    problem.settings = settings
    problem.latencies = None if latencies is None else np.asarray(latencies)
    return problem


@pytest.mark.parametrize("hold", ["zero", "linear"])
@pytest.mark.parametrize("latencies", [JITTERED, np.full(FRAMES, 1.3 * PERIOD), np.full(FRAMES, 2 * PERIOD), None])
def test_schedule_is_the_definition(make_settings, latencies, hold):
    rng = np.random.default_rng(8)
    commands, start = rng.normal(size=(FRAMES, 6)), rng.normal(size=6)
    usual = 1.3 * PERIOD
    spans = command_schedule(problem_of(make_settings(latency_s=usual, hold=hold), latencies))
    assert spans.duration.sum() == pytest.approx(FRAMES * PERIOD, abs=1e-12)
    each = np.full(FRAMES, usual) if latencies is None else latencies
    for t in rng.uniform(0, FRAMES * PERIOD, 1000):
        expected = acting_command(t, each, usual, hold, commands, start)
        np.testing.assert_allclose(scheduled_command(t, spans, commands, start), expected, atol=1e-9)


def test_a_command_that_would_overtake_waits_for_the_one_before(make_settings):
    """By hand: command 1 needs 2.5 frames, so 2 and 3 wait for it; only the last of the three acts."""
    latencies = PERIOD * np.array([0.0, 2.5, 0.25, 0.5, 0.0, *[0.0] * (FRAMES - 5)])
    spans = command_schedule(problem_of(make_settings(), latencies))
    assert spans.first_span.tolist()[:6] == [0, 1, 2, 3, 5, 6]
    assert spans.command.tolist()[:6] == [0, 0, 0, 0, 3, 4]
    np.testing.assert_allclose(spans.duration[:6], PERIOD * np.array([1, 1, 1, 0.5, 0.5, 1]), atol=1e-12)
    assert spans.steps.tolist()[:6] == [4, 4, 4, 2, 2, 4]


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("hold", ["zero", "linear"])
@pytest.mark.parametrize("delay", [0.0, 0.4, 1.0, 2.7])
def test_equal_latencies_are_the_one_of_the_settings_bit_for_bit(
    robot, identified, make_reference, make_settings, delay, hold, compiled
):
    settings, reference = make_settings(latency_s=delay * PERIOD, hold=hold), make_reference(FRAMES)
    runs = [
        closed_loop.simulate(robot, identified, reference, settings, latencies=latencies, compiled=compiled)
        for latencies in (None, np.full(FRAMES, delay * PERIOD))
    ]
    for name in RECORDS:
        assert np.array_equal(getattr(runs[0], name), getattr(runs[1], name)), name


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_the_torque_is_that_of_the_command_which_acts(robot, identified, make_reference, make_settings, hold):
    """Eq. 31 solved for the command at every frame of a run whose servo is in the loop; both paths agree as well."""
    settings, reference = make_settings(latency_s=1.3 * PERIOD, hold=hold), make_reference(FRAMES)
    runs = [
        closed_loop.simulate(
            robot, identified, reference, settings, latencies=JITTERED, sensitivities=True, compiled=compiled
        )
        for compiled in (True, False)
    ]
    for name in RECORDS:
        ours, other = (getattr(run, name) for run in runs)
        np.testing.assert_allclose(ours, other, rtol=0, atol=1e-9 * np.abs(other).max(), err_msg=name)
    ours, other = (run.pose_sensitivity for run in runs)
    assert (np.abs(ours - other).max(axis=(0, 1)) <= 1e-9 * np.abs(other).max(axis=(0, 1)) + 1e-14).all()
    run, (lp, li, ld) = runs[0], identified[64:]
    start = run.start.commands[-1]
    arrival = np.maximum.accumulate(PERIOD * np.arange(FRAMES) + JITTERED)
    for k in range(FRAMES):
        acting = acting_command(k * PERIOD, JITTERED, 1.3 * PERIOD, hold, run.command, start)
        arrived = np.flatnonzero(arrival <= k * PERIOD + 1e-12)
        newest = arrived[-1] if len(arrived) else -1
        values = np.vstack([start, start, run.command])
        command_rate = (values[newest + 2] - values[newest + 1]) / PERIOD
        velocity = robot.pose_jacobian(run.pose[k]) @ run.pose_rate[k]
        error = acting - robot.inverse_kinematics(run.pose[k])
        expected = lp * error + ld * (command_rate - velocity) + li * run.joint_integral[k]
        np.testing.assert_allclose(run.torque[k], expected, atol=1e-9)


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_sensitivities_with_jitter_are_finite_differences(robot, identified, make_reference, make_settings, hold):
    settings = make_settings(latency_s=1.3 * PERIOD, hold=hold, smoothing_velocity=0.05, steps=8)
    reference, options = make_reference(FRAMES), {"latencies": JITTERED}
    run = closed_loop.simulate(robot, identified, reference, settings, sensitivities=True, **options)
    for index in (0, 52, 58, 64, 65):
        step = np.zeros(67)
        step[index] = 1e-4 * identified[index]
        ahead, behind = (
            closed_loop.simulate(robot, identified + sign * step, reference, settings, **options).pose
            for sign in (1, -1)
        )
        expected = (ahead - behind) / (2 * step[index])
        assert np.abs(run.pose_sensitivity[:, :, index] - expected).max() < 1e-5 * np.abs(expected).max(), index


@pytest.mark.parametrize(
    ("latencies", "message"),
    [
        (np.zeros(FRAMES - 1), r"latencies must have shape \(24,\)"),
        (np.full(FRAMES, np.nan), "latencies"),
        (np.where(np.arange(FRAMES) == 5, -0.01, 0.0), "latency of frame 5 is -0.01 s, must be >= 0"),
        (np.where(np.arange(FRAMES) == 7, 1.1, 0.0), r"latency of frame 7 is 1.1 s, .*at most 60 frames \(1 s\)"),
    ],
)
def test_latencies_that_cannot_be_are_refused(robot, identified, make_reference, make_settings, latencies, message):
    with pytest.raises(SimulationError, match=message):
        closed_loop.simulate(robot, identified, make_reference(FRAMES), make_settings(), latencies=latencies)


@pytest.mark.parametrize("compiled", [True, False])
def test_a_rate_sensor_gets_the_true_pose_and_its_rate(robot, identified, make_reference, make_settings, compiled):
    seen = []

    def measure(frame, time, pose, rate):
        seen.append((frame, time, pose, rate))
        return pose

    settings, reference = make_settings(), make_reference(FRAMES)
    sensor = closed_loop.RateSensor(measure)
    run = closed_loop.simulate(robot, identified, reference, settings, sensor, compiled=compiled)
    frames, times, poses, rates = (np.array(column) for column in zip(*seen, strict=True))
    assert frames.tolist() == list(range(FRAMES))
    assert np.array_equal(times, run.time)
    assert np.array_equal(poses, run.pose)
    assert np.array_equal(rates, run.pose_rate)
    assert np.abs(rates).max() > 0.01
    ideal = closed_loop.simulate(robot, identified, reference, settings, compiled=compiled)
    assert np.array_equal(run.pose, ideal.pose)
