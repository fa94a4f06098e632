"""Criteria as functions of a trajectory's unknowns, against numpy, finite differences and the
simulated loop; searches: what they find is admissible, repeatable, and better than chance."""

import json
import os
import signal
import threading
from functools import cache

import casadi as ca
import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from cmmsim.visibility import expected_covariance
from dynamics.closed_loop import (
    differentiate_servo,
)
from identify.errors import TrajectoryError
from identify.excitation.comparison import compare_methods
from identify.excitation.criteria import SMOOTHING_RAD_S, log_observability
from identify.excitation.design import design_trajectories
from identify.excitation.information import (
    harmonics,
    knowledge,
    log_information,
    log_linear_information,
    sensitivity_spectrum,
)
from identify.excitation.search import climb
from identify.excitation.trajectory_unknowns import sample_times, unknowns
from identify.progress import SilentProgress
from identify.scenario import load_scenario
from identify.trajectory import random_trajectory
from tests.identify.commands import command
from tests.identify.synthetic import NAMES, design_of, index_of, rss6, side_of

QUICK = load_scenario("quick")
SMALL = QUICK.with_overrides(
    {
        "excitation.harmonics": 3,
        "excitation.candidates": 6,
        "excitation.generations": 8,
        "validation.count": 1,
    }
)


TINY = {"excitation.position_amplitude_m": 1e-4, "excitation.orientation_amplitude_rad": 4e-4}


def known_of(scenario):
    """What is known before the run of a scenario."""
    times = scenario.timing.frame_times(scenario.excitation.duration_s)
    covariance = expected_covariance(
        scenario.sensor, rss6().home_pose, scenario.pose_method, changes=scenario.sensor_changes
    )
    return knowledge(side_of(scenario), scenario.identification, times, covariance)


@pytest.fixture(scope="module")
def known(robot):
    return known_of(QUICK)


def a_motion(robot, seed, scenario=QUICK):
    """Unknowns, and the z of a random trajectory."""
    of = scenario.excitation
    free, size = (
        unknowns(robot.geometry.chart, of),
        (of.position_amplitude_m, of.orientation_amplitude_rad),
    )
    rng = np.random.default_rng(seed)
    trajectory = random_trajectory(
        rng, robot.geometry.chart, of.fundamental_hz, of.harmonics, *size
    )
    return free, free.of(trajectory), trajectory


def simulated(robot, parameters, trajectory, scenario):
    """Run of the whole scenario's duration, with sensitivities."""
    reference = trajectory.reference(scenario.timing.frame_times(scenario.excitation.duration_s))
    return differentiate_servo(robot, parameters, reference, side_of(scenario).settings)


@pytest.mark.parametrize("harmonics_", [2, 5])
def test_unknowns_and_trajectories_are_the_same_thing_and_any_start_and_end_at_home_and_at_rest(
    robot, harmonics_
):
    free, z, trajectory = a_motion(
        robot, 1, QUICK.with_overrides({"excitation.harmonics": harmonics_})
    )
    assert z.shape == (12 * (harmonics_ - 1),)
    t = np.linspace(0, 10, 50)
    np.testing.assert_allclose(free.trajectory(z).pose(t), trajectory.pose(t), atol=1e-15)
    for basis, derivative in zip(
        free.basis(t), ("pose", "pose_rate", "pose_acceleration"), strict=True
    ):
        moved = (z.reshape(6, -1) @ basis.T).T * free.box + (
            robot.home_pose if derivative == "pose" else 0
        )
        np.testing.assert_allclose(moved, getattr(trajectory, derivative)(t), atol=1e-14)
    trajectory = free.trajectory(np.random.default_rng(3).standard_normal(z.size))
    for t in (0.0, 10.0, 20.0):
        np.testing.assert_allclose(trajectory.pose(t), robot.home_pose, atol=1e-14)
        np.testing.assert_allclose(trajectory.pose_rate(t), 0, atol=1e-14)
        np.testing.assert_allclose(trajectory.pose_acceleration(t), 0, atol=1e-13)


