"""Robots from files, and robots whose joints are off their places: they are what they are said to
be, or refused.
"""

import itertools
import json
import pickle
from dataclasses import replace
from importlib import resources

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import fsolve
from scipy.stats import chi2

import dynamics
from dynamics.errors import ChartError, RobotFileError
from dynamics.geometry import RobotGeometry
from dynamics.robot_file import RobotFile, parsed_robot, robot_schema
from tests.dynamics.conftest import BOX, of_legs, place_legs


def test_the_file_holds_the_robot_of_radii_and_angles(robot):
    """Platform joints and crank tips at home to 1e-14 m; leg order k0-, k0+, k1-, k1+, k2-, k2+."""
    g, side = robot.geometry, np.tile([-1, 1], 3)
    at_joint, at_tip = (
        np.repeat(2 * np.pi / 3 * np.arange(3), 2) + side * half for half in (0.95, 0.10)
    )
    joints = 0.200 * np.column_stack([np.cos(at_joint), np.sin(at_joint), np.zeros(6)])
    tips = 0.300 * np.column_stack([np.cos(at_tip), np.sin(at_tip), np.zeros(6)])
    link = joints + np.array([0, 0, 0.200]) - tips
    along = side[:, None] * np.column_stack([-link[:, 1], link[:, 0], np.zeros(6)])
    along /= np.linalg.norm(link[:, :2], axis=1, keepdims=True)
    np.testing.assert_allclose(g.platform_joints, joints, atol=1e-14)
    np.testing.assert_allclose(of_legs(g, "crank_zero_direction"), along, atol=1e-14)
    np.testing.assert_allclose(g.base_joints, tips - 0.060 * along, atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(link, axis=1), of_legs(g, "link_length"), atol=1e-14)
    np.testing.assert_array_equal(of_legs(g, "crank_axis"), np.tile([0, 0, 1], (6, 1)))
    assert set(of_legs(g, "crank_length")) == {0.06}
    assert (tuple(g.home_pose), tuple(g.gravity)) == ((0, 0, 0.2, 0, 0, 0), (0, 0, -9.81))
    assert g.travel_limit == 0.9948
    assert not g.legs[0].base_joint.flags.writeable
    np.testing.assert_allclose(robot.inverse_kinematics(robot.home_pose), 0, atol=1e-14)


def test_the_stated_travel_covers_the_box(robot):
    """Over the box +-10 mm, +-0.04 rad (its 64 corners and 5000 poses inside) the largest angle is
    a corner's.
    """
    corners = np.array(list(itertools.product([-1, 1], repeat=6)))
    inside = np.random.default_rng(0).uniform(-1, 1, (5000, 6))
    theta = robot.inverse_kinematics(robot.home_pose + BOX * np.vstack([corners, inside]))
    np.testing.assert_allclose(np.abs(theta).max(), 0.8029, atol=1e-4)
    assert np.abs(theta).argmax() < 64 * 6


@settings(max_examples=100, deadline=None)
@given(offset=st.lists(st.floats(-1, 1), min_size=6, max_size=6).map(np.array))
def test_legs_close_on_the_branch_of_home(robot, legs_at, offset):
    """From T, built with the angles of the inverse kinematics, A lies one link length away, on the
    side it has at home: the sign of (w x l) . s, which vanishes only where crank and link are
    stretched or folded."""
    pose = robot.home_pose + 1.3 * BOX * offset
    # Some corners of this box are out of reach.
    assume((robot.reach_margin(pose) > 0).all())
    place, home = legs_at(pose), legs_at(robot.home_pose)
    link, home_link = place.joint - place.tip, home.joint - home.tip
    np.testing.assert_allclose(
        np.linalg.norm(link, axis=1), robot.geometry.legs[0].link_length, rtol=1e-13
    )
    axes = of_legs(robot.geometry, "crank_axis")
    side, home_side = (
        np.sum(np.cross(p, q) * axes, axis=1)
        for p, q in ((place.crank, link), (home.crank, home_link))
    )
    assert (side * home_side > 0).all()


FIRST_JOINT = "[0.33383501391252074, -0.0784425512051534, 0.0]"


