from functools import cache

import numpy as np
import pytest

from dynamics import load_robot
from identify.errors import TrajectoryError
from identify.excitation import design_trajectories
from identify.excitation.design import unseen_trajectories
from identify.scenario import load_scenario
from identify.trajectory import load_trajectories, save_trajectories

QUICK = load_scenario("quick").with_overrides({"excitation.candidates": 4})


@pytest.fixture(scope="module")
def robot():
    return load_robot("rss6")


@cache
def designed(robot, seed=3, **overrides):
    """What is designed for `quick` with four candidates; a smaller number draws the first of them."""
    return design_trajectories(robot, QUICK.with_overrides({f"excitation.{k}": v for k, v in overrides.items()}), seed)


def test_best_candidate_is_chosen(robot):
    chosen, alone = designed(robot), designed(robot, candidates=1)
    assert chosen.observability_index >= chosen.median_index
    assert alone.observability_index == alone.first_index == pytest.approx(chosen.first_index, rel=1e-9)
    assert chosen.observability_index > alone.observability_index


def test_seed_decides_everything_and_unseen_trajectories_are_others(robot):
    a, b, c = designed(robot), designed.__wrapped__(robot), designed(robot, seed=4)
    np.testing.assert_array_equal(a.excitation.sine, b.excitation.sine)
    np.testing.assert_array_equal(a.validation[1].sine, b.validation[1].sine)
    assert not np.allclose(a.excitation.sine, c.excitation.sine)
    assert len(a.validation) == 2
    assert not any(np.allclose(a.excitation.sine, v.sine) for v in a.validation)


def test_unseen_trajectories_do_not_depend_on_the_number_of_candidates(robot):
    few, many = designed(robot, candidates=1), designed(robot)
    np.testing.assert_array_equal(few.validation[0].sine, many.validation[0].sine)


def test_unseen_trajectories_are_had_without_the_search(robot):
    whole, alone = designed(robot), unseen_trajectories(robot, QUICK, 3)
    assert len(alone) == 2
    for one, other in zip(whole.validation, alone, strict=True):
        np.testing.assert_array_equal(one.sine, other.sine)
        np.testing.assert_array_equal(one.cosine, other.cosine)


def test_run_too_short_to_show_every_parameter_has_no_index(robot):
    """Six poses give 36 equations for the 37 base parameters, seven give enough."""
    assert designed(robot, duration_s=0.6).observability_index == 0.0
    assert designed(robot, duration_s=0.7).observability_index > 0.0


def test_amplitude_beyond_the_travel_is_refused_with_the_reason(robot):
    with pytest.raises(TrajectoryError, match=r"only 0 of 100 .*±0\.1 m.*(crank|leg) \d"):
        designed(robot, seed=0, position_amplitude_m=0.1, candidates=2)


def test_progress_reaches_its_total(robot):
    from contextlib import contextmanager

    seen = {}

    class Counting:
        @contextmanager
        def stage(self, name, total):
            seen[name] = [0, total]

            def advance(n=1):
                seen[name][0] += n

            yield advance

    design_trajectories(robot, QUICK, seed=0, progress=Counting())
    assert seen == {"excitation": [4, 4]}


def test_file_reads_back_equal(tmp_path, robot):
    chosen = designed(robot)
    save_trajectories(tmp_path / "trajectories.json", chosen)
    again = load_trajectories(tmp_path / "trajectories.json")
    t = np.linspace(0, 5, 20)
    np.testing.assert_array_equal(again.excitation.pose(t), chosen.excitation.pose(t))
    np.testing.assert_array_equal(again.validation[1].pose(t), chosen.validation[1].pose(t))
    assert (again.seed, again.observability_index) == (3, chosen.observability_index)
    assert [p.name for p in tmp_path.iterdir()] == ["trajectories.json"]


@pytest.mark.parametrize(
    "damage", [lambda s: s[: len(s) // 2], lambda s: s.replace("offset", "offfset"), lambda s: "[]"]
)
def test_damaged_file_is_named(tmp_path, robot, damage):
    path = tmp_path / "trajectories.json"
    save_trajectories(path, designed(robot))
    path.write_text(damage(path.read_text()))
    with pytest.raises(TrajectoryError, match=r"trajectories\.json"):
        load_trajectories(path)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(TrajectoryError, match=r"nothing\.json"):
        load_trajectories(tmp_path / "nothing.json")
