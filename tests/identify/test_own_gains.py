"""Identification of robots whose drives differ: gains of each joint in plant and model."""

import json

import numpy as np
import pytest
from scipy.stats import chi2

from dynamics import Robot, load_robot
from dynamics.closed_loop import Drives, equilibrium
from dynamics.control.law_interface import LawInLoop
from dynamics.parameter_set import ParameterSet
from identify.diagnosis.diagnose import diagnosis_from
from identify.errors import EstimationError, RecordError, ScenarioError
from identify.estimation.identification import identify
from identify.estimation.prior import model_guess
from identify.estimation.scale_anchor import measured_anchor, measured_parameter
from identify.estimation.warm_start import joint_balance
from identify.estimators.estimator import Evidence
from identify.estimators.output_error_routes import known_pid
from identify.experiment.joint_instruments import measure_joints
from identify.experiment.truth import true_values
from identify.loop_parameters import in_form, is_gain, known_value
from identify.model.from_record import identified_model
from identify.reporting.parameter_tables import scale_sentence
from identify.setup import unseen_errors
from tests.dynamics.test_own_gains import SHARES
from tests.identify import test_any_robot as any_robot
from tests.identify.commands import command, one_line
from tests.identify.synthetic import (
    PERFECT,
    build_plant,
    changed_robot_file,
    problem_of,
    quick,
    rss6,
    run_plant,
    side_of,
)

EACH = {"plant.gains": "each", "model.gains": "each"}


def each(**overrides):
    """A scenario whose plant and model have gains of each joint."""
    return quick(**EACH, **overrides)


