"""Base parameters against the inverse dynamics, singular values and what mechanics says."""

import json
from dataclasses import replace

import numpy as np
import pytest

from dynamics import load_robot
from dynamics.parameters import PARAMETER_NAMES
from identify.errors import EstimationError
from identify.estimation.base_parameters import (
    angle_to_singular_vectors,
    base_parameters,
    rank_by_singular_values,
    rank_by_threshold,
    structural_regressor,
)
from tests.identify.commands import command
from tests.identify.synthetic import changed_robot_file, rss6


@pytest.fixture(scope="module")
def found():
    return base_parameters(structural_regressor(rss6()))


def test_the_base_parameters_alone_decide_the_torque(found):
    """Parameters with equal base parameters have equal torques; a moved base parameter moves them."""
    robot, rng = rss6(), np.random.default_rng(3)
    pose = robot.home_pose + rng.uniform(-1, 1, (20, 6)) * np.repeat([0.008, 0.03], 3)
    motion = pose, rng.normal(size=(20, 6)) * np.repeat([0.1, 0.5], 3), rng.normal(size=(20, 6))
    nominal = robot.parameter_sets["identified"].dynamic
    kernel = np.linalg.svd(found.combinations)[2][found.rank :]
    change = kernel.T @ rng.normal(size=len(kernel))
    torque = robot.inverse_dynamics(*motion, nominal)
    assert np.allclose(found.combinations @ change, 0, atol=1e-12)
    assert np.abs(change).max() > 0.1
    moved = robot.regressor(*motion) @ change
    assert np.abs(moved).max() < 1e-10 * np.abs(torque).max()
    for row in found.combinations:
        assert np.abs(robot.regressor(*motion) @ (row / (row @ row))).max() > 1e-3


def test_rank_and_space_are_those_of_the_singular_values_and_the_papers_threshold_depends_on_the_units(found):
    matrix = structural_regressor(rss6())
    lengths = np.linalg.norm(matrix, axis=0)
    scale = np.where(lengths > 0, lengths, 1.0)
    rows = np.linalg.svd(matrix / scale)[2][: found.rank]
    groups = found.combinations / scale  # both act on parameters times their column's length
    assert rank_by_singular_values(matrix) == found.rank == np.linalg.matrix_rank(groups) == 37
    assert np.abs(groups @ rows.T @ rows - groups).max() < 1e-9 * np.abs(groups).max()
    assert rank_by_threshold(matrix, 1e-3) == 37
    assert rank_by_threshold(matrix / 1e6, 1e-3) < 37
    with pytest.raises(EstimationError, match="excites no parameter"):
        base_parameters(np.zeros((12, 64)))


def test_the_angle_to_the_singular_vectors_is_that_by_which_a_group_is_wrong():
    """Columns of length 3 and 4, and one that no motion shows: a group turned towards it by 0.1 rad."""
    matrix = np.array([[3.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 0.0]])
    right = base_parameters(matrix, ("crank1.Izz", "crank2.Izz", "crank3.Izz"))
    assert angle_to_singular_vectors(matrix, right) < 1e-12
    turned = right.combinations + np.array([[0.0, 0.0, np.tan(0.1) / 3.0], [0.0, 0.0, 0.0]])
    assert angle_to_singular_vectors(matrix, replace(right, combinations=turned)) == pytest.approx(0.1, rel=1e-9)
    one_less = replace(right, combinations=right.combinations[:1])
    assert angle_to_singular_vectors(matrix, one_less) == pytest.approx(np.pi / 2)


@pytest.mark.slow
def test_gravity_across_the_crank_axes_separates_mass_from_inertia(found, tmp_path):
    """On a slope a crank's weight turns it, so its mass is no longer tied to its inertia."""
    level, leaning = "gravity = [0.0, 0.0, -9.81]", "gravity = [4.0, 0.0, -8.9575]"
    matrix = structural_regressor(load_robot(changed_robot_file(tmp_path / "leaning.toml", level, leaning)))
    sloped = base_parameters(matrix)
    assert sloped.rank == rank_by_singular_values(matrix) > found.rank
    row = sloped.combinations[sloped.pivots.index(PARAMETER_NAMES.index("crank2.Izz"))]
    assert row[PARAMETER_NAMES.index("crank2.mass")] == 0.0


def test_groups_do_not_depend_on_the_motions_and_a_crank_turns_about_its_joint(found):
    """A crank about a vertical axis shows its inertia about that axis: Izz + m (r / 2)², r = 60 mm."""
    again = base_parameters(structural_regressor(rss6(), motions=333, seed=11))
    assert again.pivots == found.pivots
    assert np.allclose(again.combinations, found.combinations, atol=1e-9)
    row = found.combinations[found.pivots.index(PARAMETER_NAMES.index("crank2.Izz"))]
    assert row[PARAMETER_NAMES.index("crank2.mass")] == pytest.approx(0.03**2, rel=1e-9)
    assert all(f"crank{k}.Ixx" in found.unseen and f"link{k}.Izz" in found.unseen for k in range(1, 7))


def test_the_command_prints_and_writes_the_groups(tmp_path, capsys):
    file = tmp_path / "groups.json"
    assert command("base-parameters", "rss6", "--out", file) == 0
    shown = capsys.readouterr().out
    assert "crank1.Izz + 0.0009 crank1.mass" in shown
    assert "the same groups from singular vectors: largest angle between what both span" in shown
    written = json.loads(file.read_text())
    assert written["rank"] == written["rank_by_singular_values"] == len(written["groups"]) == 37
    assert written["angle_to_singular_vectors_rad"] < 1e-9
    assert written["groups"][-1]["name"] == "joint6.viscous"
