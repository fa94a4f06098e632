"""Robots from a few lengths: the built-in ones from their own, and others by their triangles."""

import casadi as ca
import numpy as np
import pytest

from dynamics import Robot, load_robot
from dynamics.closed_loop import FrameTiming, LoopSettings, ServoGains, stability
from dynamics.errors import RobotFileError
from dynamics.pseudo_inertia import inertial_parameters
from dynamics.robot_file import built_in_robots, parsed_robot, read_robot_file
from dynamics.robot_lengths import _at_rest_at_home, lengths_of, robot_of_lengths
from dynamics.robot_text import robot_text
from dynamics.scaled_bodies import scaled_bodies

# The paper's servo.
LOOPS = [
    LoopSettings(ServoGains(0.3, 0.001, 2.4), FrameTiming(rate, latency))
    for rate, latency in ((60.0, 0.0), (29.0, 1 / 29))
]


def geometry_of(name, **lengths):
    old = read_robot_file(name).geometry
    return _at_rest_at_home(old, lengths_of(old) | lengths)


@pytest.mark.parametrize("name", built_in_robots())
def test_a_built_in_robot_follows_from_its_own_lengths(name):
    made, old = geometry_of(name), read_robot_file(name).geometry
    np.testing.assert_allclose(made.home_pose, old.home_pose, atol=2e-9)
    np.testing.assert_allclose(made.numbers, old.numbers, atol=2e-9)
    np.testing.assert_allclose(made.deviations_from(old), 0, atol=1e-8)


OTHER = {
    "rss6": {"base_radius": 0.25, "platform_radius": 0.15, "crank": 0.08, "link": 0.25},
    "rss6_coplanar": {"base_radius": 0.3, "platform_radius": 0.25, "crank": 0.1, "link": 0.4},
    "rus6": {"base_radius": 0.6, "crank": 0.2, "link": 0.6},
    "delta3": {"base_radius": 0.2, "platform_radius": 0.06, "crank": 0.2, "link": 0.5},
    "rrr3": {"base_radius": 0.4, "platform_radius": 0.1, "crank": 0.2, "link": 0.3},
    "pss6": {"base_radius": 0.5, "link": 0.6},
    "pus6": {"platform_radius": 0.1, "link": 0.35},
    "ups6": {"base_radius": 0.5, "leg": 0.7, "cylinder": 0.45, "rod": 0.5},
}


@pytest.mark.parametrize("name", OTHER)
def test_legs_of_other_lengths_close_at_home_with_all_coordinates_zero(name):
    """By the points of each leg: the end of a level crank, or of a slider, and the platform."""
    made = geometry_of(name, **OTHER[name])
    new = lengths_of(made)
    assert {key: new[key] for key in OTHER[name]} == pytest.approx(OTHER[name], abs=1e-8)
    for leg, end in zip(made.legs, made.joints_at(made.home_pose), strict=True):
        begin, span = leg.base_joint, new.get("leg", new.get("link"))
        if "crank" in new:
            begin = begin + new["crank"] * leg.crank_zero_direction
        assert np.linalg.norm(end - begin) == pytest.approx(span, abs=1e-8)
        if "crank" in new and leg.crank_axis[2] == 1:
            assert (end - begin)[:2] @ leg.crank_zero_direction[:2] == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("factor", [1e-4, 1e2])
def test_a_robot_on_a_chip_and_a_crane_close_as_well(factor):
    """Coordinates have as many digits, whatever their size."""
    own = lengths_of(read_robot_file("rss6").geometry)
    made = geometry_of("rss6", **{name: factor * value for name, value in own.items()})
    assert made.home_pose[2] == pytest.approx(0.2 * factor, rel=1e-7)
    for leg, end in zip(made.legs, made.joints_at(made.home_pose), strict=True):
        assert float(leg.coordinate(ca.SX(end))) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "lengths", "said"),
    [
        ("rss6", {"leg": 0.3}, "unknown length of rss6 `leg`; valid: base_radius, platform_radius"),
        ("ups6", {"crank": 0.1}, "valid: base_radius, platform_radius, leg, cylinder, rod"),
        ("rss6", {"link": -1.0}, "link is -1.0 m, must be finite and > 0"),
        (
            "pus6",
            {"base_radius": 1e9},
            "base_radius: 1e+09 is outside the range of machines, 1e-06",
        ),
        ("delta3", {"link": float("nan")}, "link is nan m, must be finite and > 0"),
        ("rss6", {"crank": 0.3}, "crank is 0.3 m but must be shorter than the 0.2332 m in plan"),
        (
            "pss6",
            {"link": 0.2},
            "link is 0.2 m and does not reach: it must be longer than the 0.22",
        ),
        ("ups6", {"leg": 0.5}, "leg is 0.5 m but must be between 0.2 m, the longer of cylinder"),
        pytest.param(
            "rss6",
            {"base_radius": 0.25, "platform_radius": 0.15, "crank": 0.08, "link": 0.15},
            "within a travel of only 0.104 rad about home: 1391 of 2000 positions of the joints "
            "have no pose; condition of the platform side 189, must be <= 20, 11.7 at home",
            marks=pytest.mark.slow,
        ),
        ("rrr3", {"crank": 0.5, "link": 0.5}, "reach 0.7071 m at home but must be between 0.186"),
    ],
)
def test_a_length_that_cannot_be_is_refused_with_the_reason(name, lengths, said):
    with pytest.raises(RobotFileError) as caught:
        robot_of_lengths("mine", load_robot(name), lengths, LOOPS)
    assert said in str(caught.value)


