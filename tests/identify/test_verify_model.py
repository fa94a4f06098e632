"""The paper's figure-7 loop on both engines, its verdict and figure, and the commands around other engines."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from dynamics.parameters import PARAMETER_NAMES
from identify.errors import RecordError, ScenarioError, TrajectoryError
from identify.files.run_folder import load_result, save_result
from identify.loop_parameters import choose_parameters
from identify.trajectory import check_travel
from identify.verification import against_mujoco
from identify.verification.against_mujoco import EngineRuns, compare_engines, exciting_trajectory, figure_8, judge
from tests.identify.commands import command, one_line


@pytest.fixture(scope="module")
def initial(robot):
    return robot.parameter_sets["initial"].vector


@pytest.fixture(scope="module")
def short_run(robot, initial):
    pytest.importorskip("mujoco")
    return compare_engines(robot, initial, initial, 2.1)


@pytest.fixture
def made_runs():
    """Runs over 4 s that differ by known amounts: 5 um at first, 2 um and 3 urad from 1 s on."""
    time = np.linspace(0, 4, 9)
    poses, torques = np.zeros((9, 6)), np.zeros((9, 6))
    other = np.zeros((9, 6))
    other[:2, 0], other[2:, 1], other[2:, 4] = 3e-6, 2e-6, -3e-6
    other[:2, 2] = 4e-6
    reference = np.full((9, 6), [1e-3, 0, 0, 0, 0, 2e-3])
    return EngineRuns(time, reference, poses, other, torques, torques - 0.5, time * 1e-9, time * 1e-3, "4.0.0")


def test_verdict_takes_lengths_before_and_after_settling_and_misses_where_one_exceeds_its_goal(made_runs):
    verdict = judge(made_runs)
    assert verdict.position_max_um == pytest.approx(5)
    assert verdict.position_steady_um == pytest.approx(2)
    assert verdict.angle_steady_urad == pytest.approx(3)
    assert verdict.torque_max_nm == pytest.approx(0.5)
    assert verdict.closure_max_um == pytest.approx(4e-3)
    assert verdict.spin_max_rad_s == pytest.approx(4e-3)
    assert (verdict.tracking_max_um, verdict.tracking_max_urad) == (pytest.approx(1e3), pytest.approx(2e3))
    assert verdict.met
    for column in (0, 5):
        beyond = made_runs.mujoco_pose.copy()
        beyond[-1, column] = 21e-6
        assert not judge(replace(made_runs, mujoco_pose=beyond)).met


def test_engines_agree_to_nanometres_under_the_papers_pid(short_run):
    """Ten thousand times below the goals, while the soft PID leaves both a millimetre from the reference."""
    verdict = judge(short_run)
    assert verdict.position_max_um < 0.01
    assert verdict.angle_max_urad < 0.01
    assert verdict.torque_max_nm < 1e-5
    assert verdict.closure_max_um < 0.01
    assert verdict.spin_max_rad_s < 1e-6
    assert verdict.tracking_max_um > 500


@pytest.mark.slow
@pytest.mark.parametrize(("name", "factor"), [("platform.mass", 1.01), ("link1.mass", 1.01), ("platform.Ixx", 1.05)])
def test_a_wrong_parameter_in_one_engine_is_seen(robot, initial, short_run, name, factor):
    other = initial.copy()
    other[PARAMETER_NAMES.index(name)] *= factor
    verdict, right = judge(compare_engines(robot, initial, other, 2.1)), judge(short_run)
    assert verdict.angle_max_urad > 500 * right.angle_max_urad
    assert verdict.angle_max_urad > 1


def test_exciting_trajectory_starts_at_home_at_rest_and_stays_inside_the_travel(robot, monkeypatch):
    trajectory = exciting_trajectory(robot)
    np.testing.assert_allclose(trajectory.pose(0.0), robot.home_pose, atol=1e-12)
    np.testing.assert_allclose(trajectory.pose_rate(0.0), 0, atol=1e-12)
    check_travel(robot, trajectory, np.linspace(0, 10, 5000))
    narrow = against_mujoco.EXCITATION.model_copy(update={"travel_margin_rad": 0.8})
    monkeypatch.setattr(against_mujoco, "EXCITATION", narrow)
    with pytest.raises(TrajectoryError, match=r"only 0 of 50 random .*theta.* limit 0\.1948"):
        exciting_trajectory(robot)


def test_figure_has_units_goals_and_the_closure_error(made_runs):
    figure = figure_8(made_runs)
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert labels == ["position error [um]", "angle error [urad]", "gap [um]"]
    assert "steady 2 um (goal 10 um" in figure.axes[0].get_title()
    np.testing.assert_allclose(figure.axes[0].lines[1].get_ydata(), 1e6 * made_runs.difference[:, 1])
    assert "time [s]" in figure.axes[2].get_xlabel()


@pytest.mark.slow
def test_command_verifies_the_reference_robot(monkeypatch, capfd, tmp_path):
    """Three seconds of it; the whole ten are one of our figures, see tests/accuracy."""
    pytest.importorskip("mujoco")
    monkeypatch.setattr("identify.verification.against_mujoco.DURATION_S", 3.0)
    assert command("verify-model", "--out", tmp_path / "new") == 0
    entry = load_result(tmp_path / "new" / "verification.json")
    assert entry["met"]
    assert entry["difference"]["position_steady_um"] < 0.01
    assert entry["difference"]["angle_steady_urad"] < 0.01
    assert entry["mujoco"]["inertias_changed"][0].startswith("crank1")
    assert (tmp_path / "new" / "figure8.png").read_bytes().startswith(b"\x89PNG")
    said = capfd.readouterr()
    assert "MuJoCo's loop closure" in said.out
    assert "MuJoCo: 601 of 601" in said.err


def test_command_fails_in_one_line_where_a_goal_is_missed(made_runs, monkeypatch, capfd, tmp_path):
    off = replace(made_runs, mujoco_pose=made_runs.mujoco_pose + 1e-4)
    monkeypatch.setattr("identify.verification.against_mujoco.verify", lambda *_: off)
    assert command("verify-model", "--out", tmp_path / "new", "--quiet") == 1
    said = one_line(capfd.readouterr().err)
    assert "model and MuJoCo differ by 174 um and 171 urad, more than 10 um and 20 urad" in said
    assert json.loads((tmp_path / "new" / "verification.json").read_text())["met"] is False


@pytest.mark.parametrize(
    ("arguments", "evidence"),
    [
        (("verify-model", "--out", "new"), "pip install '.[mujoco]'"),
        (("verify-model", "nope"), "unknown robot `nope`"),
        (("export", "mjcf", "rss6"), "crank1, crank2, crank3, crank4, crank5, crank6: Izz 0.000605 > Ixx 0.000229 + "),
        (("export", "mjcf", "rss6", "--parameters", ""), "'' is neither a parameter set of robot rss6 (identified, in"),
        (("export", "mjcf", "rss6", "--allow-unphysical-inertia", "--out", "."), "cannot write ."),
    ],
)
def test_what_cannot_be_done_is_one_line_and_leaves_nothing(monkeypatch, capfd, tmp_path, arguments, evidence):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    monkeypatch.chdir(tmp_path)
    assert command(*arguments, "--quiet") == 1
    assert evidence in one_line(capfd.readouterr().err)
    assert list(tmp_path.iterdir()) == []


def test_export_writes_the_estimates_of_a_run_and_says_what_it_changed(robot, monkeypatch, capfd, tmp_path):
    mujoco = pytest.importorskip("mujoco")
    values = dict(zip(PARAMETER_NAMES, robot.parameter_sets["identified"].dynamic.tolist(), strict=True))
    values["platform.mass"] = 23.456
    save_result(tmp_path / "result.json", made_result(values))
    out = tmp_path / "model.xml"
    out.write_text("an older one")
    options = ("--parameters", tmp_path / "result.json", "--allow-unphysical-inertia", "--out", out)
    assert command("export", "mjcf", "rss6", *options) == 0
    model = mujoco.MjModel.from_xml_path(str(out))
    assert model.body("platform").mass[0] == 23.456
    assert model.joint("joint4").damping[0] == 0.854
    said = {line.split(": ")[0]: line for line in capfd.readouterr().out.splitlines()}
    assert said["changed platform"].startswith("changed platform: Ixx 0.161 -> 0.171667")
    assert said["changed platform"].endswith("; accelerations differ by up to 4.4 %")
    assert said["changed link1"].endswith("; the motion does not feel it")
    assert len(said) == 1 + 1 + 3 + 6  # the model; platform, three cranks and the links
    assert {path.name for path in tmp_path.iterdir()} == {"result.json", "model.xml"}
    monkeypatch.chdir(tmp_path)
    assert command("export", "mjcf", "rss6", "--allow-unphysical-inertia", "--quiet") == 0
    assert (tmp_path / "rss6.xml").exists(), "named after the robot where not told otherwise"


def made_result(values):
    return {"identification": {"parameters": {name: {"estimate": value} for name, value in values.items()}}}


def test_parameters_default_to_the_nominal_set(robot):
    np.testing.assert_array_equal(choose_parameters(robot).values, robot.nominal_parameters)
    with pytest.raises(ScenarioError, match=r"\(identified, initial\)"):
        choose_parameters(robot, "other")


def second_crank(mass):
    return made_result(dict.fromkeys(PARAMETER_NAMES, 1.0) | {"crank2.mass": mass})


@pytest.mark.parametrize(
    ("result", "evidence"),
    [
        ({"identification": []}, "no identification.parameters"),
        (made_result(dict.fromkeys(PARAMETER_NAMES[3:], 1.0)), "estimate of platform.mass, platform.Ixx, platform.Iyy"),
        (made_result(dict.fromkeys(PARAMETER_NAMES, None)), "platform.mass, platform.Ixx, platform.Iyy and 61 more"),
        (second_crank(True), "estimate of crank2.mass is true, must be a finite number"),
        (second_crank("0.1"), 'estimate of crank2.mass is "0.1", must be a finite number'),
        (second_crank(float("nan")), "estimate of crank2.mass is NaN, must be"),
        (second_crank(10**400), "estimate of crank2.mass is 10000"),
        (second_crank(-0.1), r"crank2.mass = -0.1 kg is not allowed, must be finite and >= 0"),
    ],
)
def test_result_without_estimates_or_with_one_that_is_no_number_in_its_range_is_refused(
    robot, tmp_path, result, evidence
):
    (tmp_path / "result.json").write_text(json.dumps(result))
    with pytest.raises(RecordError, match=evidence) as caught:
        choose_parameters(robot, str(tmp_path / "result.json"))
    assert str(caught.value).startswith(str(tmp_path / "result.json"))
    assert len(str(caught.value)) < 200 + len(str(tmp_path))


@pytest.mark.parametrize(
    ("command_name", "folder"), [("verify-model", "/proc/impossible"), ("workspace", "file/impossible")]
)
def test_folder_that_cannot_be_made_is_refused_before_anything_is_computed(
    monkeypatch, capfd, tmp_path, command_name, folder
):
    def compute(*_):
        raise AssertionError("computed first")

    monkeypatch.setattr("identify.verification.against_mujoco.verify", compute)
    monkeypatch.setattr("identify.verification.workspace_map.map_workspace", compute)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    assert command(command_name, "--out", folder) == 1
    assert "cannot be made" in one_line(capfd.readouterr().err)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
