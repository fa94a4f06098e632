"""What a result was made of: files that are others are refused by each stage that reads both, before any work."""

import numpy as np
import pytest

from identify import pipeline
from identify.errors import OutputFolderError, RecordError
from identify.experiment.truth import read_truth
from identify.files.dataset import write_covariance
from identify.files.run_folder import load_result, save_result
from identify.loop_parameters import NAMES
from identify.progress import SilentProgress
from identify.record.provenance import ENTRY, RunFiles, array_digest, digest
from identify.record.recording import EXCITATION, read, read_model_runs, read_runs, write, write_model_runs, write_runs
from identify.reporting.report import read_report_data, write_report
from identify.reporting.run_result import parameter_vector
from tests.identify.commands import command, one_line
from tests.identify.synthetic import SHORT, short_run, truth

READ_BY_REPORT = ("experiment.nc", "covariance.nc", "validation.nc", "model.nc")


def moved(record):
    """One measured coordinate of one frame is a nanometre elsewhere."""
    position = record["measured_position"].copy(deep=True)
    position[17, 1] += 1e-9
    return record.assign(measured_position=position)


@pytest.fixture(scope="module")
def record():
    return short_run()[0]


def test_arrays_are_told_apart_by_name_shape_and_number_alone():
    values, more = np.array([[1.0, np.nan], [3.0, 4.0]]), np.zeros(2)
    known = array_digest({"a": values, "b": more})
    assert array_digest({"b": more.astype(np.int8), "a": np.asfortranarray(values)}) == known
    for other in (values.ravel(), values.T, np.nextafter(values, 9)):
        assert array_digest({"a": other, "b": more}) != known
    for others in ({"a": values}, {"a": values, "c": more}):
        assert array_digest(others) != known


def test_a_record_is_the_same_wherever_it_was_written_and_another_by_whatever_an_identification_reads(record, tmp_path):
    """Nor does it matter which estimator its scenario named: the record was made without."""
    driven, stiffer = ({"identification.method": "command_driven"}, {"servo.kp": 0.31})
    scenarios = [SHORT.with_overrides(settings).to_toml() for settings in (driven, stiffer)]
    later = record.assign_attrs(created="later", record_seconds=3.0, title="mine", scenario=scenarios[0])
    write(tmp_path / "one.nc", record)
    write(tmp_path / "two.nc", later)
    (known,) = {digest(one) for one in (record, later, read(tmp_path / "one.nc"), read(tmp_path / "two.nc"))}
    others = [{"scale_anchor_value": 23.6}, {"payload_mass": 8.0}, {"seed": 2}, {"scenario": scenarios[1]}]
    changed = [record.assign_attrs(attributes) for attributes in others]
    for another in (*changed, moved(record), record.assign(command=record["command"] + 1e-9)):
        assert digest(another) != known


def other_experiment(run):
    write(run.experiment, moved(read(run.experiment)), read_truth(run.experiment))


def other_validation(run):
    first, *more = read_runs(run.validation)
    write_runs(run.validation, [(one, read_truth(run.experiment)) for one in (moved(first), *more)])


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


@pytest.mark.slow
def test_a_report_takes_the_results_own_files_and_refuses_others_and_an_estimate_outside_its_interval(run_folder):
    bare = load_result(run_folder.result)
    made_of = RunFiles(run_folder).digests(*READ_BY_REPORT)
    save_result(run_folder.result, bare | {ENTRY: made_of})
    assert len(read_report_data(run_folder).validation) == 2
    for replace, file, says, stage in OTHERS:
        replace(run_folder)
        save_result(run_folder.result, bare | {ENTRY: {file: made_of[file]}})
        with pytest.raises(RecordError, match=f"json is {says}: run `cmmsim {stage} --out {run_folder.path}` again"):
            write_report(run_folder.path)
        assert not run_folder.report.exists()
    save_result(run_folder.result, bare | {ENTRY: {"payload.nc": "of a second run"}})
    with pytest.raises(OutputFolderError, match=r"no payload\.nc; write it with: cmmsim record"):
        write_report(run_folder.path)
    save_result(run_folder.result, bare)
    read_report_data(run_folder)  # a result that states no digest asks nothing
    bare["identification"]["parameters"]["joint1.coulomb"]["estimate"] = -5
    save_result(run_folder.result, bare)
    with pytest.raises(RecordError, match=r"json: the estimate -5 of joint1.coulomb is outside its interval 0.103"):
        write_report(run_folder.path)


