"""The command ``cmmsim workspace``: its numbers against the robot's own inverse kinematics, and its files."""

import json

import numpy as np
import pytest

from dynamics.errors import UnreachablePoseError
from identify.verification import workspace_map
from tests.identify.commands import command


@pytest.fixture(scope="module")
def mapped(robot):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(workspace_map, "JOINT_SAMPLES", 500)
        return workspace_map.map_workspace(robot, points=21)


def test_maps_hold_what_each_pose_alone_gives(robot, mapped):
    """Every grid point of a plane, one inverse kinematics at a time: share of the travel, or NaN out of reach."""
    plane = mapped.planes[1]
    assert (plane.across, plane.up, plane.fixed) == (0, 1, 2)
    for row in range(0, 21, 4):
        for column in range(0, 21, 4):
            pose = np.array([plane.horizontal[column], plane.vertical[row], plane.value, 0, 0, 0])
            try:
                share = np.abs(robot.inverse_kinematics(pose)).max() / robot.travel_limit
            except UnreachablePoseError:
                share = np.nan
                assert plane.reach_margin[row, column] <= 0
            np.testing.assert_allclose(plane.travel_share[row, column], share, atol=1e-12)
    assert np.isnan(plane.travel_share).any()
    assert 0.2 < plane.allowed.mean() < 0.9

    # The reference robot is its own mirror image in the x-z plane: y -> -y at home's height and orientation.
    np.testing.assert_allclose(plane.travel_share, plane.travel_share[::-1], atol=1e-9)


def test_ranges_end_at_the_travel_limit(robot, mapped):
    """At the end of each range the largest angle is the limit, within the step of the search."""
    for axis, ends in enumerate(mapped.ranges):
        for end in ends:
            largest = np.abs(robot.inverse_kinematics(robot.home_pose + end * np.eye(6)[axis])).max()
            assert robot.travel_limit - 0.01 < largest <= robot.travel_limit


def test_command_writes_numbers_and_figures(mapped, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(workspace_map, "JOINT_SAMPLES", 500)
    monkeypatch.setattr(workspace_map, "map_workspace", lambda *_: mapped)
    assert command("workspace", "rss6", "--out", tmp_path / "map") == 0
    numbers = json.loads((tmp_path / "map" / "workspace.json").read_text())
    assert numbers["whole_travel"]["without_pose"] == 0
    assert numbers["whole_travel"]["largest_condition_J_ad"] < 10
    assert numbers["range_from_home"]["x_m"][1] == pytest.approx(0.0549, abs=1e-3)
    for name in ("travel.png", "conditioning.png"):
        assert (tmp_path / "map" / name).read_bytes().startswith(b"\x89PNG")
    assert "from home within travel" in capsys.readouterr().out
    assert command("workspace", "rss6", "--out", tmp_path / "map") == 1
    assert "is not empty" in capsys.readouterr().err
