import os

import h5py
import numpy as np
import pytest
import xarray as xr

from identify.errors import RecordError
from identify.experiment.truth import read_truth, read_truth_runs, true_parameters, true_poses
from identify.files.dataset import group_names, write_groups
from identify.record import recording
from identify.record.recording import (
    build_model_run,
    poses,
    read,
    read_model_runs,
    read_runs,
    write,
    write_model_runs,
    write_runs,
)


def test_record_and_truth_read_back_identical(tmp_path, make_record, make_truth):
    path = tmp_path / "experiment.nc"
    record, truth = make_record(), make_truth()
    write(path, record, truth)
    xr.testing.assert_identical(read(path), record)
    xr.testing.assert_identical(read_truth(path), truth)
    assert true_parameters(read_truth(path)) == {"platform.mass": 23.5, "joint1.coulomb": 0.104}


def test_plain_xarray_and_plain_hdf5_open_the_file(tmp_path, make_record, make_truth):
    path = tmp_path / "experiment.nc"
    write(path, make_record(), make_truth())
    with xr.open_dataset(path) as main, xr.open_dataset(path, group="truth") as truth:
        assert "position" not in main
        assert main["time"].dtype == float
        assert main["time"].attrs["units"] == "s"
        assert truth["joint_torque"].attrs["units"] == "N m"
    with h5py.File(path) as file:
        np.testing.assert_array_equal(file["truth/parameter_value"], [23.5, 0.104])
        assert file["measured_position"].attrs["units"] == "m"


def test_record_never_holds_the_truth(tmp_path, make_record, make_truth):
    path = tmp_path / "experiment.nc"
    write(path, make_record(), make_truth())
    assert not [name for name in read(path).variables if "true" in str(name) or "torque" in str(name)]


def test_every_variable_has_a_unit_and_a_name(make_record, make_truth):
    for data in (make_record(), make_truth()):
        for name, variable in data.data_vars.items():
            assert variable.attrs["units"], name
            assert variable.attrs["long_name"], name


def test_record_says_how_it_was_made(make_record):
    attributes = make_record().attrs
    assert attributes["robot"] == "rss6"
    assert attributes["frame_rate_hz"] == 60.0
    assert f"numpy {np.__version__}" in attributes["software"]
    assert 'name = "quick"' in attributes["scenario"]


def test_poses_are_the_arrays_that_were_given(make_record, make_truth):
    measured = np.arange(720.0).reshape(120, 6)
    record = make_record(measured_pose=measured)
    np.testing.assert_array_equal(poses(record, "measured"), measured)
    np.testing.assert_array_equal(true_poses(make_truth(pose=measured)), measured)
    with pytest.raises(RecordError, match="no initial_position and initial_orientation; it has reference_position"):
        poses(record, "initial")


def test_lost_frames_may_be_nan_and_only_they(make_record):
    measured, ok = np.zeros((120, 6)), np.ones(120, dtype=bool)
    measured[7], ok[7] = np.nan, False
    assert make_record(measured_pose=measured, measured_ok=ok)["measured_ok"].values.sum() == 119
    with pytest.raises(RecordError, match="3 of 360 values of measured_position are not finite"):
        make_record(measured_pose=measured)
    with pytest.raises(RecordError, match="command"):
        make_record(command=np.full((120, 6), np.inf))


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("command", (120, 5)),
        ("measured_covariance", (120, 6)),
        ("measured_ok", (119,)),
        ("reference_pose", (6, 120)),
        ("measured_pose", (119, 6)),
    ],
)
def test_wrong_shape_is_named(make_record, name, shape):
    with pytest.raises(RecordError) as caught:
        make_record(**{name: np.zeros(shape)})
    assert str(shape[0]) in str(caught.value)


