"""Records of another experiment or another robot: refused, however alike they look."""

import json
from importlib import resources

import numpy as np
import pytest

from dynamics import load_robot
from identify import pipeline
from identify.errors import EstimationError, RecordError
from identify.estimation.identification import identify
from identify.files.dataset import write_covariance
from identify.files.run_folder import RunFolder, load_result, save_result
from identify.loop_parameters import NAMES
from identify.progress import SilentProgress
from identify.record.checks import check_trajectory
from identify.record.provenance import check_robot, store_robot
from identify.record.recording import read, write
from identify.trajectory import TrajectorySet, load_trajectories, save_trajectories
from tests.identify.synthetic import quick, rss6, run_plant, trajectory

SCENARIO = quick(**{"excitation.duration_s": 2.0})


@pytest.fixture(scope="module")
def record():
    made = run_plant(SCENARIO, seed=1, duration_s=2.0)[0]
    store_robot(made, rss6())
    return made


def longer_cranks(folder):
    """The reference robot, of the same name, with cranks of 62 mm."""
    text = resources.files("dynamics").joinpath("robots", "rss6.toml").read_text()
    assert text.count("crank_length = 0.06\n") == 1
    path = folder / "rss6.toml"
    path.write_text(text.replace("crank_length = 0.06\n", "crank_length = 0.062\n"))
    return load_robot(path)


def test_the_record_of_this_trajectory_and_robot_is_taken(record):
    check_trajectory(record, trajectory(0), SCENARIO)
    check_robot(record, rss6())


def test_a_record_of_another_trajectory_is_refused_where_it_differs_most(record):
    gap = np.abs(trajectory(0).pose(record["time"].values) - trajectory(1).pose(record["time"].values))
    frame, axis = np.unravel_index(gap.argmax(), gap.shape)
    assert axis >= 3, "an angle differs most"
    with pytest.raises(EstimationError, match=rf"differs by {gap.max():.3g} rad at t = {frame / 60:.2f} s"):
        check_trajectory(record, trajectory(1), SCENARIO)


def test_a_record_of_another_length_is_refused(record):
    with pytest.raises(EstimationError, match=r"has 120 frames, and the scenario asks for 600 .*duration_s = 10 s"):
        check_trajectory(record, trajectory(0), quick())


def test_a_robot_of_the_same_name_and_other_cranks_is_refused(record, tmp_path):
    robot = longer_cranks(tmp_path)
    assert robot.name == "rss6"
    with pytest.raises(EstimationError, match=r"crank_length was 0.06 when it was made, the robot file says 0.062"):
        identify(record, robot, SCENARIO)


def test_a_record_that_states_no_geometry_is_known_by_the_robots_name(record):
    bare = record.copy()
    bare.attrs = {name: value for name, value in record.attrs.items() if name != "robot_geometry"}
    check_robot(bare, rss6())
    with pytest.raises(EstimationError, match="is of robot 'rss7', not of 'rss6'"):
        check_robot(bare.assign_attrs(robot="rss7"), rss6())


def folder_of(path, chosen, record):
    """A run folder as it is before validation, with this exciting trajectory and this record."""
    run = RunFolder(path)
    run.scenario.write_text(SCENARIO.to_toml())
    save_trajectories(run.trajectories, TrajectorySet(0, chosen, (trajectory(5),), 1.0, 1.0, 1.0))
    write(run.experiment, record)
    write_covariance(run.covariance, NAMES, np.eye(len(NAMES)))
    save_result(run.result, {})
    return run


@pytest.mark.parametrize("stage", [pipeline.identify, pipeline.validate])
def test_a_stage_refuses_a_record_that_is_not_of_its_folder(record, tmp_path, stage):
    run = folder_of(tmp_path, trajectory(1), record)
    with pytest.raises(EstimationError, match=rf"{run.experiment}: the record's reference is not the exciting"):
        stage(run.path, SilentProgress())
    assert load_result(run.result) == {}


def test_a_folder_takes_the_record_of_its_own_trajectory_as_json_keeps_it(record, tmp_path):
    run = folder_of(tmp_path, trajectory(0), record)
    check_trajectory(read(run.experiment), load_trajectories(run.trajectories).excitation, SCENARIO)


def test_a_run_too_short_to_identify_from_is_refused_before_anything_is_computed(tmp_path):
    short = quick(**{"excitation.duration_s": 0.5})
    with pytest.raises(EstimationError, match=r"duration_s gives 30 frames .0.5 s., at least 120 are needed"):
        pipeline.excite(short, 0, tmp_path / "new", SilentProgress())
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("geometry", "says"),
    [("{", "no JSON object"), ("[1]", "no JSON object"), (json.dumps({"base_joints": [1]}), r"shape \(1,\), expected")],
)
def test_a_geometry_that_cannot_be_read_is_named(record, geometry, says):
    with pytest.raises(RecordError, match=says):
        check_robot(record.assign_attrs(robot_geometry=geometry), rss6())