def test_bodies_are_scaled_as_plates_and_bars():
    robot = load_robot("ups6")
    ratios = {"platform_radius": 2.0, "cylinder": 3.0, "rod": 0.5}
    given = robot.parameter_sets["truth"].dynamic
    made = robot.layout.bodies_of(scaled_bodies(robot.layout, given, ratios, {}))
    old = robot.layout.bodies_of(given)
    rows = [robot.layout.bodies.index(name) for name in ("platform", "cylinder1", "rod1")]
    parts = (made / np.where(old, old, 1))[rows][:, [0, 4, 5, 6]]
    bars = [[3, 27, 27, 3], [0.5, 1 / 8, 1 / 8, 0.5]]
    np.testing.assert_allclose(parts, [[4, 16, 16, 16], *bars], rtol=5e-4)  # four digits


def test_full_bodies_are_stretched_with_all_their_points():
    """By bodies of eight points of mass."""
    robot = load_robot("ups6").with_full_bodies(["platform", "rod"])
    layout = robot.layout
    points = np.random.default_rng(0).normal([0.02, -0.01, 0.03], 0.1, (8, 3))

    def body(mass, places):
        pseudo = np.c_[places, np.ones(8)]
        return inertial_parameters(mass / 8 * pseudo.T @ pseudo)

    given = robot.nominal_parameters.copy()
    bodies = layout.bodies_of(given)
    rows = [layout.bodies.index(name) for name in ("platform", "rod1")]
    bodies[rows] = body(2.0, points)
    given[layout.rigid] = layout.rigid_of(bodies)
    made = scaled_bodies(layout, given, {"platform_radius": 2.0, "rod": 0.5}, {})
    wanted = [body(8.0, points * [2, 2, 1]), body(1.0, points * [1, 1, 0.5])]
    np.testing.assert_allclose(layout.bodies_of(made)[rows], wanted, rtol=5e-4)


def test_links_and_cranks_whose_printed_inertias_no_body_has_become_rods():
    """By the moments of a slender bar, m L^2/12, beside which the thickness of a link is small."""
    made, comments = robot_of_lengths("mine", load_robot("rss6"), OTHER["rss6"], LOOPS)
    for values in made.parameter_sets.values():
        layout = Robot(made).layout
        bodies = layout.bodies_of(values.dynamic)
        places = [layout.bodies.index(name) for name in ("link1", "link6", "crank1", "crank6")]
        links, cranks = bodies[places[:2]], bodies[places[2:]]
        np.testing.assert_allclose(links[:, 4:6] / links[:, [0]], 0.25**2 / 12, rtol=0.02)
        assert (links[:, 6] < 0.05 * links[:, 4]).all()
        np.testing.assert_allclose(cranks[:, 5:7] / cranks[:, [0]], 0.08**2 / 12, rtol=0.3)
    assert any("crank and link of rss6: here they are those of uniform" in one for one in comments)


def check_made(name, lengths):
    """Read the file that is written, and its loops by their eigenvalues."""
    like = load_robot(name)
    made, comments = robot_of_lengths("mine", like, lengths, LOOPS)
    text = robot_text(made, comments)
    assert "family = " in text
    assert max(map(len, text.splitlines())) < 400
    again = parsed_robot(text, "mine")
    assert again.geometry == made.geometry
    robot = Robot(again)
    np.testing.assert_allclose(robot.inverse_kinematics(robot.home_pose), 0, atol=1e-7)
    for given in robot.parameter_sets.values():
        for loop in LOOPS:
            assert stability.gain_margin(robot, given.vector, loop, robot.home_pose) > 1.2
    return robot


def test_gains_by_design_make_both_loops_stable():
    check_made("rrr3", OTHER["rrr3"])


@pytest.mark.thorough
@pytest.mark.parametrize("name", OTHER)
def test_every_family_is_written_read_and_stable(name):
    check_made(name, OTHER[name])
    like = load_robot(name)
    unchanged = check_made(name, {"platform_radius": lengths_of(like.geometry)["platform_radius"]})
    # the corners of the travel of rus6 are near a singularity, which the new robot avoids
    assert (unchanged.travel_limit == like.travel_limit) == (name != "rus6")
    assert unchanged.travel_limit <= like.travel_limit
