"""Files of a run: records, their truth and what models do, read back as written, whole or not at
all; and records as a user might bring them, spoilt in one thing each, or of another experiment or
robot: refused by name."""

import json
import os

import h5py
import numpy as np
import pytest
import xarray as xr

from dynamics import load_robot
from identify import pipeline
from identify.errors import EstimationError, RecordError, WriteError
from identify.estimation.identification import asked_of, identify
from identify.experiment.truth import read_truth, read_truth_runs, true_parameters, true_poses
from identify.files.atomic import atomic_contents, write_files, write_text
from identify.files.dataset import group_names, write_groups
from identify.files.run_folder import load_result, save_result
from identify.model.from_record import identified_model
from identify.progress import SilentProgress
from identify.record.checks import check_trajectory
from identify.record.files_of_record import store_robot_file, warn_of_changed_sensor
from identify.record.load import recorded_payload
from identify.record.model_runs import build_model_run, read_model_runs
from identify.record.provenance import check_robot
from identify.record.recording import (
    check_record,
    poses,
    read,
    read_runs,
    run_name,
    run_names,
    write,
)
from identify.setup import Setup
from identify.trajectory import load_trajectories
from tests.identify import synthetic
from tests.identify.run_files import write_covariance, write_model_runs, write_runs
from tests.identify.synthetic import (
    LAYOUT,
    NAMES,
    SHORT,
    quick,
    rss6,
    run_plant,
    short_run,
    side_of,
    trajectory,
)


@pytest.fixture(scope="module")
def record():
    return short_run()[0]


@pytest.fixture(scope="module")
def truth():
    return synthetic.truth_of(short_run()[1])


def test_record_and_truth_read_back_identical_and_apart(tmp_path, record, truth):
    """By us, by plain xarray and by plain HDF5; who reads the record does not see the truth."""
    path, run = tmp_path / "experiment.nc", short_run()[1]
    np.testing.assert_array_equal(poses(record, "measured"), run.measured)
    np.testing.assert_array_equal(true_poses(truth), run.pose)
    with pytest.raises(
        RecordError, match="no initial_position and initial_orientation; it has reference_position"
    ):
        poses(record, "initial")
    write(path, record, truth)
    xr.testing.assert_identical(read(path), record)
    xr.testing.assert_identical(read_truth(path), truth)
    assert true_parameters(read_truth(path)) == dict(zip(NAMES, synthetic.truth(), strict=True))
    assert not [
        name for name in read(path).variables if "true" in str(name) or "torque" in str(name)
    ]
    assert all(
        v.attrs["units"] and v.attrs["long_name"]
        for data in (record, truth)
        for v in data.data_vars.values()
    )
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


def test_values_of_another_shape_that_are_not_finite_or_times_that_do_not_increase_are_named(
    record,
):
    """Lost frames may be NaN, and only they; a frame was measured or lost and nothing else."""

    def stated(**values):
        return run_plant(SHORT, seed=1, duration_s=2.0, **values)[0]

    measured, ok = np.zeros((120, 6)), np.ones(120)
    measured[7], ok[7] = np.nan, 0
    assert stated(measured_pose=measured, measured_ok=ok)["measured_ok"].values.sum() == 119
    for values, says in (
        (
            {"measured_pose": measured},
            "is not finite in 1 frames that count as measured, first in frame 7",
        ),
        (
            {"command": np.full((120, 6), np.inf)},
            "command is not finite in 120 frames, first in frame 0",
        ),
        ({"command": np.zeros(120)}, "120"),
        ({"measured_covariance": np.zeros((120, 6))}, "120"),
        ({"measured_ok": np.zeros(119)}, "119"),
        ({"reference_pose": np.zeros((6, 120))}, "6"),
    ):
        with pytest.raises(RecordError, match=says):
            stated(**values)
    for frames, value, says in (
        ([3, 9, 11], -1.0, "but is -1.0 in frame 3 and wrong in 2 more"),
        ([0], np.nan, "but is nan in frame 0$"),
    ):
        flags = record["measured_ok"].values.astype(float)
        flags[frames] = value
        with pytest.raises(RecordError, match=f"mine: measured_ok must be 1 or 0, {says}"):
            check_record(record.assign(measured_ok=("time", flags)), "mine")


