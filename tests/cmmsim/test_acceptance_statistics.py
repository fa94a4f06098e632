"""Statistics and latency of made-up series whose truth is known."""

import numpy as np
import pytest
from scipy.stats import norm

import cmmsim
from cmmsim.acceptance import PUBLISHED, estimate_latency, interval_of_mean, summarise
from cmmsim.acceptance.statistics import published


def test_statistics_of_known_values_and_of_none():
    """1 to 100: mean 50.5, mean square 101 * 201 / 6, largest 100; Student's t with two values: 12.706 times half of
    their distance."""
    found = summarise(np.arange(1.0, 101.0), np.random.default_rng(0))
    assert (found.count, found.mean, found.maximum) == (100, 50.5, 100.0)
    assert found.rms == pytest.approx(np.sqrt(101 * 201 / 6))
    assert found.p95 == pytest.approx(95.05)
    assert interval_of_mean(np.array([1.0, 3.0])) == pytest.approx((2.0 - 12.7062, 2.0 + 12.7062), rel=1e-5)
    with pytest.raises(cmmsim.ShapeError, match="two values"):
        interval_of_mean(np.array([1.0]))
    for values in (np.zeros(0), np.array([1.0, np.nan]), np.zeros((2, 2))):
        with pytest.raises(cmmsim.ShapeError, match="finite values"):
            summarise(values, np.random.default_rng(0))


def test_intervals_hold_the_truth_as_often_as_they_say():
    """Half-normal errors: mean sqrt(2/pi), rms 1, 95th percentile the 97.5 % point of the normal distribution."""
    truth = {"mean": np.sqrt(2.0 / np.pi), "rms": 1.0, "p95": norm.ppf(0.975)}
    rng = np.random.default_rng(1)
    held = dict.fromkeys(truth, 0)
    for _ in range(200):
        found = summarise(np.abs(rng.standard_normal(200)), rng)
        for name, value in truth.items():
            held[name] += found.interval[name][0] <= value <= found.interval[name][1]
    assert all(0.88 < count / 200 < 0.99 for count in held.values()), held


def test_blocks_widen_the_interval_of_dependent_values():
    """Each value ten times in a row: the interval must be that of the different values, sqrt(10) times wider."""
    rng = np.random.default_rng(2)
    values = np.abs(rng.standard_normal(200))
    widths = []
    for series, block in ((values, 1), (np.repeat(values, 10), 1), (np.repeat(values, 10), 10)):
        low, high = summarise(series, np.random.default_rng(3), block).interval["mean"]
        widths.append(high - low)
    assert widths[1] == pytest.approx(widths[0] / np.sqrt(10.0), rel=0.15)
    assert widths[2] == pytest.approx(widths[0], rel=0.25)


def ellipse(times):
    """A motion that never stands still, and is at a place only once a second."""
    angle = 2.0 * np.pi * times
    return np.column_stack([0.05 * np.cos(angle), 0.08 * np.sin(angle), 0.01 * np.sin(angle)])


def reports(delays, noise, rng, shift=(0.0, 0.0, 0.0)):
    taken = np.arange(len(delays)) / 60.0
    return taken + delays, ellipse(taken) + shift + noise * rng.standard_normal((len(delays), 3))


def test_known_latency_is_found_within_its_interval():
    """14.2 ms under 10 um of noise and a constant offset: in the interval in 95 of 100 series, exact on average."""
    means, held = [], 0
    for seed in range(100):
        reported, positions = reports(np.full(120, 0.0142), 1e-5, np.random.default_rng(seed), (1e-3, -2e-3, 5e-4))
        found = estimate_latency(reported, positions, ellipse, 0.5, np.tile(1e-10 * np.eye(3), (120, 1, 1)))
        means.append(found.mean)
        held += found.interval[0] <= 0.0142 <= found.interval[1]
        assert found.std == pytest.approx(found.resolution, rel=0.35)
    assert 88 <= held <= 100
    spread = np.std(means) / 10.0
    assert abs(np.mean(means) - 0.0142) < 4.0 * spread
    assert spread < 1e-6


def test_jitter_is_seen_report_by_report():
    rng = np.random.default_rng(4)
    delays = 0.0142 + rng.uniform(0.0, 0.003, 120)
    reported, positions = reports(delays, 1e-6, rng)
    found = estimate_latency(reported, positions, ellipse, 0.5)
    np.testing.assert_allclose(found.delays, delays, atol=2e-4)
    assert found.mean == pytest.approx(delays.mean(), abs=1e-5)
    assert found.std == pytest.approx(delays.std(ddof=1), rel=0.05)
    assert found.maximum == pytest.approx(delays.max(), abs=2e-4)


@pytest.mark.parametrize("latency", [0.0, 0.004, 0.1, 0.45])
def test_noise_free_latency_is_exact(latency):
    reported, positions = reports(np.full(60, latency), 0.0, np.random.default_rng(0))
    found = estimate_latency(reported, positions, ellipse, 0.5)
    assert found.mean == pytest.approx(latency, abs=1e-9)
    assert found.std < 1e-9


def test_latency_needs_a_motion():
    times = np.arange(10) / 60.0
    with pytest.raises(cmmsim.ShapeError, match="never stands still"):
        estimate_latency(times, np.zeros((10, 3)), lambda t: np.zeros((len(t), 3)), 0.5)
    with pytest.raises(cmmsim.ShapeError, match="four reports"):
        estimate_latency(times[:3], np.zeros((3, 3)), ellipse, 0.5)


def test_published_figures_have_units_and_quantities():
    assert {figure.unit for figure in PUBLISHED} == {"mm", "deg", "ms"}
    assert {f.instrument: f.value for f in published("position, moving")} == {
        "Creaform C-Track 780": 0.2,
        "NIST, 12 cameras": 0.2,
    }
    assert published("weight") == ()
