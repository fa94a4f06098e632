"""The door from Python: what a person types in a notebook, against the rooms behind it."""

import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import identify
from identify.errors import (
    EstimationError,
    RecordError,
    ScenarioError,
    StudyError,
    StudyInterrupted,
)
from identify.estimation.identification import asked_of
from identify.experiment.truth import read_truth, true_parameters
from identify.progress import SilentProgress
from identify.random_streams import integer_seed
from identify.record.provenance import digest
from identify.studies.runner import run_study
from identify.studies.study_file import Study as StudyFile

SHORT = {"renderer": "statistical", "excitation": {"duration_s": 5.0, "candidates": 2}}
DARK = "sensor.camera.dark_noise"


@pytest.fixture(scope="module")
def setup():
    return identify.set_up(identify.load_scenario("quick", **SHORT), seed=3)


@pytest.fixture(scope="module")
def record(setup, tmp_path_factory):
    return setup.run(path=tmp_path_factory.mktemp("records") / "mine.nc")


@pytest.fixture(scope="module")
def result(record):
    return identify.identify(record)


@pytest.mark.slow
def test_a_setup_runs_the_experiment_that_one_call_does_and_runs_it_again(setup, record, tmp_path):
    setup.sensor.measure(setup.robot.home_pose)  # moves no stream of the run's noise
    for other in (setup.run(path=tmp_path / "a.nc"), identify.run_experiment(
        identify.load_scenario("quick", **SHORT), seed=3, path=tmp_path / "b.nc"
    )):  # fmt: skip
        for name in record.data_vars:
            np.testing.assert_array_equal(other[name].values, record[name].values)


def test_cameras_with_a_covariance_that_are_taken_as_exact_are_warned_of(tmp_path):
    path = tmp_path / "mine.toml"
    matrix = np.diag(np.full(24, 1e-8)).tolist()
    text = f'name = "mine"\nbased_on = "ctrack780"\n[rig.covariance]\nmatrix = {matrix}\n'
    path.write_text(text)
    scenario = identify.load_scenario("quick", sensor=str(path))
    with pytest.warns(UserWarning, match=r"covariance of its cameras, and rig\.known = exact"):
        _ = identify.set_up(scenario).sensor_plan
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _ = identify.set_up(scenario.with_overrides({"rig.known": "photographs"})).sensor_plan


def test_a_record_finds_its_own_truth_and_no_other(setup, record, tmp_path):
    xr.testing.assert_identical(record.truth, read_truth(record.attrs["path"]))
    moved = record.assign(command=record["command"] + 1e-9)
    with pytest.raises(RecordError, match=r"now holds another record"):
        moved.truth  # noqa: B018
    nowhere = record.drop_attrs() if hasattr(record, "drop_attrs") else record.copy()
    nowhere.attrs = {}
    with pytest.raises(RecordError, match=r"has no attribute path"):
        nowhere.truth  # noqa: B018
    opened = xr.open_dataset(path := record.attrs["path"])
    with pytest.raises(RecordError, match=rf'open_dataset\("{path}", group="truth"\)'):
        opened.truth  # noqa: B018


def test_identify_reads_a_record_from_the_path_of_its_file(record):
    for given in (record.attrs["path"], [Path(record.attrs["path"])]):
        assert digest(asked_of(given, None, None).records[0]) == digest(record)
    with pytest.raises(EstimationError, match="3 is neither a record"):
        identify.identify([3])
    with pytest.raises(RecordError, match=r"there is no file nowhere\.nc"):
        identify.identify("nowhere.nc")


@pytest.mark.slow
def test_identify_takes_robot_and_scenario_from_the_record(setup, record, result):
    given = identify.identify(record, setup.robot, setup.scenario)
    np.testing.assert_array_equal(given.estimate, result.estimate)
    np.testing.assert_array_equal(given.covariance, result.covariance)
    with pytest.raises(EstimationError, match="no record"):
        identify.identify([])


def test_a_table_says_which_intervals_hold_the_truth(record, result):
    table = result.table(truth=record.truth)
    true = true_parameters(record.truth)
    assert table["true"].to_dict() == true
    inside = [low <= true[name] <= high for name, low, high in table[["low", "high"]].itertuples()]
    assert table["holds"].tolist() == inside
    pd.testing.assert_frame_equal(result.table(truth=true), table)
    assert "true" not in result.table()
    del true["platform.Ixx"]
    with pytest.raises(EstimationError, match=r"the truth has no platform\.Ixx"):
        result.table(truth=true)