@pytest.mark.parametrize(
    ("frames", "value", "says"),
    [
        ([5], 7, "it is 7 in frame 5$"),
        ([3, 9, 11], -1, "it is -1 in frame 3 and wrong in 2 more"),
        ([0], np.nan, "it is nan in frame 0"),
    ],
)
def test_a_frame_was_measured_or_lost_and_nothing_else(make_record, frames, value, says):
    record = make_record()
    stated = record["measured_ok"].values.astype(float if np.isnan(value) else int)
    stated[frames] = value
    with pytest.raises(RecordError, match=f"mine: measured_ok must be 1 or 0, {says}"):
        recording.check_record(record.assign(measured_ok=("time", stated)), "mine")


def test_time_must_increase(make_record):
    with pytest.raises(RecordError, match="time does not increase"):
        make_record(time=np.zeros(120))


@pytest.mark.parametrize("kept", [0, 100, 0.5, -1])
def test_truncated_file_is_one_clear_error(tmp_path, make_record, kept):
    path = tmp_path / "experiment.nc"
    write(path, make_record())
    size = path.stat().st_size
    os.truncate(path, int(kept * size) if isinstance(kept, float) else kept % size)
    with pytest.raises(RecordError, match=r"experiment\.nc is truncated or not a netCDF file"):
        read(path)


def test_missing_file_group_and_variable_are_named(tmp_path, make_record):
    with pytest.raises(RecordError, match="there is no file"):
        read(tmp_path / "nothing.nc")
    path = tmp_path / "experiment.nc"
    write(path, make_record())
    with pytest.raises(RecordError, match="no group 'truth'"):
        read_truth(path)
    write(path, make_record().drop_vars(["command", "measured_ok"]))
    with pytest.raises(RecordError, match="lacks measured_ok, command"):
        read(path)


def test_damaged_values_in_a_file_are_named(tmp_path, make_record):
    path = tmp_path / "experiment.nc"
    write(path, make_record())
    with h5py.File(path, "r+") as file:
        file["reference_position"][3, 1] = np.nan
    with pytest.raises(RecordError, match="1 of 360 values of reference_position"):
        read(path)


def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, make_record):
    path = tmp_path / "experiment.nc"
    write(path, make_record())
    before = path.read_bytes()
    bad = xr.Dataset({"x": ("n", np.array([object()], dtype=object))})
    with pytest.raises((TypeError, ValueError)):
        write_groups(path, {"": make_record(), "truth": bad})
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["experiment.nc"]


def test_runs_share_a_file_and_keep_their_order(tmp_path, make_record, make_truth):
    path = tmp_path / "validation.nc"
    write_runs(path, [(make_record(seed=n), make_truth(values=(n, 0.0))) for n in range(11)])
    assert [record.attrs["seed"] for record in read_runs(path)] == list(range(11))
    assert [true_parameters(t)["platform.mass"] for t in read_truth_runs(path)] == list(range(11))
    assert group_names(path)[:3] == ["run01", "run01/truth", "run02"]
    with xr.open_dataset(path, group="run11/truth") as truth:
        assert truth.sizes["time"] == 120


def test_more_than_99_runs_keep_their_order():
    assert [recording.run_name(n) for n in (1, 99, 100)] == ["run01", "run99", "run100"]


def test_file_without_runs_is_refused(tmp_path, make_record):
    path = tmp_path / "experiment.nc"
    write(path, make_record())
    with pytest.raises(RecordError, match="holds no runs"):
        read_runs(path)


def test_model_runs_read_back_and_a_diverged_model_is_nan(tmp_path):
    time, pose = np.arange(5) / 60, np.arange(30.0).reshape(5, 6)
    diverged = pose.copy()
    diverged[3:] = np.inf
    write_model_runs(tmp_path / "model.nc", build_model_run(time, diverged, pose), [build_model_run(time, pose, pose)])
    runs = read_model_runs(tmp_path / "model.nc")
    assert sorted(runs) == ["excitation", "run01"]
    np.testing.assert_array_equal(poses(runs["excitation"], "identified"), pose)
    np.testing.assert_array_equal(np.isnan(poses(runs["excitation"], "initial")).all(axis=1), [0, 0, 0, 1, 1])