def with_unequal_gains(name: str) -> Robot:
    """A robot whose true gains differ by some 10 % between the joints."""
    robot = load_robot(name).with_own_gains()
    true = robot.parameter_sets["truth"]
    shares = np.tile(SHARES, (robot.layout.joints // len(SHARES), 1))
    own = ParameterSet(true.dynamic, true.joint_pid * shares.ravel())
    robot.parameter_sets = robot.parameter_sets | {"truth": own}
    return robot


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rss6", pytest.param("ups6", marks=pytest.mark.thorough)])
def test_gains_of_each_joint_are_identified_with_intervals(name):
    """Of a robot that turns and of one that slides, from one record; chi-square of the errors."""
    robot, scenario = with_unequal_gains(name), each()
    true = build_plant(scenario, robot).parameters
    layout = robot.layout
    record, _ = run_plant(scenario, seed=1, robot=robot)
    result = identify(record, robot, scenario)
    assert result.names == layout.names
    assert result.identifiable[layout.joint_pid].all()
    known = slice(layout.coulomb.start, None)
    shares = ((result.estimate - true) / result.std)[known]
    assert np.abs(shares).max() < 4.5
    error = (result.estimate - true)[known]
    squared = error @ np.linalg.solve(result.covariance[known, known], error)
    assert chi2.sf(squared, len(error)) > 1e-4
    assert result.explained
    # the differences between joints are found, and not only those of the robot file
    gains = result.estimate[layout.joint_pid].reshape(-1, 3)
    errors = gains[:, 0] - true[layout.joint_pid].reshape(-1, 3)[:, 0]
    assert np.abs(errors).max() < 0.1 * np.ptp(gains[:, 0])
    later = unseen_errors(result.estimate, robot, scenario.with_overrides({"validation.count": 1}))
    rms = np.sqrt(np.mean(later**2, axis=(0, 1)))
    assert rms[:3].max() < 5e-6
    assert rms[3:].max() < 25e-6


@pytest.mark.thorough
def test_intervals_of_gains_of_each_joint_hold():
    """Share of the 95 % intervals of gains and friction with the truth, over some records."""
    robot, scenario = with_unequal_gains("delta3"), each()
    true = build_plant(scenario, robot).parameters
    known = slice(robot.layout.coulomb.start, None)
    held = []
    for seed in range(12):
        record, _ = run_plant(scenario, seed, robot=robot, trajectory_seed=seed)
        result = identify(record, robot, scenario)
        low, high = result.intervals[known].T
        held.append((low <= true[known]) & (true[known] <= high))
    # 180 intervals, of which those of one record depend on each other
    assert 0.88 <= np.mean(held) <= 1.0


@pytest.mark.slow
def test_the_linear_loop_has_the_sensitivities_of_the_simulated_one(monkeypatch):
    monkeypatch.setattr(any_robot, "quick", each)
    any_robot.test_the_linear_loop_has_the_sensitivities_of_the_simulated_one(
        with_unequal_gains("delta3")
    )


def test_segments_from_the_true_states_make_up_the_run(monkeypatch):
    monkeypatch.setattr(any_robot, "quick", each)
    any_robot.test_segments_from_the_true_states_make_up_the_run(with_unequal_gains("delta3"))


@pytest.mark.parametrize("drive", ["pid", "cascade"])
def test_the_warm_starts_equation_holds_for_the_true_parameters(drive):
    robot = with_unequal_gains("delta3")
    layout = robot.layout
    scenario = each(**{"plant.drive": drive, "model.drive": drive})
    parameters = build_plant(scenario, robot).parameters
    parameters[layout.coulomb] = 0.0
    record, run = run_plant(scenario, 0, np.zeros(6), parameters=parameters, robot=robot)
    model = identified_model(record, side_of(scenario, robot))
    law = model.settings.drives.joint_law(layout.split(parameters)[3])
    columns, slipping = joint_balance(model, run.pose, scenario.filter, law)
    settings = build_plant(scenario, robot).settings
    start = equilibrium(
        robot, parameters, run.pose[0], settings.servo, drives=settings.drives
    ).joint_integral
    balance = columns[slipping] @ np.concatenate([parameters, law.li * start])
    gains = columns[slipping][:, layout.joint_pid] @ parameters[layout.joint_pid]
    assert np.sqrt(np.mean(balance**2)) < 5e-3 * np.sqrt(np.mean(gains**2))


@pytest.mark.slow
def test_a_single_gain_that_differs_is_diagnosed_with_its_size_and_the_setting():
    """Plant apart from the model: a study of a model that shares gains."""
    scenario = quick(**{"plant.gains": "each", "plant.values": {"joint3.lp": 10.8}})
    robot = rss6()
    plant = build_plant(scenario, robot)
    assert plant.robot.layout.own_gains
    assert not plant.nominal.layout.own_gains
    record, _ = run_plant(scenario, seed=3, duration_s=5.0)
    problem = problem_of([record], scenario)
    found = diagnosis_from(problem, plant.parameters_of(robot.layout))
    first = found.findings[0]
    assert first.name == "lp of joint 3, beyond that of joint 1"
    assert first.remedies == ("--set model.gains=each",)
    assert abs(first.sizes[0].value - 0.3) < 3 * first.sizes[0].std
    assert not found.left.significant
    mended = quick(**EACH, **{"plant.values": {"joint3.lp": 10.8}})
    again = diagnosis_from(problem_of([record], mended), plant.parameters)
    assert not again.findings


@pytest.mark.slow
def test_an_estimator_that_knows_the_gains_takes_those_of_each_joint():
    robot, scenario = with_unequal_gains("delta3"), each()
    record, run = run_plant(scenario, 1, robot=robot)
    plant = build_plant(scenario, robot)
    truth = plant.truth(run)
    channels = measure_joints(record, truth, scenario.timing, PERFECT, np.random.default_rng(0))
    assert np.isfinite(channels["joint_torque"].values).all()
    gains = plant.parameters[robot.layout.joint_pid]
    found = known_pid(Evidence(problem_of([record], scenario, robot), known_gains=gains))
    np.testing.assert_allclose(found.parameters[robot.layout.joint_pid], gains, rtol=1e-5)


def test_instruments_see_the_same_torque_of_equal_gains_in_either_form():
    scenario, robot = quick(), rss6()
    record, run = run_plant(scenario, 1, duration_s=2.0)
    shared = build_plant(scenario, robot).truth(run)
    own = build_plant(each(), robot).truth(run)
    assert {"joint_pid.lp"} == {str(name) for name in shared["parameter"].values} - {
        str(name) for name in own["parameter"].values
    } - {"joint_pid.li", "joint_pid.ld"}
    one, other = (
        measure_joints(record, truth, scenario.timing, PERFECT, np.random.default_rng(0))
        for truth in (shared, own)
    )
    np.testing.assert_array_equal(one["joint_torque"].values, other["joint_torque"].values)


def test_the_drives_gains_and_single_values_are_those_of_the_plant():
    gains = {"lp": 9.0, "li": 11.0, "ld": 0.15}
    scenario = each(**{"plant.drive_gains": gains, "plant.values": {"joint3.lp": 11.0}})
    plant = build_plant(scenario, rss6())
    true = plant.parameters[plant.robot.layout.joint_pid].reshape(6, 3)
    np.testing.assert_array_equal(true[:, 0], [9.0, 9.0, 11.0, 9.0, 9.0, 9.0])
    np.testing.assert_array_equal(true[:, 1:], np.tile([11.0, 0.15], (6, 1)))
    shared = plant.parameters_of(rss6().layout)[rss6().layout.joint_pid]
    np.testing.assert_allclose(shared, [56 / 6, 11.0, 0.15], rtol=1e-15)


def test_true_gains_in_another_form():
    known = {"joint1.lp": 1.0, "joint2.lp": 2.0}
    assert known_value(known, "joint_pid.lp") == 1.5
    assert known_value({"joint_pid.lp": 1.0}, "joint7.lp") == 1.0
    friction = {"joint1.coulomb": 1.0, "joint2.coulomb": 1.0, "link2_joint.viscous": 0.5}
    assert known_value(friction, "link_joint.viscous") == 0.25
    assert known_value({"link_joint.viscous": 0.5}, "link2_joint.viscous") == 0.5
    assert known_value({}, "joint_pid.lp") is None
    assert known_value({}, "joint1.coulomb") is None
    assert known_value({}, "platform.mcx") == 0.0
    with pytest.raises(RecordError, match=r"the truth has no joint1\.li"):
        true_values(known, ["joint1.li"])
    assert [name for name in ("joint1.lp", "joint_pid.li", "joint1.coulomb") if is_gain(name)] == [
        "joint1.lp",
        "joint_pid.li",
    ]


def test_the_anchor_of_a_known_gain_measures_that_of_the_first_joint():
    robot = with_unequal_gains("rss6")
    layout, true = robot.layout, robot.parameter_sets["truth"].vector
    assert measured_parameter("joint_gain", layout) == "joint1.lp"
    anchor = measured_anchor("joint_gain", 1e-9, layout, true, np.random.default_rng(0))
    row, value = anchor.row(layout)
    assert np.flatnonzero(row).tolist() == [layout.names.index("joint1.lp")]
    assert value * 1e-9 == pytest.approx(true[layout.joint_pid.start])


def test_a_law_fixes_the_gains_that_it_does_not_read_and_needs_others_above_zero():
    scenario = each(**{"model.drive": "pd", "plant.drive": "pd"})
    side = side_of(scenario)
    guess = model_guess(side.robot, side.model, scenario.identification)
    fixed = [name for name, one in zip(guess.layout.names, guess.fixed, strict=True) if one]
    assert fixed == [f"joint{k}.li" for k in range(1, 7)]
    assert guess.above_zero == ("platform.mass", *(f"joint{k}.lp" for k in range(1, 7)))


def test_the_report_names_the_gain_that_the_anchor_leaves_open():
    entry = {"scale_anchor": "platform_mass", "parameters": {"joint1.lp": {"prior_share": 0.8}}}
    assert "80 % of the variance of joint1.lp" in scale_sentence(entry)


@pytest.mark.thorough
def test_a_run_with_gains_of_each_joint_is_written_and_reported(tmp_path):
    """From the design of trajectories to the report."""
    changes = ["renderer=statistical", "plant.gains=each", "model.gains=each"]
    changes += ['plant.values={ "joint3.lp" = 11.0 }', "excitation.duration_s=5"]
    changes += ["validation.count=1"]
    arguments = [word for change in changes for word in ("--set", change)]
    status = command("run", "quick", "--out", str(tmp_path / "run"), "--quiet", *arguments)
    assert status in (0, 4)
    result = json.loads((tmp_path / "run" / "result.json").read_text(encoding="utf-8"))
    entries = result["identification"]["parameters"]
    assert entries["joint3.lp"]["true"] == 11.0
    assert entries["joint3.lp"]["identifiable"]
    assert "joint_pid.lp" not in entries
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "joint3.lp" in page


def test_the_settings_know_two_forms():
    with pytest.raises(ScenarioError, match=r"model\.gains = 'both'.*'shared' or 'each'"):
        quick(**{"model.gains": "both"})
    with pytest.raises(ScenarioError, match=r"plant\.gains = 'own'.*'shared' or 'each'"):
        quick(**{"plant.gains": "own"})


def test_a_single_gain_is_no_value_of_a_plant_that_shares_gains():
    with pytest.raises(ScenarioError, match=r"names 'joint3\.lp'.* with plant\.gains = 'each'"):
        build_plant(quick(**{"plant.values": {"joint3.lp": 11.0}}), rss6())
    with pytest.raises(ScenarioError, match=r"names 'joint_pid\.lp'.* plant\.gains = 'each'"):
        build_plant(each(**{"plant.values": {"joint_pid.lp": 11.0}}), rss6())


def test_a_prior_of_a_gain_in_the_other_form_is_refused():
    prior = {"joint3.lp": {"value": 10.0, "std": 0.1}}
    asked = quick(**{"identification.prior": prior})
    with pytest.raises(ScenarioError, match=r"joint3\.lp is no gain of the model.*joint_pid\.lp"):
        model_guess(rss6(), asked.model, asked.identification)
    side = side_of(each(**{"identification.prior": prior}))
    guess = model_guess(
        side.robot, side.model, each(**{"identification.prior": prior}).identification
    )
    assert guess.std[guess.layout.names.index("joint3.lp")] == 0.1
    prior = {"joint_pid.lp": {"value": 10.0, "std": 0.1}}
    with pytest.raises(ScenarioError, match=r"joint_pid\.lp is no gain of the model.*joint1\.lp"):
        model_guess(side.robot, side.model, each(**{"identification.prior": prior}).identification)


def test_unequal_gains_of_a_robot_file_are_not_shared_without_a_word(tmp_path):
    """One set has unequal gains: a side that uses the other set can share its gains."""
    old = "joint_pid = { lp = 10.5, li = 11.4, ld = 0.164 }"
    new = "joint_pid = { lp = [10.5, 10.5, 11.0, 10.5, 10.5, 10.5], li = 11.4, ld = 0.164 }"
    robot = load_robot(changed_robot_file(tmp_path / "unequal.toml", old, new))
    assert not in_form(robot, quick().model).layout.own_gains
    words = r"plant\.gains = 'shared', but the parameter set 'truth' .*joint3\.lp = 11:"
    with pytest.raises(ScenarioError, match=words):
        build_plant(quick(), robot)
    plant = build_plant(quick(**{"plant.gains": "each"}), robot)
    true = dict(zip(plant.robot.layout.names, plant.parameters, strict=True))
    assert (true["joint2.lp"], true["joint3.lp"]) == (10.5, 11.0)


def test_torque_commands_have_no_gains():
    plant = build_plant(each(), rss6())
    reference = any_robot.trajectory(0).reference(np.arange(30) / 60)
    law = LawInLoop(controller=lambda *seen: np.zeros(6), drives=Drives(torques=True))
    with pytest.raises(ScenarioError, match=r"plant\.gains = 'each', but .* take torques"):
        plant.run(reference, law=law)
    record, _ = run_plant(quick(), 1)
    record.attrs["torque_commands"] = 1
    with pytest.raises(EstimationError, match=r"model\.gains = 'each', but .* are torques"):
        identified_model(record, side_of(each()))


def test_the_command_refuses_a_wrong_form_in_one_line(capsys, tmp_path):
    arguments = ("--set", 'plant.values={ "joint3.lp" = 11 }', "--out", str(tmp_path / "run"))
    assert command("run", "quick", *arguments) != 0
    assert "joint3.lp" in one_line(capsys.readouterr().err)
    assert not (tmp_path / "run").exists() or not list((tmp_path / "run").iterdir())