def test_the_identified_robot_moves_by_the_estimate(setup, result):
    robot = result.robot
    gains = len(robot.parameter_names)
    np.testing.assert_array_equal(robot.nominal_parameters, result.estimate[:gains])
    pose, rest = setup.robot.home_pose, np.zeros(6)
    torque = setup.robot.inverse_dynamics(pose, rest, rest, result.estimate[:gains])
    np.testing.assert_array_equal(robot.inverse_dynamics(pose, rest, rest), torque)
    model = result.model()
    np.testing.assert_array_equal(model.tau(pose, rest, rest), torque)
    np.testing.assert_array_equal(
        setup.robot.inverse_dynamics(pose, rest, rest, result.estimate), torque
    )
    still = np.zeros(robot.layout.joints)
    np.testing.assert_allclose(model.tau_of_joints(still, still, still), torque, atol=1e-6)
    assert "identified" in robot.parameter_sets
    with pytest.warns(UserWarning, match="changed platform"):
        assert "identified parameters" in model.mjcf(allow_unphysical_inertia=True)
    with pytest.warns(UserWarning, match="changed platform"):
        assert "closed_loop" in model.urdf(allow_unphysical_inertia=True)[1]


def test_unseen_errors_are_those_of_the_parameters(setup, result):
    errors = setup.unseen_errors(result)
    poses = identify.unseen_errors(result.estimate, setup.robot, setup.scenario, seed=3)
    np.testing.assert_array_equal(errors.poses, poses)
    assert errors.rms()["beta_urad"] == pytest.approx(1e6 * np.sqrt((poses[..., 4] ** 2).mean()))
    with pytest.raises(EstimationError, match=r"as identify\.identify.* got ndarray"):
        setup.unseen_errors(result.estimate)


def test_a_notebook_shows_warnings_a_picture_and_a_table(result):
    shown = result._repr_html_()
    assert "data:image/png;base64," in shown
    assert shown.count("<tr") == 1 + 1 + int(result.identifiable.sum())
    identified = np.array(result.names)[result.identifiable]
    assert all(name in shown for name in identified)


def test_a_study_in_python_has_the_rows_of_the_same_file(tmp_path):
    scenario = identify.load_scenario("quick", **SHORT)
    levels = [13.0, 26.0]
    study = identify.Study(scenario, kind="static_pose", vary={DARK: levels}, repeats=2, seed=5)
    frame = study.run(workers=0)
    path = tmp_path / "mine.toml"
    path.write_text(scenario.to_toml(), encoding="utf-8")
    file = StudyFile(
        name="mine",
        kind="static_pose",
        scenario=str(path),
        factors={DARK: levels},
        repeats=2,
        seed=5,
    )
    whole = run_study(file, tmp_path / "study", SilentProgress()).frame
    pd.testing.assert_frame_equal(frame, whole[frame.columns], check_exact=True)
    assert frame.groupby(DARK).mean().index.tolist() == levels
    with pytest.raises(StudyError, match="unknown key"):
        identify.Study(scenario, vary={"sensr.x": [1.0]}).run(workers=0)
    with pytest.raises(StudyError, match=r"mine\.toml is a file; name another with folder=$"):
        study.run(workers=0, folder=path)


def test_a_study_in_python_that_is_stopped_says_whether_its_rows_are_kept(tmp_path):
    class Stop(SilentProgress):
        def stage(self, name, total):
            raise KeyboardInterrupt

    scenario = identify.load_scenario("quick", **SHORT)
    study = identify.Study(scenario, kind="static_pose", vary={DARK: [13.0]})
    kept = {None: "done, and lost without folder=", tmp_path / "a": "done and stored"}
    for folder, says in kept.items():
        with pytest.raises(StudyInterrupted, match=f"0 of 1 rows are {says}$"):
            study.run(workers=0, folder=folder, progress=Stop())


def test_entries_and_seeds_of_other_kinds_are_taken_or_refused_in_one_line():
    found = identify.load_scenario("quick", timing={"latency_s": 0.01}, pose_method="planes")
    assert (found.timing.latency_s, found.pose_method) == (0.01, "planes")
    with pytest.raises(ScenarioError, match="latencys"):
        identify.load_scenario("quick", timing={"latencys": 0.01})
    with pytest.raises(ScenarioError, match=r"not a scenario: identify\.load_scenario"):
        identify.set_up("quick")
    sequence = np.random.SeedSequence(7, spawn_key=(2,))
    made = identify.set_up(identify.load_scenario("quick", **SHORT), seed=sequence)
    assert made.seed == integer_seed(sequence) == int(sequence.generate_state(1)[0])
