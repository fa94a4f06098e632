"""The criteria as functions of a trajectory's unknowns, against numpy, finite differences and the simulated loop."""

import casadi as ca
import numpy as np
import pytest

from dynamics.closed_loop import simulate
from dynamics.parameters import VISCOUS
from identify.errors import TrajectoryError
from identify.excitation.criteria import SMOOTHING_RAD_S, log_observability
from identify.excitation.information import (
    harmonics,
    knowledge,
    log_information,
    log_linear_information,
    sensitivity_spectrum,
)
from identify.excitation.motion import unknowns
from identify.loop_parameters import NAMES, index_of, model_settings
from identify.scenario import load_scenario
from identify.trajectory import random_trajectory

SCENARIO = load_scenario("quick")
SMALL = {"excitation.position_amplitude_m": 1e-4, "excitation.orientation_amplitude_rad": 4e-4}


@pytest.fixture(scope="module")
def known(robot):
    return knowledge(robot, SCENARIO)


def drawn(robot, seed, scenario=SCENARIO):
    """Unknowns, and the z of a random trajectory."""
    of = scenario.excitation
    free, size = unknowns(robot.home_pose, of), (of.position_amplitude_m, of.orientation_amplitude_rad)
    rng = np.random.default_rng(seed)
    trajectory = random_trajectory(rng, robot.home_pose, of.fundamental_hz, of.harmonics, *size)
    return free, free.of(trajectory), trajectory


def simulated(robot, parameters, trajectory, scenario):
    """Run of the whole scenario's duration, with sensitivities."""
    reference = trajectory.reference(scenario.timing.frame_times(scenario.excitation.duration_s))
    return simulate(robot, parameters, reference, model_settings(scenario), sensitivities=True)


@pytest.mark.parametrize("harmonics_", [2, 5])
def test_unknowns_and_trajectories_are_the_same_thing_and_any_start_and_end_at_home_and_at_rest(robot, harmonics_):
    free, z, trajectory = drawn(robot, 1, SCENARIO.with_overrides({"excitation.harmonics": harmonics_}))
    assert z.shape == (12 * (harmonics_ - 1),)
    t = np.linspace(0, 10, 50)
    np.testing.assert_allclose(free.trajectory(z).pose(t), trajectory.pose(t), atol=1e-15)
    for basis, derivative in zip(free.basis(t), ("pose", "pose_rate", "pose_acceleration"), strict=True):
        moved = (z.reshape(6, -1) @ basis.T).T * free.box + (robot.home_pose if derivative == "pose" else 0)
        np.testing.assert_allclose(moved, getattr(trajectory, derivative)(t), atol=1e-14)
    trajectory = free.trajectory(np.random.default_rng(3).standard_normal(z.size))
    for t in (0.0, 10.0, 20.0):
        np.testing.assert_allclose(trajectory.pose(t), robot.home_pose, atol=1e-14)
        np.testing.assert_allclose(trajectory.pose_rate(t), 0, atol=1e-14)
        np.testing.assert_allclose(trajectory.pose_acceleration(t), 0, atol=1e-13)


@pytest.mark.parametrize("duration_s", [20.0, 13.0, 4.0])
def test_index_is_the_geometric_mean_of_the_singular_values_that_are_not_zero(robot, duration_s):
    """Equation 39 by a singular value decomposition of all 64 columns of the robot's own regressor, over what is
    played; of whole periods one is sampled, which is the same. No judgement hangs on what counts as zero: between the
    two kinds lie more than six decades. Nor does it depend on the trajectory that sets the scale."""
    free, z, trajectory = drawn(robot, 4)
    t = np.arange(0.05, duration_s, 0.1)
    pose, rate, acceleration = trajectory.pose(t), trajectory.pose_rate(t), trajectory.pose_acceleration(t)
    stacked = robot.regressor(pose, robot.twist(pose, rate), robot.twist_dot(pose, rate, acceleration))
    singular = np.linalg.svd(stacked.reshape(-1, 64), compute_uv=False)
    seen = singular[singular > 1e-9 * singular[0]]
    assert len(seen) == 37
    assert singular[36] / singular[37] > 1e6
    expected = np.exp(np.mean(np.log(seen))) / np.sqrt(len(t))
    found, scaled = (float(log_observability(robot, free, duration_s, of)(z)) for of in (z, drawn(robot, 6)[1]))
    assert np.exp(found) == pytest.approx(expected, rel=1e-7)
    assert scaled == pytest.approx(found, abs=1e-8)