@pytest.mark.thorough
def test_what_a_file_lacks_or_damages_is_named(tmp_path, record):
    with pytest.raises(RecordError, match="there is no file"):
        read(tmp_path / "nothing.nc")
    path = tmp_path / "experiment.nc"
    write(path, record)
    with pytest.raises(RecordError, match="no group 'truth'"):
        read_truth(path)
    with h5py.File(path, "r+") as file:
        file["reference_position"][3, 1] = np.nan
    with pytest.raises(
        RecordError, match="reference_position is not finite in 1 frames, first in frame 3"
    ):
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

    def refuse(written):
        assert written.read_text() == "new"
        assert (written.parent, path.read_bytes()) == (path.parent, before)
        raise RuntimeError("not like that")

    with pytest.raises(RuntimeError, match="not like that"):
        write_files({path: b"new", tmp_path / "more" / "b": b"x"}, parents=True, check=refuse)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["experiment.nc"]
    write_text(tmp_path / "folder" / "a.txt", "x", parents=True)
    (tmp_path / "b.txt").write_text("x")
    assert (tmp_path / "folder" / "a.txt").stat().st_mode == (tmp_path / "b.txt").stat().st_mode, (
        "the usual rights"
    )


def test_contents_that_find_a_folder_of_their_name_leave_it_as_it_was(tmp_path):
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "kept").write_text("x")
    with pytest.raises(WriteError), atomic_contents(tmp_path) as new:
        (new / "old").mkdir()
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["kept", "old"]


@pytest.mark.slow
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
    write_model_runs(
        tmp_path / "model.nc",
        build_model_run(time, diverged, pose),
        [build_model_run(time, pose, pose)],
    )
    runs = read_model_runs(tmp_path / "model.nc")
    assert sorted(runs) == ["excitation", "run01"]
    np.testing.assert_array_equal(poses(runs["excitation"], "identified"), pose)
    np.testing.assert_array_equal(
        np.isnan(poses(runs["excitation"], "initial")).all(axis=1), [0, 0, 0, 1, 1]
    )


def with_values(record, **values):
    return record.assign({name: (record[name].dims, array) for name, array in values.items()})


def alias(record):
    """A reference with 59 Hz in x, which looks like 1 Hz in 60 frames a second."""
    t = record["time"].values
    position, velocity = (
        record["reference_position"].values.copy(),
        record["reference_velocity"].values.copy(),
    )
    position[:, 0] = 0.005 * np.sin(2 * np.pi * 59 * t)
    velocity[:, 0] = 0.005 * 2 * np.pi * 59 * np.cos(2 * np.pi * 59 * t)
    return with_values(record, reference_position=position, reference_velocity=velocity)


def one_triangle(record):
    """The covariance of z and gamma in one of its two places, in frame 9, after a frame that was
    lost.
    """
    covariance = record["measured_covariance"].values.copy()
    covariance[9, 2, 5] = 0.5 * np.sqrt(covariance[9, 2, 2] * covariance[9, 5, 5])
    return with_values(record, measured_covariance=covariance)


def without(record, *names):
    return record.drop_attrs(deep=False).assign_attrs(
        {k: v for k, v in record.attrs.items() if k not in names}
    )


@pytest.mark.parametrize(
    ("spoil", "error", "says"),
    [
        (
            lambda r: r.isel(joint=slice(0, 5)),
            EstimationError,
            "has commands of 5 joints, but robot 'rss6' has 6",
        ),
        (lambda r: r.isel(time=slice(0, 0)), RecordError, "the record has no time"),
        (
            lambda r: r.isel(time=slice(0, 1)),
            EstimationError,
            "1 frames .0.0167 s., at least 120 are needed",
        ),
        (
            lambda r: r.assign_coords(time=r["time"].where(r["time"] > 1)),
            RecordError,
            "increase after frame 0",
        ),
        (
            lambda r: r.drop_isel(time=range(100, 110)),
            EstimationError,
            r"the frame at t = 1.65 s after the first pose is 11.000 periods of 60 Hz before the next",
        ),
        (
            lambda r: r.assign(measured_ok=r["measured_ok"] * (r["time"] > 1.5)),
            EstimationError,
            "29 of 120 frames",
        ),
        (
            lambda r: r.assign(measured_covariance=0 * r["measured_covariance"]),
            EstimationError,
            "not positive def",
        ),
        (
            one_triangle,
            EstimationError,
            r"in 1 frames: at t = 0.15 s after the first pose its entry .z, gamma. is 7.5e-11 and .gamma, z. is 0",
        ),
        (
            lambda r: without(r, "scenario"),
            RecordError,
            r"no attribute scenario, .*to_toml\(\), .*build_record",
        ),
        (
            lambda r: r.assign_attrs(scenario=7),
            RecordError,
            "attribute scenario is 7, must be TOML text",
        ),
        (
            lambda r: r.assign_attrs(scenario="paper"),
            RecordError,
            "attribute scenario is not valid TOML",
        ),
        (
            lambda r: r.assign_attrs(scenario="description = 'x'"),
            RecordError,
            "attribute scenario: name is missing",
        ),
        (
            lambda r: r.assign_attrs(seed="abc"),
            RecordError,
            "attribute seed is 'abc', must be a whole number >= 0",
        ),
        (
            lambda r: r.assign_attrs(frame_rate_hz=30.0),
            EstimationError,
            "frame_rate_hz is 30.0, and timing.* is 60",
        ),
        (
            lambda r: r.assign({v: 0 * r[v] for v in r if "reference" in v}),
            EstimationError,
            "same pose in every frame",
        ),
        (alias, EstimationError, "the reference's x travels 0.01, .*harmonics above half of 60 Hz"),
        (
            lambda r: r.assign(reference_velocity=1e3 * r["reference_velocity"]),
            EstimationError,
            "not its derivative",
        ),
        (
            lambda r: r.assign(command=r["command"] * (r["joint"] != 3)),
            EstimationError,
            "command of joint 3 is 0 in",
        ),
        (
            lambda r: r.assign(measured_position=0 * r["measured_position"] + 1),
            EstimationError,
            "x is 1 in every f",
        ),
        (
            lambda r: r.assign(measured_position=1e3 * r["measured_position"]),
            EstimationError,
            "in mm it would fit",
        ),
    ],
)
def test_what_is_wrong_with_a_record_is_said(record, spoil, error, says):
    with pytest.raises(error, match=says):
        identify(spoil(record), rss6(), SHORT)


