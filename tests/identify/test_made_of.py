"""Files of a run that are not those its result was made of: refused by each stage that reads both, before any work."""

import numpy as np
import pytest

from identify import pipeline
from identify.errors import OutputFolderError, RecordError
from identify.experiment.truth import build_truth, read_truth
from identify.files.dataset import write_covariance
from identify.files.run_folder import RunFolder, load_result, save_result
from identify.loop_parameters import NAMES
from identify.progress import SilentProgress
from identify.record.provenance import ENTRY, array_digest, file_digests, record_digest
from identify.record.recording import EXCITATION, read, read_model_runs, read_runs, write, write_model_runs, write_runs
from identify.reporting.report import read_report_data, write_report
from identify.trajectory import TrajectorySet, save_trajectories
from tests.identify.commands import command, one_line
from tests.identify.synthetic import quick, run_plant, trajectory, truth

SCENARIO = quick(**{"excitation.duration_s": 2.0, "identification.max_iterations": 1})
READ_BY_REPORT = ("experiment.nc", "covariance.nc", "validation.nc", "model.nc")


def moved(record):
    """One measured coordinate of one frame is a nanometre elsewhere."""
    position = record["measured_position"].copy(deep=True)
    position[17, 1] += 1e-9
    return record.assign(measured_position=position)


@pytest.fixture(scope="module")
def record():
    return run_plant(SCENARIO, seed=1, duration_s=2.0, lost=(5,))[0]


def test_arrays_are_told_apart_by_name_shape_and_number_alone():
    values = np.array([[1.0, np.nan], [3.0, 4.0]])
    known = array_digest({"a": values, "b": np.zeros(2)})
    assert array_digest({"b": np.zeros(2, dtype=np.int8), "a": np.asfortranarray(values)}) == known
    for other in (
        {"a": values},
        {"a": values, "c": np.zeros(2)},
        {"a": values.ravel(), "b": np.zeros(2)},
        {"a": np.nextafter(values, 9), "b": np.zeros(2)},
        {"a": values.T, "b": np.zeros(2)},
    ):
        assert array_digest(other) != known


def test_a_record_is_the_same_wherever_and_whenever_it_was_written(record, tmp_path):
    """Nor does it matter which estimator its scenario named: the record was made without."""
    write(tmp_path / "one.nc", record)
    later = record.assign_attrs(
        created="later",
        record_seconds=3.0,
        title="mine",
        scenario=SCENARIO.with_overrides({"identification.method": "command_driven"}).to_toml(),
    )
    write(tmp_path / "two.nc", later)
    known = {record_digest(one) for one in (record, later, read(tmp_path / "one.nc"), read(tmp_path / "two.nc"))}
    assert len(known) == 1


@pytest.mark.parametrize(
    "change",
    [
        moved,
        lambda r: r.assign(command=r["command"] + 1e-9),
        lambda r: r.assign_attrs(scale_anchor_value=23.6),
        lambda r: r.assign_attrs(payload_mass=8.0),
        lambda r: r.assign_attrs(seed=2),
        lambda r: r.assign_attrs(scenario=SCENARIO.with_overrides({"servo.kp": 0.31}).to_toml()),
    ],
    ids=["pose", "command", "anchor", "load", "seed", "servo"],
)
def test_whatever_an_identification_reads_makes_it_another_record(record, change):
    assert record_digest(change(record)) != record_digest(record)


def other_experiment(run):
    write(run.experiment, moved(read(run.experiment)), read_truth(run.experiment))


def other_validation(run):
    first, *more = read_runs(run.validation)
    truth = read_truth(run.experiment)
    write_runs(run.validation, [(one, truth) for one in (moved(first), *more)])


def other_model(run):
    runs = dict(read_model_runs(run.model))
    excitation = runs.pop(EXCITATION)
    write_model_runs(run.model, excitation + 1e-9, list(runs.values()))


def other_covariance(run):
    write_covariance(run.covariance, NAMES, 2 * np.eye(len(NAMES)))


OTHERS = [
    (other_experiment, "experiment.nc", "of another record than experiment.nc", "identify"),
    (other_covariance, "covariance.nc", "of another covariance.nc", "identify"),
    (other_validation, "validation.nc", "of another validation.nc", "validate"),
    (other_model, "model.nc", "of another model.nc", "validate"),
]


def stating(run, *names):
    """The folder, with digests of these of its files in its result."""
    save_result(run.result, load_result(run.result) | {ENTRY: file_digests(run, *names)})
    return run


@pytest.mark.parametrize(("replace", "file", "says", "stage"), OTHERS, ids=[file for _, file, _, _ in OTHERS])
def test_a_report_refuses_a_file_that_is_not_the_results(run_folder, replace, file, says, stage):
    replace(stating(run_folder, file))
    with pytest.raises(RecordError, match=f"json is {says}: run `cmmsim {stage} --out {run_folder.path}` again"):
        write_report(run_folder.path)
    assert not run_folder.report.exists()


def test_a_report_takes_the_results_own_files(run_folder):
    assert len(read_report_data(stating(run_folder, *READ_BY_REPORT)).validation) == 2


def test_of_a_result_that_states_no_digest_nothing_is_asked(run_folder):
    assert ENTRY not in load_result(run_folder.result)
    other_experiment(run_folder)
    read_report_data(run_folder)