@pytest.mark.parametrize("duration_s", [20.0, 13.0, 4.0])
def test_index_is_the_geometric_mean_of_the_singular_values_that_are_not_zero(robot, duration_s):
    """Equation 39 by a singular value decomposition of all 64 columns of the robot's own regressor,
    over what is played; of whole periods one is sampled, which is the same. No judgement hangs on
    what counts as zero: between the two kinds lie more than six decades. Nor does it depend on the
    trajectory that sets the scale."""
    free, z, trajectory = a_motion(robot, 4)
    t = np.arange(0.05, duration_s, 0.1)
    pose, rate, acceleration = (
        trajectory.pose(t),
        trajectory.pose_rate(t),
        trajectory.pose_acceleration(t),
    )
    stacked = robot.regressor(
        pose, robot.twist(pose, rate), robot.twist_dot(pose, rate, acceleration)
    )
    singular = np.linalg.svd(stacked.reshape(-1, 64), compute_uv=False)
    seen = singular[singular > 1e-9 * singular[0]]
    assert len(seen) == 37
    assert singular[36] / singular[37] > 1e6
    expected = np.exp(np.mean(np.log(seen))) / np.sqrt(len(t))
    found, scaled = (
        float(log_observability(robot, free, duration_s, of)(z))
        for of in (z, a_motion(robot, 6)[1])
    )
    assert np.exp(found) == pytest.approx(expected, rel=1e-7)
    assert scaled == pytest.approx(found, abs=1e-8)


@pytest.mark.parametrize("criterion", ["observability", "information"])
def test_gradients_are_those_of_finite_differences(robot, known, criterion):
    free, z, _ = a_motion(robot, 7)
    if criterion == "observability":
        value = log_observability(robot, free, 10.0, z, SMOOTHING_RAD_S)
    else:
        value = log_linear_information(robot, free, known, SMOOTHING_RAD_S)
    unknown = ca.MX.sym("z", z.size)
    gradient = np.array(
        ca.Function("gradient", [unknown], [ca.gradient(value(unknown), unknown)])(z)
    ).ravel()
    rng, step = np.random.default_rng(0), 1e-5
    for direction in rng.standard_normal((3, z.size)):
        quotient = (float(value(z + step * direction)) - float(value(z - step * direction))) / (
            2 * step
        )
        assert gradient @ direction == pytest.approx(quotient, rel=1e-5, abs=1e-7)


@pytest.mark.slow
def test_linear_loop_has_the_sensitivities_of_the_simulated_one(robot):
    """Small motion, no dry friction, 600 frames a second: the second period against the
    spectrum."""
    scenario = QUICK.with_overrides(
        {**TINY, "timing.frame_rate_hz": 600.0, "excitation.duration_s": 20.0}
    )
    free, z, trajectory = a_motion(robot, 8, scenario)
    parameters = robot.parameter_sets["guess"].vector.copy()
    parameters[robot.layout.viscous] = 0.5  # without friction the loop rings longer than a period
    run = simulated(robot, parameters, trajectory, scenario)
    s, t = harmonics(free), run.time[6000:]
    unknown = ca.MX.sym("z", z.size)
    settings = side_of(scenario, robot).settings
    spectrum = sensitivity_spectrum(robot, free, settings, parameters, unknown)
    parts = np.array(ca.Function("spectrum", [unknown], [spectrum])(z)).reshape(67, len(s), 2, 6)
    waves = np.exp(np.outer(s, t))
    expected = np.einsum("pkj,kt->tjp", parts[:, :, 0] + 1j * parts[:, :, 1], waves).real
    dynamic = ("platform.mass", "platform.Ixx", "crank1.Izz", "link2.mass", "joint3.viscous")
    for name in (*dynamic, "joint_pid.lp", "joint_pid.li", "joint_pid.ld"):
        column = index_of(name)
        seen = run.pose_sensitivity[6000:, :, column]
        seen, linear = seen - seen.mean(axis=0), expected[:, :, column]
        assert np.linalg.norm(seen - linear) < 0.02 * np.linalg.norm(seen), name