def test_what_a_record_need_not_have_and_what_rounding_leaves_of_symmetry_is_no_fault(record):
    """The frame rate of its scenario once more, more than one way to go; and, of a real robot, a
    seed. A covariance J C J^T of numbers of different size, computed in single precision."""
    rng = np.random.default_rng(0)
    jacobian = (np.repeat([1e-3, 1.0], 3)[:, None] * rng.normal(size=(6, 6))).astype(np.float32)
    drawn = jacobian * np.float32(1e-5)
    covariance = np.float32(drawn @ drawn.T).astype(float) * (1 + 1e-9 * rng.normal(size=(6, 6)))
    assert np.abs(covariance - covariance.T).max() > 0
    bare = with_values(
        without(record, "frame_rate_hz"),
        reference_position=record["reference_position"].values * [1, 0, 0] + [0, 0, 0.2],
        reference_velocity=record["reference_velocity"].values * [1, 0, 0],
        measured_covariance=np.broadcast_to(covariance, record["measured_covariance"].shape),
    )
    np.testing.assert_allclose(identified_model(bare, side_of(SHORT)).covariance, covariance)
    once = SHORT.with_overrides({"identification.method": "command_driven"})
    assert np.all(np.isfinite(identify(without(record, "seed"), rss6(), once).estimate))


def test_a_load_that_no_body_has_is_refused_and_its_numbers_are_shown_as_plain_ones(record):
    load = {"payload_mass": 8.0, "payload_Ixx": 0.02, "payload_Iyy": 0.02, "payload_Izz": 0.04}
    assert recorded_payload(record.assign_attrs(load), LAYOUT)[0].sum() == pytest.approx(8.08)
    with pytest.raises(RecordError, match=r"attribute payload_Ixx 100 > .*0.02 .*0.04"):
        recorded_payload(record.assign_attrs(load | {"payload_Ixx": 100.0}), LAYOUT)
    with pytest.raises(
        RecordError, match=r"attribute payload_mass is -8.0, must be .* < 1e6 in kg"
    ):
        recorded_payload(record.assign_attrs(load | {"payload_mass": np.float64(-8.0)}), LAYOUT)


def test_a_record_of_another_trajectory_is_refused_where_it_differs_most(record, recorded_folder):
    check_trajectory(record, trajectory(0), SHORT.timing, SHORT.excitation.duration_s)
    planned = load_trajectories(recorded_folder.trajectories).excitation
    check_trajectory(
        read(recorded_folder.experiment), planned, SHORT.timing, SHORT.excitation.duration_s
    )
    gap = np.abs(
        trajectory(0).pose(record["time"].values) - trajectory(1).pose(record["time"].values)
    )
    frame, axis = np.unravel_index(gap.argmax(), gap.shape)
    assert axis >= 3, "an angle differs most"
    with pytest.raises(
        EstimationError, match=rf"differs by {gap.max():.3g} rad at t = {frame / 60:.2f} s"
    ):
        check_trajectory(record, trajectory(1), SHORT.timing, SHORT.excitation.duration_s)
    with pytest.raises(
        EstimationError, match=r"has 120 frames, and the scenario asks for 600 .*duration_s = 10 s"
    ):
        check_trajectory(record, trajectory(0), quick().timing, quick().excitation.duration_s)