def test_a_record_that_is_gone_is_named_with_the_stage_that_writes_it(run_folder):
    save_result(run_folder.result, load_result(run_folder.result) | {ENTRY: {"payload.nc": "of a second run"}})
    with pytest.raises(OutputFolderError, match=r"no payload\.nc; write it with: cmmsim record"):
        write_report(run_folder.path)


def truth_as_long_as(record):
    """Of the record's length; nothing here reads its numbers."""
    count = record.sizes["time"]
    joints = {name: np.zeros((count, 6)) for name in ("joint_angle", "joint_velocity", "joint_torque")}
    return build_truth(
        time=record["time"].values, pose=np.zeros((count, 6)), parameter_names=list(NAMES), parameters=truth(), **joints
    )


@pytest.fixture
def run(tmp_path, record):
    """A folder as `cmmsim record` leaves it."""
    folder = RunFolder(tmp_path)
    folder.scenario.write_text(SCENARIO.to_toml(), encoding="utf-8")
    save_trajectories(folder.trajectories, TrajectorySet(0, trajectory(0), (trajectory(5),), 1.0, 1.0, 1.0))
    write(folder.experiment, record, truth_as_long_as(record))
    return folder


def identified(run, **estimates):
    """The result as `identify` leaves it, with these estimates instead of the true parameters."""
    parameters = {
        name: {"initial": value, "estimate": estimates.get(name, value)}
        for name, value in zip(NAMES, truth(), strict=True)
    }
    write_covariance(run.covariance, NAMES, np.eye(len(NAMES)))
    made_of = file_digests(run, "experiment.nc", "covariance.nc")
    save_result(
        run.result,
        {"seconds": {}, "before": {}, "after": {}, "identification": {"parameters": parameters}, ENTRY: made_of},
    )


def test_identification_states_what_it_read_and_wrote(run, record):
    pipeline.identify(run.path, SilentProgress())
    made_of = load_result(run.result)[ENTRY]
    assert made_of == file_digests(run, "experiment.nc", "covariance.nc")
    assert made_of["experiment.nc"] == record_digest(record)


@pytest.mark.parametrize("replace", [other_experiment, other_covariance])
def test_validation_refuses_another_record_and_writes_nothing(run, replace, capsys):
    identified(run)
    replace(run)
    before = run.result.read_text(encoding="utf-8")
    assert command("validate", "--out", run.path) == 1
    assert f"run `cmmsim identify --out {run.path}` again" in one_line(capsys.readouterr().err)
    assert run.result.read_text(encoding="utf-8") == before
    assert not run.validation.exists()


@pytest.mark.parametrize("of", ["experiment.nc", "validation.nc"])
def test_estimators_are_not_compared_on_files_of_two_origins(run, record, of, capsys):
    write_runs(run.validation, [(record, truth_as_long_as(record))])
    save_result(run.result, {ENTRY: {of: "of a run before"}})
    assert command("estimators", "--out", run.path) == 1
    assert of in one_line(capsys.readouterr().err)
    assert not (run.path / "instruments.nc").exists()


def test_unseen_runs_that_were_replaced_show_no_variation(run, record, capsys):
    write_runs(run.validation, [(record, None)] * 3)
    save_result(run.result, {ENTRY: {"validation.nc": "of a run before"}})
    assert command("variation", "--out", run.path) == 1
    assert f"run `cmmsim validate --out {run.path}` again" in one_line(capsys.readouterr().err)


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda r: r.clear(), "lacks identification, before, after, seconds; write it with: cmmsim identify"),
        (lambda r: r.update(identification=[]), "identification has no parameters"),
        (lambda r: r["identification"]["parameters"].pop("link3.mass"), "initial of link3.mass is null, must be"),
        (
            lambda r: r["identification"]["parameters"]["link3.mass"].update(estimate=None),
            "estimate of link3.mass is null, must be a number",
        ),
        (
            lambda r: r["identification"]["parameters"]["link3.mass"].update(estimate="1 kg"),
            'estimate of link3.mass is "1 kg", must be a number',
        ),
        (
            lambda r: r["identification"]["parameters"]["platform.mass"].update(estimate=-5),
            "estimate: platform.mass = -5 kg is not allowed",
        ),
        (lambda r: r["identification"]["parameters"]["joint_pid.li"].update(initial=0), "initial: joint_pid.li"),
        (lambda r: r.update(made_of=7), "made_of must be digests"),
    ],
    ids=["empty", "list", "parameter gone", "null", "text", "negative mass", "no integral gain", "no digests"],
)
def test_validation_refuses_a_result_that_is_none_in_one_line(run, spoil, says, capsys):
    identified(run)
    result = load_result(run.result)
    spoil(result)
    save_result(run.result, result)
    assert command("validate", "--out", run.path) == 1
    error = one_line(capsys.readouterr().err)
    assert says in error
    assert str(run.result) in error
    assert not run.validation.exists()


def test_a_report_refuses_an_estimate_outside_its_own_interval(run_folder):
    result = load_result(run_folder.result)
    result["identification"]["parameters"]["joint1.coulomb"]["estimate"] = -5
    save_result(run_folder.result, result)
    with pytest.raises(RecordError, match=r"json: the estimate -5 of joint1.coulomb is outside its interval 0.103"):
        write_report(run_folder.path)