@pytest.mark.parametrize(
    "prior", [{}, {"link4.mass": (1.2, 0.01)}], ids=["guess alone", "a link weighed"]
)
def test_information_is_the_determinant_of_rows_and_prior(robot, known, prior):
    """By the singular values of whitened sensitivities over prior rows, with another whitening."""
    _, _, trajectory = a_motion(robot, 9)
    values, std = robot.parameter_sets["guess"].vector.copy(), known.guess.std.copy()
    for name, (value, deviation) in prior.items():
        values[NAMES.index(name)], std[NAMES.index(name)] = value, deviation
    run = simulated(robot, values, trajectory, QUICK)
    eigenvalues, vectors = np.linalg.eigh(known.covariance)
    rows = (np.diag(eigenvalues**-0.5) @ vectors.T @ run.pose_sensitivity).reshape(-1, 67) * std
    anchor = np.zeros((1, 67))
    anchor[0, NAMES.index("platform.mass")] = std[NAMES.index("platform.mass")] / 0.005
    singular = np.linalg.svd(np.vstack([rows, np.eye(67), anchor]), compute_uv=False)
    expected = np.mean(np.log(singular))
    entries = {
        name: {"value": value, "std": deviation} for name, (value, deviation) in prior.items()
    }
    scenario = QUICK.with_overrides({"identification.prior": entries})
    found = log_information(robot, known_of(scenario), trajectory)
    assert found == pytest.approx(expected, rel=1e-6)


def test_longer_runs_inform_more_and_an_unstable_starting_model_is_named(robot, known):
    _, _, trajectory = a_motion(robot, 10)
    longer = QUICK.with_overrides({"excitation.duration_s": 20.0})
    once, twice = (log_information(robot, known_of(s), trajectory) for s in (QUICK, longer))
    assert 0.0 < twice - once < np.log(2) / 2 + 0.05
    late = QUICK.with_overrides({"timing.frame_rate_hz": 30.0, "timing.latency_s": 0.05})
    with pytest.raises(
        TrajectoryError, match=r"no D-criterion: .*model\.start_parameters = 'guess' is unstable"
    ):
        log_information(robot, known_of(late), trajectory)


@pytest.fixture
def one_start(monkeypatch):
    monkeypatch.setattr("identify.excitation.search.STARTS", 1)


def small(**overrides):
    return SMALL.with_overrides({f"excitation.{key}": value for key, value in overrides.items()})


@cache
def designed(method, seed=0, **overrides):
    return design_trajectories(design_of(small(method=method, **overrides)), seed)


def drawn(count):
    """Random trajectories in the box of the built-in scenarios."""
    rng = np.random.default_rng(0)
    return [random_trajectory(rng, rss6().geometry.chart, 0.1, 5, 0.01, 0.04) for _ in range(count)]


def climbed(problem):
    return climb(problem, np.random.SeedSequence(0), SilentProgress())


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", ["evolutionary", pytest.param("gradient", marks=pytest.mark.slow)]
)
def test_limits_hold_between_the_instants_of_the_search(one_start, method):
    """Ten times as many instants; a velocity limit that random trajectories keep and an optimum
    runs into.
    """
    scenario = small(method=method, max_joint_velocity_rad_s=0.45)
    design = design_of(scenario)
    found = design_trajectories(design, 0).excitation
    worst = {w.name: w for w in design.limits.check(found, sample_times(0.1, 3, 10))}
    if method == "gradient":
        assert worst["velocity"].share > 0.99