@pytest.mark.thorough
def test_a_record_of_another_robot_is_refused_be_it_by_its_cranks_or_without_geometry_by_its_name(
    record, tmp_path
):
    path = synthetic.changed_robot_file(
        tmp_path / "rss6.toml", "crank_length = 0.06\n", "crank_length = 0.062\n"
    )
    assert load_robot(path).name == "rss6"
    with pytest.raises(
        EstimationError,
        match=r"crank_length was 0.06 when it was made, but is 0.062 in the robot file",
    ):
        identify(record, load_robot(path), SHORT)
    bare = without(record, "robot_geometry")
    for one in (record, bare):
        check_robot(one, rss6())
    with pytest.raises(EstimationError, match="is of robot 'rss7', not of 'rss6'"):
        check_robot(bare.assign_attrs(robot="rss7"), rss6())
    for geometry, says in (
        ("[1]", "not a JSON object"),
        (json.dumps({"base_joints": [1]}), r"shape \(1,\), expected"),
    ):
        with pytest.raises(RecordError, match=says):
            check_robot(record.assign_attrs(robot_geometry=geometry), rss6())


def test_a_robot_file_that_changed_or_went_since_its_record_was_made_is_named(
    record, tmp_path, recwarn
):
    """The record also serves without the file, with the guess that it had, but not with the truth."""
    passage = '\nname = "rss6"\n'
    path = synthetic.changed_robot_file(tmp_path / "own.toml", passage, passage)
    scenario = SHORT.with_overrides({"robot": str(path)})
    held = record.copy()
    store_robot_file(held, load_robot(path), "guess")
    assert "parameters.truth" not in held.attrs["robot_file"]
    asked_of(held, None, scenario)
    assert not recwarn.list
    guess = path.read_text(encoding="utf-8").replace("mass = 24.0", "mass = 25.0", 1)
    path.write_text(guess.replace("centre_std = 0.0", "centre_std = 0.01"), encoding="utf-8")
    with pytest.warns(UserWarning, match=r"own.toml has changed .*: unstated.centre_std was 0.0 a"):
        asked = asked_of(held, None, scenario)
    assert asked.side.robot.nominal_parameters[0] == 25.0
    # A robot that the caller gives is meant to be what it is.
    asked_of(held, load_robot(path), scenario)
    assert not recwarn.list
    path.unlink()
    with pytest.warns(UserWarning, match="the robot that the record holds is used"):
        asked = asked_of(held, None, scenario)
    ours = rss6()
    assert asked.side.robot.geometry == ours.geometry
    assert asked.side.robot.nominal_parameters.tolist() == ours.nominal_parameters.tolist()


def test_a_sensor_file_that_changed_since_its_record_was_made_is_named(record):
    file = SHORT.sensor_file()
    held = record.assign_attrs(sensor_file=file.model_dump_json())
    warn_of_changed_sensor(held, file.model_dump_json(), "s.toml")
    stated = json.loads(file.model_dump_json())
    stated["camera"]["dark_noise"] = 52.0
    stated["a_key_of_a_later_version"] = 1
    with pytest.warns(UserWarning, match=r"s.toml has changed .* camera.dark_noise was .* is 52"):
        warn_of_changed_sensor(held, json.dumps(stated), "s.toml")


@pytest.mark.parametrize("stage", [pipeline.identify, pipeline.validate])
def test_a_stage_refuses_a_record_that_is_not_of_its_folder(tmp_path, stage):
    run = synthetic.recorded_run_folder(tmp_path, chosen=trajectory(1))
    write_covariance(run.covariance, LAYOUT, np.eye(len(NAMES)))
    save_result(run.result, {})
    with pytest.raises(
        EstimationError, match=rf"{run.experiment}: the record's reference is not the exciting"
    ):
        stage(run.path, SilentProgress())
    assert load_result(run.result) == {}


def test_a_run_too_short_to_identify_from_is_refused_before_anything_is_computed(tmp_path):
    short = quick(**{"excitation.duration_s": 0.5})
    with pytest.raises(
        EstimationError, match=r"duration_s gives 30 frames .0.5 s., at least 120 are needed"
    ):
        pipeline.excite(Setup(short).on_this_machine(), tmp_path / "new", SilentProgress())
    assert not (tmp_path / "new").exists()