def identified(run):
    """The result as `identify` leaves it, with the true parameters."""
    values = dict(zip(NAMES, truth(), strict=True))
    parameters = {name: {"initial": value, "estimate": value} for name, value in values.items()}
    write_covariance(run.covariance, NAMES, np.eye(len(NAMES)))
    made_of = RunFiles(run).digests("experiment.nc", "covariance.nc")
    result = {"seconds": {}, "before": {}, "after": {}, "identification": {"parameters": parameters}, ENTRY: made_of}
    save_result(run.result, result)
    return result


def test_identification_states_what_it_read_and_wrote(recorded_folder, record):
    pipeline.identify(recorded_folder.path, SilentProgress())
    made_of = load_result(recorded_folder.result)[ENTRY]
    assert made_of == RunFiles(recorded_folder).digests("experiment.nc", "covariance.nc")
    assert made_of["experiment.nc"] == digest(record)


def refused(run, name, capsys):
    """The one line by which a stage refuses a run; it writes nothing."""
    before = sorted(run.path.iterdir()), run.result.read_bytes()
    assert command(name, "--out", run.path) == 1
    assert (sorted(run.path.iterdir()), run.result.read_bytes()) == before
    return one_line(capsys.readouterr().err)


@pytest.mark.parametrize("replace", [other_experiment, other_covariance])
def test_what_reads_a_run_anew_refuses_files_of_two_origins(recorded_folder, record, replace, capsys):
    run = recorded_folder
    identified(run)
    replace(run)
    assert f"run `cmmsim identify --out {run.path}` again" in refused(run, "validate", capsys)
    write_runs(run.validation, [(record, read_truth(run.experiment))] * 3)
    for name, of, stage in (
        ("estimators", "experiment.nc", "identify"),
        ("estimators", "validation.nc", "validate"),
        ("variation", "validation.nc", "validate"),
    ):
        save_result(run.result, {ENTRY: {of: "of a run before"}})
        assert f"{of}: run `cmmsim {stage} --out {run.path}` again" in refused(run, name, capsys)


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda r: r.clear(), "lacks identification, before, after, seconds; write it with: cmmsim identify"),
        (lambda r: r["identification"]["parameters"].pop("link3.mass"), "there is no initial of link3.mass"),
        (lambda r: r.update(made_of=7), "made_of must be digests"),
    ],
    ids=["empty", "parameter gone", "no digests"],
)
def test_validation_refuses_a_result_that_is_none_in_one_line(recorded_folder, spoil, says, capsys):
    result = identified(recorded_folder)
    spoil(result)
    save_result(recorded_folder.result, result)
    error = refused(recorded_folder, "validate", capsys)
    assert says in error
    assert str(recorded_folder.result) in error


def test_parameters_of_a_result_that_no_model_has_are_named():
    entries = {known: {"estimate": one} for known, one in zip(NAMES, truth(), strict=True)}
    np.testing.assert_array_equal(parameter_vector({"parameters": entries}, "estimate"), truth())
    for name, value, says in (
        ("link3.mass", "1 kg", 'estimate of link3.mass is "1 kg", must be a finite number'),
        ("platform.mass", -5, "estimate: platform.mass = -5 kg is not allowed"),
        ("joint_pid.li", 0, "estimate: joint_pid.li"),
    ):
        with pytest.raises(RecordError, match=says):
            parameter_vector({"parameters": entries | {name: {"estimate": value}}}, "estimate")
    with pytest.raises(RecordError, match=r"no identification\.parameters"):
        parameter_vector([], "estimate")