def test_what_names_no_robot_is_one_line_with_what_was_given_and_the_valid_names(tmp_path):
    (tmp_path / "picture.toml").write_bytes(b"\x89PNG\xff\xfe")
    for name, words in (
        (
            "rss7",
            r"unknown robot `rss7`; built-in robots: .*rss6, rss6_coplanar, .*; or give the path",
        ),
        (tmp_path / "none.toml", r"cannot read robot file .*none\.toml"),
        ("rss6\0.toml", r"cannot read robot file .*null byte"),
        (tmp_path / "picture.toml", "cannot read robot file"),
        (None, "by its name or the path of its file, got None"),
        (["rss6"], r"by its name or the path of its file, got \['rss6'\]"),
    ):
        with pytest.raises(RobotFileError, match=words):
            dynamics.load_robot(name)
    with pytest.raises(
        RobotFileError, match="description must be of type RobotDescription, got 'rss6' of type str"
    ):
        dynamics.Robot("rss6")
    assert {"rss6", "ups6", "delta3"} < set(dynamics.built_in_robots())


def test_a_file_by_path_and_a_robot_sent_to_another_process_are_the_same_robot(load_changed, robot):
    """Equal geometry and parameters; compiled functions are shared by geometry and not sent
    along."""
    for copy in (load_changed({}), pickle.loads(pickle.dumps(robot))):
        assert copy is not robot
        assert copy.geometry == robot.geometry
        assert copy.functions is robot.functions
        np.testing.assert_array_equal(copy.nominal_parameters, robot.nominal_parameters)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            'name = "rss6"',
            'name = "rss6"\ncolour = "red"',
            "unknown key colour; valid: name, family, chart, home_pose",
        ),
        (
            "crank_axes = [",
            "crank_axis = [",
            "legs: crank_axis is a key of one leg, .* all legs it is crank_axes",
        ),
        (
            "travel_limit = 0.9948",
            "travel_limit = 57.0",
            "travel_limit is 57 rad, 9.07 turns; if it is in degrees, it is 0.994838 in rad",
        ),
        (
            "home_pose = [0.0, 0.0, 0.2,",
            "home_pose = [0.0, 0.0, 200.0,",
            "position of 200 m, .* within 0.33.* m of their frames; if it is in mm, it is 0.2 in m",
        ),
        (
            "home_pose = [0.0, 0.0, 0.2, 0.0, 0.0, 0.0]",
            "home_pose = [0.0, 0.0, 0.2, 0.0, 0.0, -30.0]",
            "an angle of -30 rad; if it is in degrees, it is -0.523599 in rad",
        ),
        (
            "crank_length = 0.06",
            "crank_lenght = 0.06",
            "legs: unknown key crank_lenght; valid: base_joints",
        ),
        ("crank_length = 0.06\n", "", "legs: crank_length: Field required"),
        (
            "mass = 24.0, ",
            "mass = 24.0, weight = 1, ",
            "guess.platform: .*unknown key weight; valid: mass",
        ),
        ('family = "rss6"', 'family = "delta"', "family: unknown `delta`; valid: rss6, "),
        ("crank_length = 0.06", 'type = "rpr"', "leg 1: its type is 'rpr'; valid: rss, rus, ups, "),
        (
            "link_length = 0.30133373938841",
            "link_length = -0.3",
            "link_length: -0.3 is outside the range of machines",
        ),
        (
            "link_length = 0.30133373938841",
            "link_length = 0.1",
            "leg 1 cannot reach the home pose: reach margin -",
        ),
        (
            "link_length = 0.30133373938841",
            'link_length = "long"',
            "link_length: .* a valid number, .*got 'long'",
        ),
        (
            f"    {FIRST_JOINT},\n",
            "",
            "legs.base_joints needs one value, or a list of 6 values, got 5",
        ),
        (
            FIRST_JOINT,
            "[0.33, -0.07]",
            "leg 1: base_joint: needs 3 finite numbers, got .0.33, -0.07.",
        ),
        (
            "    [0.0, 0.0, 1.0],\n",
            "    [0.0, 0.0, 2.0],\n",
            "leg 1: crank_axis: has length 2, must be 1",
        ),
        (
            "    [0.0, 0.0, 1.0],\n",
            "    [0.0, 0.6, 0.8],\n",
            "leg 1: crank_zero_direction must be normal to the crank axis; .*limit 0.0001",
        ),
        ("mass = [0.671, ", "mass = [", r"crank.mass needs one value or 6 values, got 5"),
        (
            "crank = { mass = 0.685",
            "crank = { mass = -0.685",
            r"crank.mass: -0.685 is outside the range of machines",
        ),
        ("home_pose = [0.0, ", "home_pose = [", "home_pose: List should have at least 6 items"),
        (
            "[parameters.guess]",
            "[parameters.initial]",
            "needs a parameter set `guess` .*; it has .*initial.*truth",
        ),
        ('name = "rss6"', "name = ", "is not valid TOML"),
    ],
)
def test_robot_files_that_make_no_robot(load_changed, old, new, message):
    """Unknown keys list the valid ones; places, counts, values and legs are named; the file is
    named first.
    """
    with pytest.raises(RobotFileError, match=rf"robot file .*changed.toml.*{message}"):
        load_changed({old: new})


