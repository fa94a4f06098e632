"""Searches for exciting trajectories: what they find is admissible, repeatable, and better than chance."""

import json
import os
import signal
import threading
from functools import cache

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from dynamics import load_robot
from identify.errors import TrajectoryError
from identify.excitation import design_trajectories
from identify.excitation.comparison import compare_methods
from identify.excitation.constraints import MotionConstraints
from identify.excitation.design import prepare_search
from identify.excitation.gradient_search import climb
from identify.excitation.motion import sample_times
from identify.progress import SilentProgress
from identify.scenario import load_scenario
from identify.trajectory import random_trajectory
from tests.identify.commands import command

SMALL = load_scenario("quick").with_overrides(
    {"excitation.harmonics": 3, "excitation.candidates": 6, "excitation.generations": 8, "validation.count": 1}
)
ALL = bool(os.environ.get("ALL_SEARCHES"))
SEEDED = ["evolutionary"] + ([pytest.param("gradient", marks=pytest.mark.slow)] if ALL else [])
CONTESTS = [("observability", 324)] + ([("information", 150)] if ALL else [])


@pytest.fixture(scope="module")
def robot():
    return load_robot("rss6")


@pytest.fixture(autouse=True)
def one_start(request, monkeypatch):
    """Fast tests climb from one start only."""
    if not request.node.get_closest_marker("slow"):
        monkeypatch.setattr("identify.excitation.design.STARTS", 1)


@cache
def designed(robot, method, seed=0, **overrides):
    """Scenario and what was designed with it."""
    settings = {f"excitation.{key}": value for key, value in ({"method": method} | overrides).items()}
    scenario = SMALL.with_overrides(settings)
    return scenario, design_trajectories(robot, scenario, seed)


@pytest.mark.parametrize("method", ["evolutionary", "gradient"])
def test_limits_hold_between_the_instants_of_the_search(robot, method):
    """Ten times as many instants; a velocity limit that random trajectories keep and an optimum runs into."""
    scenario, found = designed(robot, method, max_joint_velocity_rad_s=0.45)
    worst = {w.name: w for w in MotionConstraints(robot, scenario).check(found.excitation, sample_times(0.1, 3, 10))}
    if method == "gradient":
        assert worst["velocity"].share > 0.99


@pytest.mark.parametrize("method", ["evolutionary", "gradient"])
def test_found_trajectory_starts_and_ends_at_home_and_at_rest(robot, method):
    _, found = designed(robot, method)
    for t in (0.0, 10.0):
        np.testing.assert_allclose(found.excitation.pose(t), robot.home_pose, atol=1e-12)
        np.testing.assert_allclose(found.excitation.pose_rate(t), 0, atol=1e-12)
        np.testing.assert_allclose(found.excitation.pose_acceleration(t), 0, atol=1e-11)


def test_searches_beat_the_random_trajectories_they_begin_with(robot):
    _, evolved = designed(robot, "evolutionary")
    _, climbed = designed(robot, "gradient")
    _, drawn = designed(robot, "random")
    assert evolved.first_index == climbed.first_index == pytest.approx(drawn.first_index, rel=1e-8)
    assert evolved.observability_index >= drawn.observability_index * (1 - 1e-8)
    assert climbed.observability_index > 1.5 * drawn.observability_index
    np.testing.assert_array_equal(climbed.validation[0].sine, drawn.validation[0].sine)


