"""Searches for exciting trajectories: what they find is admissible, repeatable, and better than chance."""

import json
import os
import signal
import threading
from functools import cache

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from identify.errors import TrajectoryError
from identify.excitation.comparison import compare_methods
from identify.excitation.constraints import MotionConstraints
from identify.excitation.design import design_trajectories, search_problem
from identify.excitation.motion import sample_times
from identify.excitation.search import climb
from identify.progress import SilentProgress
from identify.scenario import load_scenario
from identify.trajectory import random_trajectory
from tests.identify.commands import command
from tests.identify.synthetic import rss6

SMALL = load_scenario("quick").with_overrides(
    {"excitation.harmonics": 3, "excitation.candidates": 6, "excitation.generations": 8, "validation.count": 1}
)


@pytest.fixture
def one_start(monkeypatch):
    """Climbing from one start only."""
    monkeypatch.setattr("identify.excitation.search.STARTS", 1)


def small(**overrides):
    return SMALL.with_overrides({f"excitation.{key}": value for key, value in overrides.items()})


@cache
def designed(method, seed=0, **overrides):
    return design_trajectories(rss6(), small(method=method, **overrides), seed)


def drawn(count):
    """Random trajectories in the box of the built-in scenarios."""
    rng = np.random.default_rng(0)
    return [random_trajectory(rng, rss6().home_pose, 0.1, 5, 0.01, 0.04) for _ in range(count)]


def climbed(problem):
    return climb(problem, np.random.SeedSequence(0), SilentProgress())


@pytest.mark.parametrize("method", ["evolutionary", "gradient"])
def test_limits_hold_between_the_instants_of_the_search(one_start, method):
    """Ten times as many instants; a velocity limit that random trajectories keep and an optimum runs into."""
    scenario = small(method=method, max_joint_velocity_rad_s=0.45)
    found = design_trajectories(rss6(), scenario, 0).excitation
    worst = {w.name: w for w in MotionConstraints(rss6(), scenario).check(found, sample_times(0.1, 3, 10))}
    if method == "gradient":
        assert worst["velocity"].share > 0.99


def test_searches_beat_the_random_trajectories_they_begin_with(one_start):
    random, evolved, climbed = (designed(method) for method in ("random", "evolutionary", "gradient"))
    assert evolved.first_index == climbed.first_index == pytest.approx(random.first_index, rel=1e-8)
    assert evolved.observability_index >= random.observability_index * (1 - 1e-8)
    assert climbed.observability_index > 1.5 * random.observability_index
    np.testing.assert_array_equal(climbed.validation[0].sine, random.validation[0].sine)


@pytest.mark.parametrize("method", ["evolutionary", pytest.param("gradient", marks=pytest.mark.thorough)])
def test_seed_decides_what_is_found(method):
    a, b, c = (designed.__wrapped__(method, seed, generations=3) for seed in (0, 0, 1))
    np.testing.assert_array_equal(a.excitation.sine, b.excitation.sine)
    assert not np.allclose(a.excitation.sine, c.excitation.sine)
    with pytest.raises(TrajectoryError, match=r"excitation\.candidates = 3: the evolutionary method needs at least 5"):
        design_trajectories(rss6(), small(method="evolutionary", candidates=3), 0)


@pytest.mark.slow
def test_search_by_information_finds_more_of_it():
    random, _, gradient = compare_methods(rss6(), small(criterion="information"), 0, SilentProgress()).entries
    assert gradient.value > random.value
    assert gradient.information > random.information


def test_command_compares_and_leaves_its_files_and_none_where_it_is_interrupted(
    one_start, tmp_path, capsys, monkeypatch
):
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

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("identify.excitation.comparison.compare_methods", interrupted)
    assert command("excite", "quick", "--compare", "--quiet", "--out", tmp_path / "other") == 130
    assert not list((tmp_path / "other").glob("*"))


@pytest.mark.slow
def test_threads_of_linear_algebra_do_not_change_what_is_found():
    """IPOPT's own rounds otherwise with two threads, by enough to end elsewhere."""
    problem = search_problem(rss6(), load_scenario("paper"), drawn(1))
    climbed(problem)  # IPOPT's library is loaded by its first use
    found = []
    for threads in (1, 2):
        with threadpool_limits(limits=threads, user_api="blas"):
            assert {pool["num_threads"] for pool in threadpool_info() if "casadi" in pool["filepath"]} == {threads}
            found.append(climbed(problem).z)
    np.testing.assert_array_equal(*found)


@pytest.mark.parametrize("seconds", [0.3, 1.0])
def test_interrupt_stops_the_search(seconds, monkeypatch):
    """Ctrl-C while IPOPT runs, which swallows it, or while limits are checked, where CasADi may make a SystemError."""
    monkeypatch.setattr("identify.excitation.search.STARTS", 20)
    scenario = load_scenario("quick").with_overrides({"excitation.method": "gradient"})
    problem = search_problem(rss6(), scenario, drawn(2) * 10)
    timer = threading.Timer(seconds, lambda: os.kill(os.getpid(), signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        climbed(problem)


@pytest.mark.thorough
@pytest.mark.parametrize(("criterion", "generations"), [("observability", 324), ("information", 150)])
def test_gradient_method_wins_in_value(criterion, generations):
    """The paper's settings, and for its own criterion its number of generations, in one run."""
    overrides = {"excitation.criterion": criterion, "excitation.generations": generations}
    scenario = load_scenario("paper").with_overrides(overrides)
    random, evolutionary, gradient = compare_methods(rss6(), scenario, 0, SilentProgress()).entries
    assert gradient.value > 1.02 * evolutionary.value > 1.02 * random.value
    for entry in (evolutionary, gradient):
        MotionConstraints(rss6(), scenario).check(entry.trajectory, sample_times(0.1, 5, 10))