def test_travel_and_length_of_sliders_in_mm_and_a_key_of_all_legs_in_one_are_named():
    text = (resources.files("dynamics") / "robots" / "ups6.toml").read_text(encoding="utf-8")
    changed = text.replace("travel_limit = 0.06 ", "travel_limit = 60.0 ")
    assert changed != text
    with pytest.raises(RobotFileError, match=r"travel_limit is 60 m, .* in mm, it is 0.06 in m"):
        parsed_robot(changed, "mine.toml")
    changed = text.replace("zero_length = 0.3013337393884099", "zero_length = 301.3")
    with pytest.raises(RobotFileError, match=r"zero_length is 301.3 m, .* mm, it is 0.3013 in m"):
        parsed_robot(changed, "mine.toml")
    with pytest.raises(ValueError, match=r"leg 1: crank_axes is a key of all legs, .* crank_axis"):
        RobotFile.model_validate({"legs": [{"type": "rss", "crank_axes": [0, 0, 1]}]})


@pytest.mark.slow
def test_directions_may_be_rounded_to_six_decimals(load_changed, robot):
    """The legs close as they do with all digits: at home, and at a pose found again from its own
    joint angles.
    """
    exact = [leg.crank_zero_direction.tolist() for leg in robot.geometry.legs]
    rounded = {repr(value): f"{value:.6f}" for direction in exact for value in direction[:2]}
    tilted = {"    [0.0, 0.0, 1.0],\n": "    [0.0, 2e-6, 1.0],\n"}
    changed = load_changed(rounded | tilted)
    pose = robot.home_pose + 0.5 * BOX * [1, -1, 1, -1, 1, -1]
    theta = changed.inverse_kinematics(pose)
    np.testing.assert_allclose(theta, robot.inverse_kinematics(pose), atol=1e-5)
    np.testing.assert_allclose(changed.forward_kinematics(theta), pose, atol=1e-9)


ERROR = 1e-4
THETA = np.array([0.21, -0.14, 0.3, 0.05, -0.22, 0.11])


@pytest.mark.slow
def test_joint_centres_are_off_by_normal_errors_of_the_given_size_and_seed(robot):
    """The squares of 15 robots' 36 errors over the variance are chi-square, their mean is zero."""
    plants = [robot.geometry.with_errors(ERROR, np.random.default_rng(k)) for k in range(15)]
    names = ("base_joints", "platform_joints")
    errors = np.array(
        [
            [getattr(plant, name) - getattr(robot.geometry, name) for name in names]
            for plant in plants
        ]
    )
    assert errors.shape == (15, 2, 6, 3)
    assert 1e-3 < chi2.cdf(np.sum(errors**2) / ERROR**2, errors.size) < 1 - 1e-3
    assert abs(errors.mean()) < 3.3 * ERROR / np.sqrt(errors.size)
    assert robot.geometry.with_errors(ERROR, np.random.default_rng(3)) == plants[3] != plants[4]
    assert robot.with_geometry(robot.geometry.with_errors(0.0, np.random.default_rng(3))) is robot


def test_lengths_and_axes_are_off_by_normal_errors_of_their_own(robot):
    plants = [
        robot.geometry.with_errors(0.0, np.random.default_rng(k), 1e-4, 1e-3) for k in range(10)
    ]
    off = np.array([plant.deviations_from(robot.geometry) for plant in plants])
    for word, size in (("length", 1e-4), ("axis", 1e-3)):
        own = off[:, [word in name for name in robot.geometry.number_names]]
        assert own.shape == (10, 12)
        assert 1e-3 < chi2.cdf(np.sum(own**2) / size**2, own.size) < 1 - 1e-3
    assert not off[:, ["joint" in name for name in robot.geometry.number_names]].any()