@pytest.mark.parametrize("method", SEEDED)
def test_seed_decides_what_is_found(robot, method):
    (_, a), (_, b), (_, c) = (designed.__wrapped__(robot, method, seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(a.excitation.sine, b.excitation.sine)
    assert not np.allclose(a.excitation.sine, c.excitation.sine)


@pytest.mark.slow
def test_search_by_information_finds_more_of_it(robot):
    comparison = compare_methods(
        robot, SMALL.with_overrides({"excitation.criterion": "information"}), 0, SilentProgress()
    )
    random, _, gradient = comparison.entries
    assert gradient.value > random.value
    assert gradient.information > random.information


def test_too_few_members_are_refused(robot):
    with pytest.raises(TrajectoryError, match=r"excitation\.candidates = 3: the evolutionary method needs at least 5"):
        designed(robot, "evolutionary", candidates=3)


def test_command_compares_and_leaves_its_files(tmp_path, capsys):
    out = tmp_path / "compared"
    settings = ["excitation.harmonics=2", "excitation.candidates=5", "excitation.generations=2"]
    arguments = [part for text in settings for part in ("--set", text)]
    assert command("excite", "quick", "--compare", "--out", out, *arguments) == 0
    assert sorted(path.name for path in out.iterdir()) == ["comparison.json", "comparison.png"]
    compared = json.loads((out / "comparison.json").read_text())
    assert [entry["method"] for entry in compared["entries"]] == ["random", "evolutionary", "gradient"]
    assert all(entry["worst"][0]["name"] == "box" for entry in compared["entries"])
    shown = capsys.readouterr().out
    assert "0.38 at the start, 1.345" in " ".join(shown.split())
    assert "gradient: share of each limit used: box" in shown


def test_interrupted_comparison_leaves_no_file(tmp_path, monkeypatch):
    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr("identify.excitation.comparison.compare_methods", interrupted)
    out = tmp_path / "compared"
    assert command("excite", "quick", "--compare", "--quiet", "--out", out) == 130
    assert not out.exists() or not list(out.iterdir())


@pytest.mark.slow
def test_threads_of_linear_algebra_do_not_change_what_is_found(robot):
    """IPOPT's own rounds otherwise with two threads, by enough to end elsewhere."""
    scenario = load_scenario("paper")
    candidate = random_trajectory(np.random.default_rng(0), robot.home_pose, 0.1, 5, 0.01, 0.04)
    search = prepare_search(robot, scenario, [candidate])
    climb(search.problem, search.candidates)  # IPOPT's library is loaded by its first use
    found = []
    for threads in (1, 2):
        with threadpool_limits(limits=threads, user_api="blas"):
            assert {pool["num_threads"] for pool in threadpool_info() if "casadi" in pool["filepath"]} == {threads}
            found.append(climb(search.problem, search.candidates)[0].z)
    np.testing.assert_array_equal(*found)


@pytest.mark.parametrize("seconds", [0.3, 0.7, 1.0])
def test_interrupt_stops_the_search(robot, seconds):
    """Ctrl-C while IPOPT runs, which swallows it, or while limits are checked, where CasADi may make a SystemError."""
    scenario = load_scenario("quick").with_overrides({"excitation.method": "gradient", "excitation.candidates": 2})
    rng = np.random.default_rng(0)
    candidates = [random_trajectory(rng, robot.home_pose, 0.1, 5, 0.01, 0.04) for _ in range(2)]
    search = prepare_search(robot, scenario, candidates)
    timer = threading.Timer(seconds, lambda: os.kill(os.getpid(), signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        climb(search.problem, search.candidates * 10)


@pytest.mark.slow
@pytest.mark.parametrize(("criterion", "generations"), CONTESTS)
def test_gradient_method_wins_in_value_and_time(robot, criterion, generations):
    """The paper's settings, and for its own criterion its number of generations, in one run; by information too where
    the environment has ALL_SEARCHES=1 (two minutes)."""
    scenario = load_scenario("paper").with_overrides(
        {"excitation.criterion": criterion, "excitation.generations": generations}
    )
    comparison = compare_methods(robot, scenario, 0, SilentProgress())
    random, evolutionary, gradient = comparison.entries
    assert gradient.value > 1.02 * evolutionary.value > 1.02 * random.value
    assert gradient.seconds < evolutionary.seconds
    times = sample_times(0.1, 5, 10)
    for entry in (evolutionary, gradient):
        MotionConstraints(robot, scenario).check(entry.trajectory, times)
