import numpy as np
import pytest

from dynamics import load_robot
from identify.errors import TrajectoryError
from identify.excitation import design_trajectories
from identify.excitation.design import unseen_trajectories
from identify.excitation.random_search import (
    NULL_TOLERANCE,
    observability_indices,
    stacked_regressor,
)
from identify.files.trajectory_file import load_trajectories, save_trajectories
from identify.scenario import load_scenario
from identify.trajectory import check_travel, random_trajectory

QUICK = load_scenario("quick").with_overrides({"excitation.travel_margin_rad": 0.0})


def test_index_is_the_papers_on_the_excited_directions(diagonal_robot):
    """A diagonal regressor whose first column stands twice: singular values sqrt(2) |a_1|, |a_2|, ..., |a_6|."""
    rng = np.random.default_rng(1)
    trajectories = [random_trajectory(rng, diagonal_robot.home_pose, 0.1, 5, 0.01, 0.04) for _ in range(3)]
    t = np.arange(100) / 10.0
    for trajectory, index in zip(trajectories, observability_indices(diagonal_robot, trajectories, 10.0), strict=True):
        norms = np.linalg.norm(trajectory.pose_acceleration(t), axis=0)
        norms[0] *= np.sqrt(2)
        assert index == pytest.approx(np.prod(norms) ** (1 / 6) / np.sqrt(100), rel=1e-9)


def test_best_candidate_is_chosen(diagonal_robot):
    chosen = design_trajectories(diagonal_robot, QUICK, seed=3)
    assert chosen.observability_index >= chosen.median_index
    assert chosen.observability_index >= chosen.first_index
    alone = design_trajectories(diagonal_robot, QUICK.with_overrides({"excitation.candidates": 1}), seed=3)
    assert alone.observability_index == pytest.approx(chosen.first_index)
    assert chosen.observability_index > alone.observability_index


def test_seed_decides_everything_and_unseen_trajectories_are_others(diagonal_robot):
    a, b = (design_trajectories(diagonal_robot, QUICK, seed=3) for _ in range(2))
    c = design_trajectories(diagonal_robot, QUICK, seed=4)
    np.testing.assert_array_equal(a.excitation.sine, b.excitation.sine)
    np.testing.assert_array_equal(a.validation[1].sine, b.validation[1].sine)
    assert not np.allclose(a.excitation.sine, c.excitation.sine)
    assert len(a.validation) == 2
    assert not any(np.allclose(a.excitation.sine, v.sine) for v in a.validation)


def test_unseen_trajectories_do_not_depend_on_the_number_of_candidates(diagonal_robot):
    few = design_trajectories(diagonal_robot, QUICK.with_overrides({"excitation.candidates": 2}), seed=3)
    many = design_trajectories(diagonal_robot, QUICK, seed=3)
    np.testing.assert_array_equal(few.validation[0].sine, many.validation[0].sine)


def test_unseen_trajectories_are_had_without_the_search(diagonal_robot):
    whole, alone = design_trajectories(diagonal_robot, QUICK, 4), unseen_trajectories(diagonal_robot, QUICK, 4)
    assert len(alone) == 2
    for one, other in zip(whole.validation, alone, strict=True):
        np.testing.assert_array_equal(one.sine, other.sine)
        np.testing.assert_array_equal(one.cosine, other.cosine)


def test_amplitude_beyond_the_travel_is_refused_with_the_reason(diagonal_robot):
    scenario = QUICK.with_overrides({"excitation.position_amplitude_m": 0.05, "excitation.candidates": 2})
    with pytest.raises(TrajectoryError, match=r"only 0 of 100 .*±0\.05 m.*crank [123] of diagonal to 2\.5"):
        design_trajectories(diagonal_robot, scenario, seed=0)


def test_progress_reaches_its_total(diagonal_robot):
    from contextlib import contextmanager

    seen = {}

    class Counting:
        @contextmanager
        def stage(self, name, total):
            seen[name] = [0, total]

            def advance(n=1):
                seen[name][0] += n

            yield advance

    design_trajectories(diagonal_robot, QUICK, seed=0, progress=Counting())
    assert seen == {"excitation": [16, 16]}


def test_file_reads_back_equal(tmp_path, diagonal_robot):
    chosen = design_trajectories(diagonal_robot, QUICK, seed=3)
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
def test_damaged_file_is_named(tmp_path, diagonal_robot, damage):
    path = tmp_path / "trajectories.json"
    save_trajectories(path, design_trajectories(diagonal_robot, QUICK, seed=3))
    path.write_text(damage(path.read_text()))
    with pytest.raises(TrajectoryError, match=r"trajectories\.json"):
        load_trajectories(path)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(TrajectoryError, match=r"nothing\.json"):
        load_trajectories(tmp_path / "nothing.json")


def test_reference_robot_separates_excited_from_null_directions():
    """No judgement hangs on NULL_TOLERANCE: between the two kinds lie more than six decades."""
    robot = load_robot("rss6")
    design = design_trajectories(robot, QUICK, seed=0)
    singular = np.linalg.svd(stacked_regressor(robot, design.excitation, 10.0), compute_uv=False)
    excited = int((singular > NULL_TOLERANCE * singular[0]).sum())
    assert singular[excited - 1] / singular[excited] > 1e6
    assert 30 <= excited < 64
    assert check_travel(robot, design.excitation, np.arange(600) / 60) < robot.travel_limit
