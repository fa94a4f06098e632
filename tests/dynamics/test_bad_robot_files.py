"""What makes no robot is refused with the file, the key or leg, the value and the limit."""

import re

import numpy as np
import pytest

import dynamics
from dynamics.errors import RobotFileError

FIRST_JOINT = "[0.33383501391252074, -0.0784425512051534, 0.0]"


def test_unknown_robot_lists_the_known_ones(tmp_path):
    """The valid names are in the message, and a missing file is named by its path."""
    with pytest.raises(RobotFileError, match=r"unknown robot `rss7`; built-in robots: rss6; or give the path"):
        dynamics.load_robot("rss7")
    with pytest.raises(RobotFileError, match=r"cannot read robot file .*none\.toml"):
        dynamics.load_robot(tmp_path / "none.toml")
    assert dynamics.built_in_robots() == ["rss6"]


@pytest.mark.parametrize("name", [None, 5, b"rss6", ["rss6"]])
def test_a_robot_is_asked_for_by_name_or_path(name):
    """Anything else is one line with what was given, not an error of pathlib."""
    with pytest.raises(RobotFileError, match=re.escape(f"by its name or the path of its file, got {name!r}")):
        dynamics.load_robot(name)


def test_a_path_that_no_system_has():
    """A null byte is refused by Python before any file is looked for."""
    with pytest.raises(RobotFileError, match=r"cannot read robot file .*null byte"):
        dynamics.load_robot("rss6\0.toml")


def test_a_file_by_path_is_the_same_robot(load_changed, robot):
    """A copy of the built-in file gives an equal geometry and equal parameters."""
    copy = load_changed({})
    assert copy.geometry == robot.geometry
    np.testing.assert_array_equal(copy.nominal_parameters, robot.nominal_parameters)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "rss6"', 'name = "rss6"\ncolour = "red"', "unknown key colour; valid: name, family, home_pose"),
        ("crank_length = 0.06", "crank_lenght = 0.06", "legs: .*unknown key crank_lenght; valid: crank_length"),
        ("crank_length = 0.06\n", "", "legs.crank_length: Field required"),
        ("mass = 24.0, ", "mass = 24.0, weight = 1, ", "initial.platform: .*unknown key weight; valid: mass"),
        ('family = "rss6"', 'family = "delta"', "family: Input should be 'rss6'"),
        ("link_length = 0.30133373938841", "link_length = -0.3", "link_length must be positive and finite, got -0.3"),
        ("link_length = 0.30133373938841", "link_length = nan", "link_length must be positive and finite, got nan"),
        ("link_length = 0.30133373938841", "link_length = 0.1", "leg 1 cannot reach the home pose: reach margin -"),
        ("link_length = 0.30133373938841", 'link_length = "long"', "legs.link_length: Input should be a valid number"),
        (f"    {FIRST_JOINT},\n", "", r"base_joints must be .*\(6, 3\), got shape \(5, 3\)"),
        (FIRST_JOINT, "[0.33, -0.07]", "base_joints of leg 1 needs 3 numbers, got 2"),
        ("    [0.0, 0.0, 1.0],\n", "    [0.0, 0.0, 2.0],\n", "crank_axes of leg 1 has length 2, must be 1"),
        ("    [0.0, 0.0, 1.0],\n", "    [0.0, 0.6, 0.8],\n", "leg 1 must be normal to its crank axis; .*limit 1e-9"),
        ("mass = [0.671, ", "mass = [", r"crank.mass needs one value or 6 values, got 5"),
        ("crank = { mass = 0.685", "crank = { mass = -0.685", r"crank1.mass = -0.685 kg is not allowed"),
        ("home_pose = [0.0, ", "home_pose = [", r"home_pose must be finite with shape \(6,\)"),
        ("[parameters.initial]", "[parameters.first]", "needs a parameter set `initial`; it has .*first"),
        ('name = "rss6"', "name = ", "is not valid TOML"),
    ],
)
def test_robot_files_that_make_no_robot(load_changed, old, new, message):
    """Unknown keys list the valid ones; places, counts, values and legs are named; the file is named first."""
    with pytest.raises(RobotFileError, match=rf"robot file .*changed.toml.*{message}"):
        load_changed({old: new})


def test_binary_files_are_no_robot_files(tmp_path):
    """A file that is not text is an error of the robot file, not of the decoder."""
    path = tmp_path / "picture.toml"
    path.write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(RobotFileError, match="cannot read robot file"):
        dynamics.load_robot(path)


def test_a_robot_is_made_from_a_description():
    with pytest.raises(RobotFileError, match="description must be of type RobotDescription, got 'rss6' of type str"):
        dynamics.Robot("rss6")
