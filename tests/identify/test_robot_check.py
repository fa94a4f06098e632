"""`cmmsim check`: what is found of a sound robot, and of one spoilt in several ways, with number,
limit and leg.
"""

import json
from dataclasses import replace
from importlib import resources
from types import SimpleNamespace

import numpy as np
import pytest

from cmmsim.files import read_sensor_file
from cmmsim.files.rig_and_bodies import marked_body
from dynamics import Robot, load_robot
from dynamics.kinematics.platform import Chart
from dynamics.robot_file import parsed_robot
from identify.commands import run_stages
from identify.commands.help import BEYOND_LIMIT
from identify.commands.options import built_in_names
from identify.errors import EstimationError, ScenarioError
from identify.experiment.fitted_sensor import fitted
from identify.experiment.sensor_in_loop import check_platform
from identify.scenario import load_scenario
from identify.setup import Setup
from identify.verification.robot_check import check_sets, check_travel, run_warning
from identify.verification.sensor_check import about_sensor, check_legs_outside
from tests.identify.commands import command, one_line


def _found(path):
    content = json.loads(path.read_text(encoding="utf-8"))
    assert all(
        set(entry) == {"check", "ok", "value", "limit", "unit", "leg", "text", "relation"}
        for entry in content["findings"]
    )
    assert content["ok"] == all(entry["ok"] for entry in content["findings"])
    return {entry["check"]: entry for entry in content["findings"]}


def test_a_gough_stewart_platform_is_found_sound_with_the_numbers_of_its_own_methods(
    tmp_path, capfd
):
    assert command("check", "ups6", "--json", tmp_path / "found.json") == 0
    found, robot = _found(tmp_path / "found.json"), load_robot("ups6")
    assert all(entry["ok"] for entry in found.values())
    held = robot.static_torque(robot.home_pose, robot.parameter_sets["truth"].dynamic)
    assert found["holding torque"]["value"] == pytest.approx(np.abs(held).max())
    assert (found["holding torque"]["unit"], found["holding torque"]["leg"]) == (
        "N",
        np.abs(held).argmax() + 1,
    )
    assert found["leverage over the travel"]["value"] == 1.0  # a cylinder pushes along its leg
    assert found["loop"]["value"] < 1 < found["gain margin"]["value"]
    assert found["frame rate"]["value"] < 60
    assert (found["sensor's home"]["value"], found["sensor's platform"]["ok"]) == (0.0, True)
    assert "ups6, parameters `truth`" in capfd.readouterr().out


@pytest.mark.slow
@pytest.mark.thorough
@pytest.mark.parametrize("name", built_in_names("robot"))
def test_a_built_in_robot_passes_but_for_known_faults(name, tmp_path):
    """The paper prints inertias that no body has, and the travel of rus6 ends at a singularity."""
    command("check", name, "--quiet", "--json", tmp_path / "found.json")
    failed = {check for check, entry in _found(tmp_path / "found.json").items() if not entry["ok"]}
    known = {"rss6": {"inertias"}, "rus6": {"condition over the travel"}}
    assert failed == known.get(name, set())


@pytest.mark.slow
def test_gains_are_designed_for_the_bandwidth_and_damping_that_are_asked_for(tmp_path, capfd):
    asked = [
        "--set",
        "control.servo_bandwidth_rad_s=3.5",
        "--set",
        "control.servo_damping=0.3",
        "--quiet",
    ]
    assert command("check", "delta3", *asked, "--json", tmp_path / "found.json") == 0
    found = _found(tmp_path / "found.json")
    assert "give a bandwidth of 3.5 rad/s with a damping of 0.3" in found["servo by design"]["text"]
    assert found["servo by design"]["value"] > 1
    assert found["computed torque"]["value"] < 1
    assert 3 < found["bandwidth"]["value"] < 5
    beyond = ["--set", "control.servo_bandwidth_rad_s=60.0", "--quiet"]
    assert command("check", "delta3", *beyond, "--json", tmp_path / "found.json") == BEYOND_LIMIT
    assert "no gains of the servo give delta3 a bandwidth of 60 rad/s" in one_line(
        capfd.readouterr().err
    )


