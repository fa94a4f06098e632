"""What a result was made of: files that are others are refused by each stage that reads both,
before any work.
"""

import numpy as np
import pytest

from identify import pipeline
from identify.errors import OutputFolderError, RecordError
from identify.experiment.truth import read_truth
from identify.files.run_folder import load_result, save_result
from identify.progress import SilentProgress
from identify.record.model_runs import EXCITATION, read_model_runs
from identify.record.provenance import ENTRY, RunFiles, array_digest, digest
from identify.record.recording import read, read_runs, write
from identify.reporting.report import write_report
from identify.reporting.run_data import read_run
from identify.reporting.run_result import parameter_vector
from tests.identify.commands import command, one_line
from tests.identify.run_files import write_covariance, write_model_runs, write_runs
from tests.identify.synthetic import LAYOUT, NAMES, SHORT, rss6, short_run, truth


def moved(record):
    """One measured coordinate of one frame is a nanometre elsewhere."""
    position = record["measured_position"].copy(deep=True)
    position[17, 1] += 1e-9
    return record.assign(measured_position=position)


def test_arrays_are_told_apart_by_name_shape_and_number_alone():
    values, more = np.array([[1.0, np.nan], [3.0, 4.0]]), np.zeros(2)
    known = array_digest({"a": values, "b": more})
    assert array_digest({"b": more.astype(np.int8), "a": np.asfortranarray(values)}) == known
    for other in (values.ravel(), values.T, np.nextafter(values, 9)):
        assert array_digest({"a": other, "b": more}) != known
    for others in ({"a": values}, {"a": values, "c": more}):
        assert array_digest(others) != known


def test_a_record_is_the_same_wherever_it_was_written_and_another_by_whatever_an_identification_reads(
    tmp_path,
):
    """Nor does it matter which estimator its scenario named: the record was made without."""
    record, _ = short_run()
    driven, stiffer = ({"identification.method": "command_driven"}, {"servo.kp": 0.31})
    scenarios = [SHORT.with_overrides(settings).to_toml() for settings in (driven, stiffer)]
    later = record.assign_attrs(
        created="later", record_seconds=3.0, title="mine", scenario=scenarios[0]
    )
    write(tmp_path / "one.nc", record)
    write(tmp_path / "two.nc", later)
    (known,) = {
        digest(one) for one in (record, later, read(tmp_path / "one.nc"), read(tmp_path / "two.nc"))
    }
    others = [
        {"scale_anchor_value": 23.6},
        {"payload_mass": 8.0},
        {"seed": 2},
        {"scenario": scenarios[1]},
    ]
    changed = [record.assign_attrs(attributes) for attributes in others]
    for another in (*changed, moved(record), record.assign(command=record["command"] + 1e-9)):
        assert digest(another) != known


def other_experiment(run):
    write(run.experiment, moved(read(run.experiment)), read_truth(run.experiment))


def other_covariance(run):
    write_covariance(run.covariance, LAYOUT, 2 * np.eye(len(NAMES)))


def other_validation(run):
    first, *more = read_runs(run.validation)
    write_runs(run.validation, [(one, read_truth(run.experiment)) for one in (moved(first), *more)])


def other_model(run):
    runs = dict(read_model_runs(run.model))
    excitation = runs.pop(EXCITATION)
    write_model_runs(run.model, excitation + 1e-9, list(runs.values()))


@pytest.mark.slow
def test_a_report_takes_the_results_own_files_and_refuses_others_and_an_estimate_outside_its_interval(
    run_folder,
):
    bare = load_result(run_folder.result)
    made_of = RunFiles(run_folder).digests(
        "experiment.nc", "covariance.nc", "validation.nc", "model.nc"
    )
    save_result(run_folder.result, bare | {ENTRY: made_of})
    assert len(read_run(run_folder).validation) == 2
    for replace, file, says, stage in (
        (other_experiment, "experiment.nc", "of another record than experiment.nc", "identify"),
        (other_covariance, "covariance.nc", "of another covariance.nc", "identify"),
        (other_validation, "validation.nc", "of another validation.nc", "validate"),
        (other_model, "model.nc", "of another model.nc", "validate"),
    ):
        replace(run_folder)
        save_result(run_folder.result, bare | {ENTRY: {file: made_of[file]}})
        with pytest.raises(
            RecordError, match=f"json is {says}: run `cmmsim {stage} --out {run_folder.path}` again"
        ):
            write_report(run_folder.path)
        assert not run_folder.report.exists()
    save_result(run_folder.result, bare | {ENTRY: {"payload.nc": "of a second run"}})
    with pytest.raises(OutputFolderError, match=r"no payload\.nc; write it with: cmmsim record"):
        write_report(run_folder.path)
    save_result(run_folder.result, bare)
    read_run(run_folder)  # a result that states no digest asks nothing
    bare["identification"]["parameters"]["joint1.coulomb"]["estimate"] = -5
    save_result(run_folder.result, bare)
    with pytest.raises(
        RecordError, match=r"json: the estimate -5 of joint1.coulomb is outside its interval 0.103"
    ):
        write_report(run_folder.path)


