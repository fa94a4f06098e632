"""Latencies that differ from frame to frame: when each command acts, against the definition written out for a clock."""

from types import SimpleNamespace

import numpy as np
import pytest

from dynamics.closed_loop.command_schedule import command_schedule
from tests.dynamics.conftest import assert_same

PERIOD = 1 / 60
FRAMES = 24
JITTERED = PERIOD * np.random.default_rng(3).uniform(0.0, 3.2, FRAMES)


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


def spans_of(settings, latencies):
    """The schedule of as much of a problem as it needs."""
    latencies = None if latencies is None else np.asarray(latencies)
    return command_schedule(SimpleNamespace(frames=FRAMES, period=PERIOD, settings=settings, latencies=latencies))


@pytest.mark.parametrize("hold", ["zero", "linear"])
@pytest.mark.parametrize("latencies", [JITTERED, np.full(FRAMES, 1.3 * PERIOD), np.full(FRAMES, 2 * PERIOD), None])
def test_schedule_is_the_definition(loop, latencies, hold):
    rng = np.random.default_rng(8)
    commands, start = rng.normal(size=(FRAMES, 6)), rng.normal(size=6)
    usual = 1.3 * PERIOD
    spans = spans_of(loop.settings(latency_s=usual, hold=hold), latencies)
    assert spans.duration.sum() == pytest.approx(FRAMES * PERIOD, abs=1e-12)
    each = np.full(FRAMES, usual) if latencies is None else latencies
    for t in rng.uniform(0, FRAMES * PERIOD, 1000):
        expected = acting_command(t, each, usual, hold, commands, start)
        np.testing.assert_allclose(scheduled_command(t, spans, commands, start), expected, atol=1e-9)


def test_a_command_that_would_overtake_waits_for_the_one_before(loop):
    """By hand: command 1 needs 2.5 frames, so 2 and 3 wait for it; only the last of the three acts."""
    latencies = PERIOD * np.array([0.0, 2.5, 0.25, 0.5, 0.0, *[0.0] * (FRAMES - 5)])
    spans = spans_of(loop.settings(), latencies)
    assert spans.first_span.tolist()[:6] == [0, 1, 2, 3, 5, 6]
    assert spans.command.tolist()[:6] == [0, 0, 0, 0, 3, 4]
    np.testing.assert_allclose(spans.duration[:6], PERIOD * np.array([1, 1, 1, 0.5, 0.5, 1]), atol=1e-12)
    assert spans.steps.tolist()[:6] == [4, 4, 4, 2, 2, 4]


@pytest.mark.parametrize("hold", ["zero", "linear"])
@pytest.mark.parametrize("delay", [0.0, 0.4, 1.0, 2.7])
def test_equal_latencies_are_the_one_of_the_settings_bit_for_bit(loop, delay, hold):
    settings = loop.settings(latency_s=delay * PERIOD, hold=hold)
    one, each = (spans_of(settings, latencies) for latencies in (None, np.full(FRAMES, delay * PERIOD)))
    for name in ("first_span", "command", "ramp", "duration", "steps"):
        np.testing.assert_array_equal(getattr(one, name), getattr(each, name), err_msg=name)


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_the_torque_is_that_of_the_command_which_acts(loop, robot, identified, hold):
    """Eq. 31 solved for the command at every frame of a run whose servo is in the loop; both paths agree as well."""
    settings, reference = loop.settings(latency_s=1.3 * PERIOD, hold=hold), loop.reference(FRAMES)
    runs = loop.both(reference, settings, latencies=JITTERED, sensitivities=True)
    assert_same(*runs)
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
def test_sensitivities_with_jitter_are_finite_differences(loop, identified, hold):
    settings = loop.settings(latency_s=1.3 * PERIOD, hold=hold, smoothing_velocity=0.05, steps=8)
    reference, options = loop.reference(FRAMES), {"latencies": JITTERED}
    run = loop.run(reference, settings, sensitivities=True, **options)
    for index in (0, 52, 58, 64, 65):
        step = np.zeros(67)
        step[index] = 1e-4 * identified[index]
        ahead, behind = (loop.run(reference, settings, identified + sign * step, **options).pose for sign in (1, -1))
        expected = (ahead - behind) / (2 * step[index])
        assert np.abs(run.pose_sensitivity[:, :, index] - expected).max() < 1e-5 * np.abs(expected).max(), index