@pytest.mark.parametrize(
    ("observer", "most"), [("true", np.pi * 60), ("false", pytest.approx(69.503, rel=1e-4))]
)
def test_a_bandwidth_that_frames_cannot_show_or_that_is_unstable_fails_with_the_largest_one(
    observer, most, tmp_path
):
    """Without observer the linear loop of vision alone: its largest bandwidth was found by
    bisection of its radius.
    """
    asked = [
        "--set",
        "control.bandwidth_rad_s=400.0",
        "--set",
        f"control.observer={observer}",
        "--quiet",
    ]
    assert command("check", "ups6", *asked, "--json", tmp_path / "found.json") == BEYOND_LIMIT
    found = _found(tmp_path / "found.json")
    fast = found["torque bandwidth"]
    assert (fast["ok"], fast["value"], fast["limit"], fast["unit"]) == (False, 400.0, most, "rad/s")
    assert found["computed torque"]["ok"] == (observer == "true")


@pytest.mark.slow
def test_a_spoilt_robot_fails_by_number_and_leg(tmp_path, capfd, monkeypatch):
    """A cylinder that no body is, a travel beyond what the legs can reach, and gains that no frame
    rate holds.
    """
    text = (resources.files("dynamics") / "robots" / "ups6.toml").read_text(encoding="utf-8")
    for old, new in (
        ("Ixx = [0.00672, 0.00607, 0.00703", "Ixx = [0.00672, 0.00607, 0.0203"),
        ("travel_limit = 0.06", "travel_limit = 0.2"),
        ("ld = 208.0", "ld = 0.0"),
        ("viscous = [66.6, 53.9, 36.2, 60.2, 67.3, 67.2]", "viscous = 0.0"),
    ):
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
    assert (
        command("check", tmp_path / "mine.toml", "--json", tmp_path / "found.json", "--quiet")
        == BEYOND_LIMIT
    )
    found = _found(tmp_path / "found.json")
    failed = {name for name, entry in found.items() if not entry["ok"]}
    assert {"inertias", "loop", "gain margin", "frame rate"} <= failed
    assert found["drives by design"]["ok"]
    assert "joint_pid = { lp = " in found["drives by design"]["text"]
    warned = run_warning(Setup(load_scenario("quick", robot=str(tmp_path / "mine.toml"))))
    assert warned.startswith("the check of ups6 fails: ")
    assert "gain margin" in warned
    assert "\n" not in warned
    assert run_warning(Setup(load_scenario("quick", robot="ups6"))) is None
    assert found["inertias"]["leg"] == 3
    assert found["loop"]["value"] > 1 == found["loop"]["limit"]
    assert f"{len(failed)} of {len(found)} findings about ups6 fail" in one_line(
        capfd.readouterr().err
    )

    def begin(*_):
        raise EstimationError("it has begun")

    stages = SimpleNamespace(is_begun=lambda *_: False, run=begin)
    monkeypatch.setattr(run_stages, "_pipeline", lambda: stages)
    out = ("--out", tmp_path / "out", "--quiet")
    assert command("run", "quick", "--robot", tmp_path / "mine.toml", *out) != 0
    said = capfd.readouterr().err.splitlines()
    assert [line.partition(":")[0] for line in said] == ["warning", "error"]
    assert warned in said[0]


def test_a_travel_beyond_the_stroke_of_a_leg_fails_with_the_travel_that_fits():
    """Cylinder and rod of ups6 are 0.2 m long, and a leg is 0.30133 m at coordinate zero."""
    text = (resources.files("dynamics") / "robots" / "ups6.toml").read_text(encoding="utf-8")
    longer = text.replace("cylinder_length = 0.2", "cylinder_length = 0.28")
    assert parsed_robot(longer, "mine.toml").geometry.legs[0].travel_room == pytest.approx(
        0.02133, abs=1e-5
    )
    far = Robot(parsed_robot(text.replace("travel_limit = 0.06", "travel_limit = 0.2"), "mine"))
    found = {one.check: one for one in check_travel(far, load_scenario("paper").excitation)}
    assert not found["stroke"].ok
    assert found["stroke"].limit == pytest.approx(0.09867, abs=1e-5)
    assert not found["travel closes"].ok