@pytest.mark.thorough
def test_searches_beat_the_random_trajectories_they_begin_with(one_start):
    random, evolved, climbed = (
        designed(method) for method in ("random", "evolutionary", "gradient")
    )
    assert evolved.first_index == climbed.first_index == pytest.approx(random.first_index, rel=1e-8)
    assert evolved.observability_index >= random.observability_index * (1 - 1e-8)
    assert climbed.observability_index > 1.5 * random.observability_index
    np.testing.assert_array_equal(climbed.validation[0].sine, random.validation[0].sine)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "method", ["evolutionary", pytest.param("gradient", marks=pytest.mark.thorough)]
)
def test_seed_decides_what_is_found(method):
    a, b, c = (designed.__wrapped__(method, seed, generations=3) for seed in (0, 0, 1))
    np.testing.assert_array_equal(a.excitation.sine, b.excitation.sine)
    assert not np.allclose(a.excitation.sine, c.excitation.sine)
    with pytest.raises(
        TrajectoryError,
        match=r"excitation\.candidates = 3: the evolutionary method needs at least 5",
    ):
        design_trajectories(design_of(small(method="evolutionary", candidates=3)), 0)


@pytest.mark.thorough
def test_command_compares_and_leaves_its_files_and_none_where_it_is_interrupted(
    one_start, tmp_path, capsys, monkeypatch
):
    out = tmp_path / "compared"
    settings = ["criterion=information", "harmonics=2", "candidates=5", "generations=2"]
    arguments = [part for text in settings for part in ("--set", f"excitation.{text}")]
    assert command("excite", "quick", "--compare", "--out", out, *arguments) == 0
    assert sorted(path.name for path in out.iterdir()) == ["comparison.json", "comparison.png"]
    compared = json.loads((out / "comparison.json").read_text())
    random, _, gradient = compared["entries"]
    assert [entry["method"] for entry in compared["entries"]] == [
        "random",
        "evolutionary",
        "gradient",
    ]
    assert gradient["value"] > random["value"]
    assert gradient["information"] > random["information"]
    assert all(entry["worst"][0]["name"] == "box" for entry in compared["entries"])
    shown = capsys.readouterr().out
    assert "0.38 at the start, 1.345" in " ".join(shown.split())
    assert "gradient: share of each limit used: box" in shown

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("identify.excitation.comparison.compare_methods", interrupted)
    assert command("excite", "quick", "--compare", "--quiet", "--out", tmp_path / "other") == 130
    assert not list((tmp_path / "other").glob("*"))


@pytest.mark.thorough
def test_threads_of_linear_algebra_do_not_change_what_is_found():
    """IPOPT's own rounds otherwise with two threads, by enough to end elsewhere."""
    problem = design_of(load_scenario("paper")).search_problem(drawn(1))
    climbed(problem)  # IPOPT's library is loaded by its first use
    found = []
    for threads in (1, 2):
        with threadpool_limits(limits=threads, user_api="blas"):
            assert {
                pool["num_threads"] for pool in threadpool_info() if "casadi" in pool["filepath"]
            } == {threads}
            found.append(climbed(problem).z)
    np.testing.assert_array_equal(*found)


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [0.3, 1.0])
def test_interrupt_stops_the_search(seconds, monkeypatch):
    """Ctrl-C while IPOPT runs, which swallows it, or while limits are checked, where CasADi may
    make a SystemError.
    """
    monkeypatch.setattr("identify.excitation.search.STARTS", 20)
    scenario = QUICK.with_overrides({"excitation.method": "gradient"})
    problem = design_of(scenario).search_problem(drawn(2) * 10)
    timer = threading.Timer(seconds, lambda: os.kill(os.getpid(), signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        climbed(problem)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("criterion", "generations"), [("observability", 324), ("information", 150)]
)
def test_gradient_method_wins_in_value(criterion, generations):
    """The paper's settings, and for its own criterion its number of generations, in one run."""
    overrides = {"excitation.criterion": criterion, "excitation.generations": generations}
    scenario = load_scenario("paper").with_overrides(overrides)
    design = design_of(scenario)
    known = known_of(scenario)
    random, evolutionary, gradient = compare_methods(design, known, 0, SilentProgress()).entries
    assert gradient.value > 1.02 * evolutionary.value > 1.02 * random.value
    for entry in (evolutionary, gradient):
        design.limits.check(entry.trajectory, sample_times(0.1, 5, 10))
