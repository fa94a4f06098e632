"""Files of a run: records, their truth and what models do, read back as written, whole or not at all."""

import os

import h5py
import numpy as np
import pytest
import xarray as xr

from identify.errors import RecordError
from identify.experiment.truth import read_truth, read_truth_runs, true_parameters, true_poses
from identify.files.atomic import atomic_path, write_text
from identify.files.dataset import group_names, write_groups
from identify.loop_parameters import NAMES
from identify.record.recording import (
    build_model_run,
    check_record,
    poses,
    read,
    read_model_runs,
    read_runs,
    run_name,
    run_names,
    write,
    write_model_runs,
    write_runs,
)
from tests.identify import synthetic
from tests.identify.synthetic import SHORT, run_plant, short_run, truth_of


@pytest.fixture(scope="module")
def record():
    return short_run()[0]


@pytest.fixture(scope="module")
def truth():
    return truth_of(short_run()[1])


def test_record_and_truth_read_back_identical_and_apart(tmp_path, record, truth):
    """By us, by plain xarray and by plain HDF5; who reads the record does not see the truth."""
    path, run = tmp_path / "experiment.nc", short_run()[1]
    np.testing.assert_array_equal(poses(record, "measured"), run.measured)
    np.testing.assert_array_equal(true_poses(truth), run.pose)
    with pytest.raises(RecordError, match="no initial_position and initial_orientation; it has reference_position"):
        poses(record, "initial")
    write(path, record, truth)
    xr.testing.assert_identical(read(path), record)
    xr.testing.assert_identical(read_truth(path), truth)
    assert true_parameters(read_truth(path)) == dict(zip(NAMES, synthetic.truth(), strict=True))
    assert not [name for name in read(path).variables if "true" in str(name) or "torque" in str(name)]
    assert all(v.attrs["units"] and v.attrs["long_name"] for data in (record, truth) for v in data.data_vars.values())
    assert (record.attrs["robot"], record.attrs["frame_rate_hz"]) == ("rss6", 60.0)
    assert f"numpy {np.__version__}" in record.attrs["software"]
    assert 'name = "quick"' in record.attrs["scenario"]
    with xr.open_dataset(path) as main, xr.open_dataset(path, group="truth") as plain:
        assert "position" not in main
        assert main["time"].dtype == float
        assert main["time"].attrs["units"] == "s"
        assert plain["joint_torque"].attrs["units"] == "N m"
    with h5py.File(path) as file:
        np.testing.assert_array_equal(file["truth/parameter_value"], synthetic.truth())
        assert file["measured_position"].attrs["units"] == "m"


def test_values_of_another_shape_that_are_not_finite_or_times_that_do_not_increase_are_named(record):
    """Lost frames may be NaN, and only they; a frame was measured or lost and nothing else."""

    def stated(**values):
        return run_plant(SHORT, seed=1, duration_s=2.0, **values)[0]

    measured, ok = np.zeros((120, 6)), np.ones(120)
    measured[7], ok[7] = np.nan, 0
    assert stated(measured_pose=measured, measured_ok=ok)["measured_ok"].values.sum() == 119
    for values, says in (
        ({"measured_pose": measured}, "is not finite in 1 frames that count as measured, the first is frame 7"),
        ({"command": np.full((120, 6), np.inf)}, "command"),
        ({"time": np.zeros(120)}, "time does not increase"),
        ({"command": np.zeros((120, 5))}, "120"),
        ({"measured_covariance": np.zeros((120, 6))}, "120"),
        ({"measured_ok": np.zeros(119)}, "119"),
        ({"reference_pose": np.zeros((6, 120))}, "6"),
    ):
        with pytest.raises(RecordError, match=says):
            stated(**values)
    for frames, value, says in (
        ([3, 9, 11], -1.0, "it is -1.0 in frame 3 and wrong in 2 more"),
        ([0], np.nan, "it is nan in frame 0$"),
    ):
        flags = record["measured_ok"].values.astype(float)
        flags[frames] = value
        with pytest.raises(RecordError, match=f"mine: measured_ok must be 1 or 0, {says}"):
            check_record(record.assign(measured_ok=("time", flags)), "mine")


def test_what_a_file_lacks_or_damages_is_named(tmp_path, record):
    with pytest.raises(RecordError, match="there is no file"):
        read(tmp_path / "nothing.nc")
    path = tmp_path / "experiment.nc"
    write(path, record)
    with pytest.raises(RecordError, match="no group 'truth'"):
        read_truth(path)
    with h5py.File(path, "r+") as file:
        file["reference_position"][3, 1] = np.nan
    with pytest.raises(RecordError, match="reference_position is not finite in 1 frames, the first is frame 3"):
        read(path)
    for kept in (path.stat().st_size - 1, path.stat().st_size // 2, 100, 0):
        os.truncate(path, kept)
        with pytest.raises(RecordError, match=r"experiment\.nc is truncated or not a netCDF file"):
            read(path)
    write(path, record.drop_vars(["command", "measured_ok"]))
    with pytest.raises(RecordError, match="lacks measured_ok, command"):
        read(path)


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path, record):
    path = tmp_path / "experiment.nc"
    write(path, record)
    before = path.read_bytes()
    bad = xr.Dataset({"x": ("n", np.array([object()], dtype=object))})
    with pytest.raises((TypeError, ValueError)):
        write_groups(path, {"": record, "truth": bad})

    def write_half():
        with atomic_path(path) as temporary:
            temporary.write_text("half")
            assert path.read_bytes() == before
            assert temporary.suffix == ".nc"
            raise RuntimeError("disk full")

    with pytest.raises(RuntimeError, match="disk full"):
        write_half()
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["experiment.nc"]
    write_text(tmp_path / "folder" / "a.txt", "x")
    (tmp_path / "b.txt").write_text("x")
    assert (tmp_path / "folder" / "a.txt").stat().st_mode == (tmp_path / "b.txt").stat().st_mode, "the usual rights"


def test_runs_share_a_file_and_keep_their_order(tmp_path, record, truth):
    path = tmp_path / "validation.nc"
    numbered = [truth.assign(parameter_value=n + 0 * truth["parameter_value"]) for n in (0, 1)]
    write_runs(path, [(record.assign_attrs(seed=n), other) for n, other in enumerate(numbered)])
    assert [one.attrs["seed"] for one in read_runs(path)] == [0, 1]
    assert [true_parameters(one)["platform.mass"] for one in read_truth_runs(path)] == [0, 1]
    assert group_names(path) == ["run01", "run01/truth", "run02", "run02/truth"]
    with xr.open_dataset(path, group="run02/truth") as plain:
        assert plain.sizes["time"] == 120
    many = [run_name(number) for number in (1, 9, 10, 99, 100)]
    write_groups(path, dict.fromkeys(reversed(many), xr.Dataset({"x": 1.0})))
    assert run_names(path) == many == ["run01", "run09", "run10", "run99", "run100"]
    write(path, record)
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