def test_actuators_too_weak_to_hold_the_platform_fail_in_a_line_that_can_be_read(capfd):
    """Beside the inertias of ten bodies, of which the table has the whole list."""
    assert (
        command("check", "rss6", "--set", "control.torque_limit_N_m=3.0", "--quiet") == BEYOND_LIMIT
    )
    said = one_line(capfd.readouterr().err)
    assert (
        "2 of 26 findings about rss6 fail: holding torque: joint 6 holds the most at home, " in said
    )
    assert (
        "and the actuators have 3 N m; inertias: no rigid body has these; corrected, accelerations "
        "change by up to" in said
    )
    assert len(said) < 400


def test_a_report_that_cannot_be_written_and_an_unknown_set_are_named_in_one_line(tmp_path, capfd):
    assert command("check", "ups6", "--quiet", "--json", tmp_path) != 0
    assert "cannot write" in one_line(capfd.readouterr().err)
    assert command("check", "ups6", "--parameters", "best") != 0
    assert "it has guess, truth" in one_line(capfd.readouterr().err)


def test_a_robot_that_the_sensor_does_not_see_is_told_how_to_get_a_sensor_of_its_own():
    robot = load_robot("ups6")
    seen = load_scenario("quick").sensor_file()
    away = seen.model_copy(
        update={"platform": seen.platform.model_copy(update={"home": (0.0, 0.0, 0.4, 0, 0, 0)})}
    )
    where = ", ".join(f"{value:.4g}" for value in robot.home_pose)
    with pytest.raises(ScenarioError, match="cmmsim new sensor FILE --robot ROBOT writes one"):
        check_platform(robot, away, "mine")
    found = {one.check: one for one in about_sensor(robot, "mine", away)}
    assert not found["sensor's home"].ok
    assert f"must be near [{where}]; cmmsim new sensor FILE" in found["sensor's home"].text
    assert "cmmsim new sensor" not in found["sensor's platform"].text


def test_a_guess_in_grams_fails_the_check_and_a_missing_truth_names_the_setting():
    text = (resources.files("dynamics") / "robots" / "ups6.toml").read_text(encoding="utf-8")
    grams = text.replace("platform = { mass = 24.0", "platform = { mass = 24000.0")
    (found,) = check_sets(Robot(parsed_robot(grams, "mine.toml")))
    assert not found.ok
    assert found.value == pytest.approx(24000 / 23.5)
    assert "platform.mass differs most, by a factor of 1.02e+03" in found.text
    (found,) = check_sets(load_robot("ups6"))
    assert found.ok
    (found,) = check_sets(Robot(parsed_robot(text.partition("# What plays")[0], "mine.toml")))
    assert found.ok
    assert "--set plant.parameters=guess" in found.text


def test_a_run_that_its_sensor_will_end_is_not_said_to_begin(tmp_path):
    text = (resources.files("dynamics") / "robots" / "ups6.toml").read_text(encoding="utf-8")
    high = text.replace("home_pose = [0.0, 0.0, 0.2,", "home_pose = [0.0, 0.0, 0.255,")
    (tmp_path / "mine.toml").write_text(high, encoding="utf-8")
    warned = run_warning(Setup(load_scenario("quick", robot=str(tmp_path / "mine.toml"))))
    assert "sensor's home" in warned
    assert "begins" not in warned


