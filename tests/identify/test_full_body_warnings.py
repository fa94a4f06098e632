"""Full bodies: what a record does not show of them, centres outside of them, and wrong settings."""

import re

import numpy as np
import pytest

import identify
from dynamics.errors import RobotFileError
from dynamics.robot_file import parsed_robot
from identify.errors import ScenarioError
from identify.estimation.full_bodies import full_body_warnings
from identify.verification.robot_check import _centres
from tests.identify.synthetic import changed_robot_file, rss6

FORMS = (
    r"is no form of a body; valid: centred or full, or a table of these by body or kind of body, "
    r'such as \{ platform = "full" \}'
)


def platform_robot():
    """The reference robot with a full platform, and its parameters with gains."""
    robot = rss6().with_full_bodies(["platform"])
    return robot, robot.parameter_sets["truth"].vector.copy()


def warned(centre, std, **unseen):
    """Warnings of a platform of 23.5 kg with a centre of mass, m, known to a standard deviation."""
    robot, values = platform_robot()
    values[1:4] = 23.5 * np.array(centre)
    covariance = np.zeros((len(values),) * 2)
    covariance[range(1, 4), range(1, 4)] = (23.5 * std) ** 2
    shown = ~np.isin(robot.layout.names, [f"platform.{name}" for name in unseen.get("names", ())])
    return full_body_warnings(robot, values, covariance, shown)


def test_a_centre_outside_of_the_joints_of_the_platform_is_noticed_beyond_its_deviation():
    """The joints of the platform are 0.2 m from its origin."""
    assert not warned((0.12, 0.12, 0.05), 0.001)
    assert not warned((0.2, 0.12, 0.05), 0.02)
    (said,) = warned((0.3, 0.0, 0.0), 0.02)
    assert said.startswith("the centre of mass of platform is 0.3 ± 0.02 m from the place")
    assert "its drawing reaches 0.2 m" in said


def test_numbers_of_which_a_record_shows_nothing_are_named():
    (said,) = warned((0.0, 0.0, 0.0), 0.001, names=("Ixy", "mcz"))
    assert "they keep their initial guess: platform: mcz, Ixy; a motion" in said


def test_the_check_of_a_robot_names_a_centre_outside_of_its_drawing():
    robot, values = platform_robot()
    (inside,) = _centres(robot, values)
    assert inside.ok
    values[1] = 23.5 * 0.25
    (outside,) = _centres(robot, values)
    assert not outside.ok
    assert outside.value == pytest.approx(1.25)
    assert "platform is 0.25 m from" in outside.text
    assert not list(_centres(rss6(), rss6().parameter_sets["truth"].vector))


@pytest.mark.parametrize("side", ["model", "plant"])
@pytest.mark.parametrize(
    ("value", "said"),
    [("ful", "'ful'"), ({"platform": "ful"}, "platform = 'ful'"), (3, "3"), (["a"], r"\['a'\]")],
)
def test_a_form_that_no_body_has_is_refused_in_one_line(side, value, said):
    with pytest.raises(ScenarioError, match=rf"{side}\.inertia: {said} {FORMS}$"):
        identify.load_scenario("quick", **{side: {"inertia": value}})


def test_so_it_is_in_a_robot_file(tmp_path):
    name = 'name = "rss6"'
    path = changed_robot_file(tmp_path / "a.toml", name, f'{name}\ninertia = "ful"')
    text = path.read_text(encoding="utf-8")
    with pytest.raises(RobotFileError, match=rf"^robot: inertia: 'ful' {FORMS}$"):
        parsed_robot(text, "robot")
    # what no body can have is said with the bound, and by how much
    with pytest.raises(RobotFileError, match=re.escape("Ixx 0.000229 + Iyy 0.000229 by 0.00015")):
        parsed_robot(text.replace('"ful"', '"full"'), "robot")


@pytest.mark.parametrize("gain", ["joint_pid.li", "joint3.li"])
def test_a_gain_that_the_law_of_the_drives_does_not_have_is_refused(gain):
    scenario = identify.load_scenario("quick", renderer="statistical")
    plant = replace_plant(scenario, gain)
    with pytest.raises(
        ScenarioError,
        match=rf"plant\.values\.{gain} = 11, but the law pd of the drives has only lp, ld",
    ):
        identify.set_up(plant)


def replace_plant(scenario, gain):
    """The scenario with drives without an integral, and a gain of it."""
    gains = "shared" if gain.startswith("joint_pid") else "each"
    changes = {"plant.drive": "pd", "plant.gains": gains, f"plant.values.{gain}": 11.0}
    return scenario.with_overrides(changes)