@pytest.mark.parametrize("criterion", ["observability", "information"])
def test_gradients_are_those_of_finite_differences(robot, known, criterion):
    free, z, _ = drawn(robot, 7)
    if criterion == "observability":
        value = log_observability(robot, free, 10.0, z, SMOOTHING_RAD_S)
    else:
        value = log_linear_information(robot, free, SCENARIO, known, SMOOTHING_RAD_S)
    unknown = ca.MX.sym("z", z.size)
    gradient = np.array(ca.Function("gradient", [unknown], [ca.gradient(value(unknown), unknown)])(z)).ravel()
    rng, step = np.random.default_rng(0), 1e-5
    for direction in rng.standard_normal((3, z.size)):
        quotient = (float(value(z + step * direction)) - float(value(z - step * direction))) / (2 * step)
        assert gradient @ direction == pytest.approx(quotient, rel=1e-5, abs=1e-7)


def test_linear_loop_has_the_sensitivities_of_the_simulated_one(robot):
    """Small motion, no dry friction, 600 frames a second: the second period against the spectrum."""
    scenario = SCENARIO.with_overrides({**SMALL, "timing.frame_rate_hz": 600.0, "excitation.duration_s": 20.0})
    free, z, trajectory = drawn(robot, 8, scenario)
    parameters = robot.parameter_sets["initial"].vector.copy()
    parameters[VISCOUS] = 0.5  # without friction the loop rings longer than a period
    run = simulated(robot, parameters, trajectory, scenario)
    s, t = harmonics(free), run.time[6000:]
    unknown = ca.MX.sym("z", z.size)
    spectrum = sensitivity_spectrum(robot, free, scenario, parameters, unknown)
    parts = np.array(ca.Function("spectrum", [unknown], [spectrum])(z)).reshape(67, len(s), 2, 6)
    waves = np.exp(np.outer(s, t))
    expected = np.einsum("pkj,kt->tjp", parts[:, :, 0] + 1j * parts[:, :, 1], waves).real
    dynamic = ("platform.mass", "platform.Ixx", "crank1.Izz", "link2.mass", "joint3.viscous")
    for name in (*dynamic, "joint_pid.lp", "joint_pid.li", "joint_pid.ld"):
        column = index_of(name)
        seen = run.pose_sensitivity[6000:, :, column]
        seen, linear = seen - seen.mean(axis=0), expected[:, :, column]
        assert np.linalg.norm(seen - linear) < 0.02 * np.linalg.norm(seen), name


@pytest.mark.parametrize("prior", [{}, {"link4.mass": (1.2, 0.01)}], ids=["guess alone", "a link weighed"])
def test_information_is_the_determinant_of_rows_and_prior(robot, known, prior):
    """By the singular values of whitened sensitivities over prior rows, with another whitening."""
    _, _, trajectory = drawn(robot, 9)
    values, std = robot.parameter_sets["initial"].vector.copy(), known.guess.std.copy()
    for name, (value, deviation) in prior.items():
        values[NAMES.index(name)], std[NAMES.index(name)] = value, deviation
    run = simulated(robot, values, trajectory, SCENARIO)
    eigenvalues, vectors = np.linalg.eigh(known.covariance)
    rows = (np.diag(eigenvalues**-0.5) @ vectors.T @ run.pose_sensitivity).reshape(-1, 67) * std
    anchor = np.zeros((1, 67))
    anchor[0, NAMES.index("platform.mass")] = std[NAMES.index("platform.mass")] / 0.005
    singular = np.linalg.svd(np.vstack([rows, np.eye(67), anchor]), compute_uv=False)
    expected = np.mean(np.log(singular))
    entries = {name: {"value": value, "std": deviation} for name, (value, deviation) in prior.items()}
    scenario = SCENARIO.with_overrides({"identification.prior": entries})
    found = log_information(robot, scenario, knowledge(robot, scenario), trajectory)
    assert found == pytest.approx(expected, rel=1e-6)


def test_longer_runs_inform_more_and_an_unstable_starting_model_is_named(robot, known):
    _, _, trajectory = drawn(robot, 10)
    longer = SCENARIO.with_overrides({"excitation.duration_s": 20.0})
    once, twice = (log_information(robot, s, known, trajectory) for s in (SCENARIO, longer))
    assert 0.0 < twice - once < np.log(2) / 2 + 0.05
    late = SCENARIO.with_overrides({"timing.frame_rate_hz": 30.0, "timing.latency_s": 0.05})
    with pytest.raises(TrajectoryError, match=r"no D-criterion: .*model\.start_parameters = 'initial' is unstable"):
        log_information(robot, late, known, trajectory)