def test_a_sensor_that_looks_past_the_platform_fails_the_check_with_its_remedy():
    robot = load_robot("ups6")
    file = load_scenario("quick").sensor_file()
    rig = file.rig.model_copy(update={"target": (0.3, 0.0, 0.9)})
    past = file.model_copy(update={"rig": rig})
    for sensor, sees in ((file, True), (past, False)):
        found = {one.check: one for one in about_sensor(robot, "mine", sensor)}["visible stickers"]
        assert (found.ok, found.limit) == (sees, 4)
        assert ("move rig.position or rig.target" in found.text) != sees


def test_a_sensor_made_for_a_robot_sees_its_platform_and_holds_its_legs():
    """The robot is ups6 with twice the platform and the base, half a metre higher."""
    ups6 = load_robot("ups6")
    large = {name: 2 * getattr(ups6.geometry, name) for name in ("platform_joints", "base_joints")}
    home = ups6.home_pose + np.array([0, 0, 0.5, 0, 0, 0])
    robot = SimpleNamespace(name="large", home_pose=home, geometry=SimpleNamespace(**large))
    file = read_sensor_file("ctrack780")
    with pytest.raises(ScenarioError, match=r"platform joint \d of large is 0\.2"):
        check_platform(robot, file, "ctrack780")
    made = fitted(file, robot)
    assert all(one.ok for one in about_sensor(robot, "mine", made))
    assert np.array(made.base.planes.A.point)[2] == pytest.approx(0.18 + 0.5)
    assert marked_body("base", made.base).nominal[:, 0].min() > large["base_joints"][:, 0].max()


def test_a_sensor_made_for_a_built_in_robot_is_the_built_in_sensor_but_for_a_cut(tmp_path):
    """The built-in platform ends 0.024 m before the joints of legs 4 and 5."""
    mine = tmp_path / "mine.toml"
    assert command("new", "sensor", mine, "--robot", "rss6", "--quiet") == 0
    built_in, made = read_sensor_file("ctrack780"), read_sensor_file(mine)
    cuts = list(built_in.platform.cuts)
    farthest = load_robot("rss6").geometry.platform_joints[:, 0].min()
    cuts[1] = cuts[1].model_copy(update={"point": (round(farthest, 4), 0.0, 0.0)})
    platform = built_in.platform.model_copy(update={"cuts": cuts})
    own = {"name": "ctrack780", "based_on": None}
    assert made.model_copy(update=own) == built_in.model_copy(update={"platform": platform})


def test_a_sensor_for_legs_from_above_has_its_platform_below_them():
    """The robot is a Delta robot whose base axes point up, as delta3 turned about its x axis."""
    delta3 = load_robot("delta3")
    turn = np.array([1.0, -1.0, -1.0])
    legs = tuple(
        leg.model_copy(
            update={
                name: turn * getattr(leg, name)
                for name, value in leg
                if isinstance(value, np.ndarray)
            }
        )
        for leg in delta3.geometry.legs
    )
    home = np.concatenate([turn * delta3.home_pose[:3], np.zeros(3)])
    geometry = replace(
        delta3.geometry,
        legs=legs,
        chart=Chart("translation", tuple(home)),
        gravity=turn * delta3.geometry.gravity,
    )
    robot = delta3.with_geometry(geometry)
    file = read_sensor_file("ctrack780")
    at_home = file.platform.model_copy(update={"home": tuple(home)})
    (found,) = check_legs_outside(robot, "mine", file.model_copy(update={"platform": at_home}))
    assert not found.ok
    assert "of leg" in found.text
    meshed = at_home.model_copy(update={"mesh": "platform.stl"})
    assert not list(check_legs_outside(robot, "mine", file.model_copy(update={"platform": meshed})))
    made = fitted(file, robot)
    findings = [*about_sensor(robot, "mine", made), *check_legs_outside(robot, "mine", made)]
    assert all(one.ok for one in findings)
    # the same scene, seen from the other side of its horizontal plane
    plain = fitted(file, delta3)
    assert made.rig.position == pytest.approx(turn * plain.rig.position)
    assert made.platform.planes.B.point == pytest.approx(turn * plain.platform.planes.B.point)
