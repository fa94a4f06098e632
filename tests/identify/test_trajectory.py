import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import cumulative_simpson

from identify.errors import TrajectoryError
from identify.trajectory import FourierTrajectory, check_travel, random_trajectory
from tests.identify.synthetic import rss6

HOME = np.array([0.0, 0.0, 0.2, 0.0, 0.0, 0.0])


def random_one(seed, harmonics=5, fundamental_hz=0.1):
    return random_trajectory(np.random.default_rng(seed), HOME, fundamental_hz, harmonics, 0.01, 0.04)


def test_single_harmonic_is_equation_37_written_out():
    sine, cosine = np.zeros((6, 2)), np.zeros((6, 2))
    sine[0, 1], cosine[4, 0] = 0.3, -0.2
    trajectory = FourierTrajectory(0.1, sine, cosine, HOME)
    t = 1.7
    expected = HOME.copy()
    expected[0] += np.sin(2 * np.pi * 0.1 * 2 * t) / (2 * np.pi * 0.1 * 2) * 0.3
    expected[4] -= np.cos(2 * np.pi * 0.1 * 1 * t) / (2 * np.pi * 0.1 * 1) * -0.2
    np.testing.assert_allclose(trajectory.pose(t), expected, atol=1e-15)


@pytest.mark.parametrize("seed", range(3))
def test_rates_and_accelerations_integrate_to_the_pose(seed):
    trajectory = random_one(seed)
    t = np.linspace(0, 10, 4001)
    rate = cumulative_simpson(trajectory.pose_acceleration(t), x=t, axis=0, initial=0.0)
    pose = HOME + cumulative_simpson(trajectory.pose_rate(t), x=t, axis=0, initial=0.0)
    np.testing.assert_allclose(trajectory.pose_rate(t), rate, atol=1e-9)
    np.testing.assert_allclose(trajectory.pose(t), pose, atol=1e-9)


@given(seed=st.integers(0, 2**32 - 1), harmonics=st.integers(2, 8), fundamental_hz=st.floats(0.02, 2.0))
def test_start_is_at_home_at_rest_and_without_acceleration(seed, harmonics, fundamental_hz):
    trajectory = random_one(seed, harmonics, fundamental_hz)
    fastest = 2 * np.pi * fundamental_hz * harmonics
    np.testing.assert_allclose(trajectory.pose(0.0), HOME, atol=1e-12)
    np.testing.assert_allclose(trajectory.pose_rate(0.0), 0, atol=1e-12 * fastest)
    np.testing.assert_allclose(trajectory.pose_acceleration(0.0), 0, atol=1e-12 * fastest**2)


@given(seed=st.integers(0, 2**32 - 1))
def test_amplitude_fills_the_box(seed):
    t = np.linspace(0, 10, 20001)
    largest = np.abs(random_one(seed).pose(t) - HOME).max(axis=0)
    np.testing.assert_allclose(largest, [0.01] * 3 + [0.04] * 3, rtol=1e-3)


def test_a_trajectory_has_its_fundamentals_period_and_its_seeds_frozen_coefficients():
    trajectory, t = random_one(4), np.linspace(0, 10, 50)
    np.testing.assert_allclose(trajectory.pose(t + 10), trajectory.pose(t), atol=1e-12)
    np.testing.assert_array_equal(random_one(4).sine, trajectory.sine)
    assert not np.allclose(random_one(5).sine, trajectory.sine)
    assert (trajectory.pose(0.3).shape, trajectory.pose_acceleration(np.zeros(7)).shape) == ((6,), (7, 6))
    with pytest.raises(ValueError, match="read-only"):
        trajectory.sine[0, 0] = 1.0


def test_wrong_shapes_and_too_few_harmonics_are_refused():
    with pytest.raises(TrajectoryError, match=r"\(5, 2\)"):
        FourierTrajectory(0.1, np.zeros((5, 2)), np.zeros((6, 2)), HOME)
    with pytest.raises(TrajectoryError, match="finite"):
        FourierTrajectory(0.1, np.full((6, 2), np.nan), np.zeros((6, 2)), HOME)
    with pytest.raises(TrajectoryError, match="at least 2 harmonics"):
        random_one(0, harmonics=1)


def test_travel_is_the_largest_angle_and_refused_with_time_leg_angle_and_limit_or_what_is_out_of_reach():
    """One harmonic of 1 Hz that is at t = 0.25 s where the second crank alone is turned by 0.3 rad; and 1 m in x."""
    robot, times = rss6(), np.arange(5) / 16
    turned = robot.forward_kinematics(np.array([0.0, 0.3, 0.0, 0.0, 0.0, 0.0])) - HOME
    one_crank, far = (
        FourierTrajectory(1.0, 2 * np.pi * np.reshape(way, (6, 1)), np.zeros((6, 1)), HOME)
        for way in (turned, [1.0, 0, 0, 0, 0, 0])
    )
    assert check_travel(robot, one_crank, times) == pytest.approx(0.3, abs=1e-9)
    with pytest.raises(TrajectoryError, match=r"theta\| in rad of leg 2 of rss6 is 0\.3 at t = 0\.25 s, limit 0\.2948"):
        check_travel(robot, one_crank, times, margin_rad=0.7)
    with pytest.raises(TrajectoryError, match=r"reach margin of leg \d of rss6 is -.* must be > 0"):
        check_travel(robot, far, times)
