"""Noise and jumps of poses, and clocks, from telemetry alone: the oracle is how it was made."""

import numpy as np
import pytest

from identify.record.delays import motion_lag, servo_delay
from identify.record.recording import poses
from identify.record.smoothness import gross_errors, pose_noise, spectrum
from identify.record.telemetry import CommandLog, PoseLog, Rows, Telemetry
from tests.identify.synthetic import SIGMA, quick, rss6, run_plant

JUMPED_AT = (50, 130)


def moving(rate_hz, rng):
    """Times with a jitter of 0.2 ms, and poses of six frequencies up to 2 Hz with noise."""
    time = np.arange(0, 20, 1 / rate_hz) + rng.uniform(-2e-4, 2e-4, int(20 * rate_hz))
    waves = [0.01 * np.sin(2 * np.pi * one * time) for one in (0.1, 0.3, 0.5, 0.7, 1, 2)]
    return time, np.stack(waves, axis=1) + SIGMA * rng.standard_normal((len(time), 6))


@pytest.mark.slow
@pytest.mark.parametrize("rate_hz", [29, 60, 250])
def test_noise_is_found_to_a_tenth_and_jumps_by_their_times_though_times_jitter(rate_hz):
    time, measured = moving(rate_hz, np.random.default_rng(rate_hz))
    measured[JUMPED_AT, 2] += 2e-4
    np.testing.assert_allclose(pose_noise(time, measured), SIGMA, rtol=0.1)
    np.testing.assert_array_equal(gross_errors(time, measured, np.diag(SIGMA**2)), JUMPED_AT)
    assert spectrum(time, measured, SIGMA).highest_hz == pytest.approx(2.0, abs=0.25)
    still = SIGMA * np.random.default_rng(0).standard_normal((len(time), 6))
    assert spectrum(time, still, SIGMA).highest_hz == 0.0


def test_poses_too_far_apart_tell_no_noise():
    time = np.repeat(np.arange(10.0), 4) + np.tile([0, 0.01, 0.02, 0.03], 10)
    assert np.isnan(pose_noise(time, np.zeros((40, 6)))).all()


@pytest.mark.parametrize("lag", [-0.4, -0.05, 0.0, 0.123])
def test_the_lag_of_a_motion_is_found_between_the_samples_of_both(lag):
    time = np.sort(np.random.default_rng(0).uniform(0, 20, 800))
    command_time = np.arange(-1, 21, 1 / 90)

    def joints(at):
        return np.stack([np.sin(3 * at), np.sin(5 * at + 1), 0.1 * np.sin(7 * at)], axis=1)

    found = motion_lag(time, joints(time - lag), command_time, joints(command_time))
    assert found.seconds == pytest.approx(lag, abs=1e-4)
    assert found.correlation > 0.999


def test_a_lag_of_seconds_is_found_to_a_millisecond_in_a_log_of_minutes():
    """The far lags are tried in coarser steps and with a part of the rows."""
    time = np.arange(0, 120, 1 / 100)
    command_time = np.arange(-60, 180, 1 / 50)
    waves = np.random.default_rng(1).uniform(0.3, 8, (2, 3, 7))  # rad/s, and phases

    def joints(at):
        return np.sin(waves[0] * at[:, None, None] + waves[1]).sum(axis=2)

    found = motion_lag(time, joints(time - 31.2345), command_time, joints(command_time))
    assert found.seconds == pytest.approx(31.2345, abs=1e-3)


@pytest.fixture(scope="module")
def run():
    """A run of 10 s whose commands are written 4 ms after the exposure; some frames are lost."""
    return run_plant(quick(**{"timing.latency_s": 0.004}), 0, lost=tuple(range(60, 64)))[0]


def telemetry(record, command_time, command, written=None):
    ok = record["measured_ok"].values == 1
    rows = Rows("log", range(len(ok)))
    return Telemetry(
        PoseLog(record["time"].values, poses(record, "measured"), ok, rows),
        CommandLog(command_time, command, Rows("log", range(len(command))), written),
    )


@pytest.mark.parametrize("offset_s", [0.0, 0.012, -0.25])
def test_the_delay_of_the_servo_is_found_to_ten_microseconds_whatever_drives_and_friction(
    offset_s, run
):
    """The clock of the commands is ahead by the offset, and 50 ppm fast."""
    time = run["time"].values
    written = (1 + 50e-6) * (time + 0.004) + offset_s
    written[run["measured_ok"].values == 0] = np.nan
    found = servo_delay(telemetry(run, time, run["command"].values, written), rss6())
    middle = 0.004 + offset_s + 50e-6 * np.median(time)
    assert found.seconds == pytest.approx(middle, abs=1e-5)
    assert found.drift == pytest.approx(50e-6, rel=1e-3)
    assert found.correlation < -0.95


def test_commands_logged_more_often_tell_the_delay_to_one_of_their_rows(run):
    time, command = run["time"].values, run["command"].values
    often = np.arange(-0.5, 10.5, 1 / 250)
    places = np.searchsorted(time + 0.004, often, side="right") - 1
    logged = command[np.maximum(places, 0)]
    found = servo_delay(telemetry(run, often, logged, often), rss6())
    assert 0.004 <= found.seconds <= 0.004 + found.resolution == pytest.approx(0.008)
    assert servo_delay(telemetry(run, time, np.round(command, 1), time), rss6()) is None
