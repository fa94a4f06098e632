"""Motion of a run: true, measured and modelled poses, frame by frame."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cmmsim.errors import CmmError
from cmmsim.files import SensorFile
from dynamics import Robot, load_robot
from identify.arrays import Array
from identify.errors import RecordError, ScenarioError
from identify.experiment.truth import read_truth, true_poses
from identify.files.dataset import group_names
from identify.files.run_folder import RunFolder, load_result
from identify.record.known_geometry import known_geometry
from identify.record.model_runs import EXCITATION
from identify.record.provenance import RunFiles, check_robot, recorded_seed
from identify.record.recording import TRUTH_GROUP, poses, run_name
from identify.scenario import load_scenario
from identify.scene.workcell import Workcell, workcell

# Names of the poses of a motion in the data of the page.
TRUE = "true"
MEASURED = "measured"
IDENTIFIED = "identified"
STARTING = "starting"


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of a workcell over N frames. A scene without a run has a single frame at home.

    Attributes
    ----------
    time
        Times (N,), in s.
    poses
        Poses (N, 6) [m, rad] named "true", "measured", "identified" and "starting" (initial guess).
        They are NaN in frames without a pose.
    covariance
        Covariances (N, 6, 6) of the measured poses, NaN where a frame was lost.
    seed
        Seed of the images' noise.
    renderer
        Renderer of the images.
    title
        Title of the page.
    notes
        Sentences about missing data.
    """

    cell: Workcell
    time: Array
    poses: dict[str, Array]
    covariance: Array | None = None
    seed: int = 0
    renderer: str = "analytic"
    title: str = ""
    notes: list[str] = field(default_factory=list)

    @property
    def drawn(self) -> Array:
        """Poses (N, 6) in which the robot is drawn.

        These are the true poses. If the truth is unknown, they are the most recent measured poses,
        projected to the robot's degrees of freedom.
        """
        if TRUE in self.poses:
            return self.poses[TRUE]
        measured = self.poses[MEASURED]
        robot = self.cell.robot
        good = np.asarray(np.isfinite(measured).all(axis=1))
        # Frames before the first measured frame use that one.
        rows = np.maximum.accumulate(np.where(good, np.arange(len(good)), good.argmax()))
        return measured[rows] if robot is None else robot.pose(robot.coordinates(measured[rows]))


def motion_at_home(cell: Workcell, renderer: str = "analytic") -> Motion:
    """Return the motion of a workcell that stands still at home."""
    return Motion(
        cell, np.zeros(1), {TRUE: cell.home[None]}, renderer=renderer, title=cell.name.capitalize()
    )


def motion_names(run: RunFolder) -> list[str]:
    """Return the names of a run's motions: "excitation", and "run01", ... of the validation."""
    unseen = len(RunFiles(run).validation) if run.validation.is_file() else 0
    return [EXCITATION, *(run_name(number) for number in range(1, unseen + 1))]


def read_motion(folder: Path | str, name: str = EXCITATION, renderer: str | None = None) -> Motion:
    """Read the motion of a run folder with one of the names of `motion_names`.

    The default renderer of the images is that of the run, or "analytic" for a run without images.

    Raises
    ------
    OutputFolderError
        The folder contains no record.
    RecordError
        A file is damaged or of an older version, there is no such motion, the files are not of one
        run, or there is neither a truth nor a measured frame.
    dynamics.RobotFileError, EstimationError
        The robot's file is missing, or differs from the robot of the record.
    """
    run = RunFolder(Path(folder))
    run.require("scenario.toml", "experiment.nc")
    files = RunFiles(run)
    names = motion_names(run)
    if name not in names:
        raise RecordError(f"{run.path} has no motion {name!r}; it has {', '.join(names)}")
    record = files.experiment if name == EXCITATION else files.validation[names.index(name) - 1]
    notes: list[str] = []
    scenario = load_scenario(run.whole_scenario)
    robot = known_geometry(load_robot(scenario.robot), scenario.geometry, run.path).robot
    check_robot(record, robot)
    cell = _cell(robot, scenario.sensor_file, notes)
    if renderer is None:
        renderer = "analytic" if scenario.renderer == "statistical" else scenario.renderer
    seen = {MEASURED: poses(record, "measured")}
    truth = _truth(run, name)
    if truth is None:
        notes.append(
            "The record contains no truth, so no images can be drawn, and the robot is shown at "
            "the measured poses."
        )
    else:
        seen = {TRUE: truth} | seen
    seen |= _models(run, files, name, len(record["time"]), notes)
    what = "exciting trajectory"
    if name != EXCITATION:
        what = f"validation trajectory {names.index(name)}"
    if TRUE not in seen and not np.isfinite(seen[MEASURED]).all(axis=1).any():
        raise RecordError(
            f"{run.path} has neither a truth nor one measured frame: there is no pose to show"
        )
    title = f"Run {run.path.resolve().name}, {what}: {cell.name}"
    covariance = record["measured_covariance"].values
    seed = recorded_seed(record)
    return Motion(cell, record["time"].values, seen, covariance, seed, renderer, title, notes)


def _cell(robot: Robot, sensor_file: Callable[[], SensorFile], notes: list[str]) -> Workcell:
    """Return a robot with its sensor, or the robot alone with a note if there is no sensor."""
    try:
        return workcell(robot, sensor_file())
    except (CmmError, ScenarioError) as error:
        notes.append(f"Cameras, stickers and images are left out: {error}.")
        return workcell(robot)


def _truth(run: RunFolder, name: str) -> Array | None:
    """Return the true poses (N, 6) of a motion, or None if its file contains none."""
    # Validation runs are groups of one file. The excitation has a separate file.
    path, group = (run.experiment, "") if name == EXCITATION else (run.validation, name)
    inside = f"{group}/{TRUTH_GROUP}" if group else TRUTH_GROUP
    return true_poses(read_truth(path, group)) if inside in group_names(path) else None


def _models(
    run: RunFolder, files: RunFiles, name: str, frames: int, notes: list[str]
) -> dict[str, Array]:
    """Return the poses (N, 6) of the identified model and of the initial guess.

    A model that diverges in the first frame is left out. If the run is not validated, there are no
    poses, and a note says so. Raises RecordError if the poses do not belong to the record.
    """
    missing = "so no model is shown; this command adds it: cmmsim validate --out"
    if not run.model.is_file() or not run.result.is_file():
        notes.append(f"The run is not validated yet, {missing} {run.path}.")
        return {}
    result = load_result(run.result)
    # A new identification removes the entry of the validation, because its models are outdated.
    if "validation" not in result:
        notes.append(f"The run was identified again and not validated since, {missing} {run.path}.")
        return {}
    files.check_made_of("experiment.nc", run.model.name, result=result)
    if name not in files.model or files.model[name].sizes["time"] != frames:
        raise RecordError(
            f"{run.model} does not belong to the records of {run.path}: run {name} differs"
        )
    modelled = {
        IDENTIFIED: poses(files.model[name], "identified"),
        STARTING: poses(files.model[name], "initial"),
    }
    return {kind: values for kind, values in modelled.items() if np.isfinite(values).any()}