@pytest.mark.slow
def test_identification_states_what_it_read_and_wrote(recorded_folder):
    pipeline.identify(recorded_folder.path, SilentProgress())
    made_of = load_result(recorded_folder.result)[ENTRY]
    assert made_of == RunFiles(recorded_folder).digests("experiment.nc", "covariance.nc")
    assert made_of["experiment.nc"] == digest(short_run()[0])


def entries(**changes):
    """The true parameters as an identification has them, but for some; None: it lacks this one."""
    values = dict(zip(NAMES, truth(), strict=True)) | {
        name.replace("__", "."): one for name, one in changes.items()
    }
    return {
        "parameters": {
            name: {"initial": value, "estimate": value} for name, value in values.items()
        }
    }


@pytest.mark.thorough
def test_what_reads_a_run_anew_refuses_in_one_line_files_of_another_and_a_result_that_is_none(
    recorded_folder, capsys
):
    """And writes nothing."""
    run = recorded_folder
    write_covariance(run.covariance, LAYOUT, np.eye(len(NAMES)))
    write_runs(run.validation, [(short_run()[0], read_truth(run.experiment))] * 3)
    whole = {"seconds": {}, "before": {}, "after": {}, "identification": entries()}
    made_of = (
        ("validate", "experiment.nc", "identify"),
        ("validate", "covariance.nc", "identify"),
        ("estimators", "experiment.nc", "identify"),
        ("estimators", "validation.nc", "validate"),
        ("variation", "validation.nc", "validate"),
    )
    for reader, result, says in (
        *(
            (reader, whole | {ENTRY: {of: ""}}, f"{of}: run `cmmsim {stage} --out")
            for reader, of, stage in made_of
        ),
        (
            "validate",
            whole | {"identification": entries(link3__mass=None)},
            "there is no initial of link3.mass",
        ),
        (
            "validate",
            {},
            "lacks identification, before, after, seconds; write it with: cmmsim identify",
        ),
        ("validate", whole | {ENTRY: 7}, "made_of must be digests"),
    ):
        save_result(run.result, result)
        before = sorted(run.path.iterdir()), run.result.read_bytes()
        assert command(reader, "--out", run.path) == 1
        assert (sorted(run.path.iterdir()), run.result.read_bytes()) == before
        error = one_line(capsys.readouterr().err)
        assert says in error
        assert str(run.result) in error


def test_parameters_of_a_result_that_no_model_has_are_named():
    np.testing.assert_array_equal(parameter_vector(rss6(), entries(), "estimate"), truth())
    for identification, says in (
        (entries(link3__mass="1 kg"), 'estimate of link3.mass is "1 kg", must be a finite number'),
        (entries(link3__mass=True), "estimate of link3.mass is true, must be a finite number"),
        (
            entries(link3__mass=float("nan")),
            "estimate of link3.mass is NaN, must be a finite number",
        ),
        (entries(link3__mass=10**400), "estimate of link3.mass is 10{59}, must be"),
        (entries(platform__mass=-5), "estimate: platform.mass = -5 kg is not allowed"),
        (entries(joint_pid__li=0), "estimate: joint_pid.li"),
        (
            {"parameters": {}},
            "no estimate of platform.mass, platform.Ixx, platform.Iyy and 64 more",
        ),
        ({"parameters": []}, r"no identification\.parameters"),
    ):
        with pytest.raises(RecordError, match=says):
            parameter_vector(rss6(), identification, "estimate")