def _gaps(pose, theta, geometry):
    """|A - T| less the link length of every leg."""
    legs = place_legs(geometry, pose, theta)
    return np.linalg.norm(legs.joint - legs.tip, axis=1) - of_legs(geometry, "link_length")


@pytest.mark.thorough
def test_the_plant_closes_its_own_loops_at_home_and_elsewhere(robot):
    """Against MINPACK on the loops; the nominal robot with the same crank angles is elsewhere, by
    about the error.
    """
    plant = robot.with_geometry(robot.geometry.with_errors(ERROR, np.random.default_rng(3)))
    np.testing.assert_allclose(_gaps(plant.home_pose, np.zeros(6), plant.geometry), 0, atol=1e-15)
    pose = plant.forward_kinematics(THETA)
    solved = fsolve(_gaps, plant.home_pose, args=(THETA, plant.geometry), xtol=1e-13)
    np.testing.assert_allclose(pose, solved, atol=1e-12)
    assert 0.1 * ERROR < np.abs(pose - robot.forward_kinematics(THETA))[:3].max() < 10 * ERROR


def test_the_schema_for_editors_is_that_of_the_files_that_are_read():
    kept = (resources.files("dynamics") / "robots" / "robot.schema.json").read_text(
        encoding="utf-8"
    )
    assert json.loads(kept) == robot_schema()


def _machine(name, keep=slice(None), add=(), chart=None):
    """The geometry of a built-in robot with other legs or another chart."""
    known = dynamics.load_robot(name).geometry
    other = known.chart if chart is None else replace(known.chart, name=chart)
    return RobotGeometry((*known.legs[keep], *add), other, known.travel_limit, known.gravity)


def test_machines_with_more_or_fewer_freedoms_than_actuators_are_counted_and_named():
    legs = {name: dynamics.load_robot(name).geometry.legs for name in ("rss6", "pss6", "delta3")}
    for arguments, words in (
        (
            ("rss6", slice(5)),
            r"under-actuated: 5 actuated legs for 6 freedoms .*\(x, y, z, alpha, beta, gamma\)",
        ),
        (
            ("ups6", slice(6), [legs["pss6"][0]]),
            "redundantly actuated: 7 actuated legs for 6 freedoms",
        ),
        (
            ("rss6", slice(6), [legs["delta3"][0]]),
            r"leg 7 is of a kind \(ParallelogramLeg\) .* `translation`, not",
        ),
        (
            ("rss6", slice(3), (), "translation"),
            r"leg 1 .*\(RssLeg\) that works with the chart `free`, not on a",
        ),
        (
            ("rss6", slice(5), [legs["pss6"][0]]),
            "leg 6: actuators that slide and actuators that turn cannot share a joint",
        ),
        (("rss6", slice(5), [legs["rss6"][2]]), "legs 3 and 6 are in one place"),
        (
            ("delta3", slice(3), (), "spherical"),
            "unknown chart `spherical`; valid: free, translation, planar",
        ),
    ):
        with pytest.raises(RobotFileError, match=words):
            _machine(*arguments)


def test_gains_of_the_wrong_unit_are_refused_with_value_and_unit(tmp_path):
    text = (resources.files("dynamics") / "robots" / "ups6.toml").read_text(encoding="utf-8")
    for unit, words in ((', unit = "N m/rad"', "is in N m/rad"), ("", "has no unit")):
        (tmp_path / "mine.toml").write_text(text.replace(', unit = "N/m"', unit), encoding="utf-8")
        with pytest.raises(
            RobotFileError, match=rf"lp = 5000 {words}, but the actuators slide: .* in N/m"
        ):
            dynamics.load_robot(tmp_path / "mine.toml")


def test_poses_and_motions_that_a_platform_cannot_have_are_refused_by_number():
    robot = dynamics.load_robot("delta3")
    turned = robot.home_pose + 0.01 * np.eye(6)[4]
    with pytest.raises(
        ChartError, match=r"delta3 moves in x, y, z only: pose .* is 0.01 off in beta"
    ):
        robot.inverse_kinematics(turned)
    with pytest.raises(ChartError, match=r"twist .* is 0.3 off in gamma"):
        robot.inverse_dynamics(robot.home_pose, [0, 0, 0, 0, 0, 0.3], np.zeros(6))
    np.testing.assert_array_equal(robot.pose(robot.coordinates(turned)), robot.home_pose)
