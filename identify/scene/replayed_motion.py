"""What moved in a run: poses as they were, were measured and are modelled, frame by frame, and what
is missing.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import xarray as xr

from cmmsim.errors import CmmError
from identify.arrays import Array
from identify.errors import RecordError, ScenarioError
from identify.experiment.truth import read_truth, true_poses
from identify.files.dataset import group_names
from identify.files.run_folder import RunFolder, load_result
from identify.record.known_geometry import known_geometry
from identify.record.provenance import RunFiles, check_robot, recorded_seed
from identify.record.recording import EXCITATION, TRUTH_GROUP, poses, run_name
from identify.scenario import load_scenario
from identify.scene.workcell import Workcell, workcell, workcell_of_scenario

TRUE, MEASURED, IDENTIFIED, STARTING = "true", "measured", "identified", "starting"
"""The poses of a motion, as the page calls them."""


@dataclass(frozen=True, eq=False)
class Motion:
    """One motion of a workcell over N frames; of a scene without a run there is one frame, at home.

    time (N,) s; poses by their name, (N, 6) m and rad, NaN where there is none in a frame: "true",
    "measured", "identified", "starting"; covariance (N, 6, 6) of the measured ones, NaN where lost;
    seed: of the images' noise; renderer: what draws them; title; notes: sentences about what is
    missing.
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
        """Poses (N, 6) in which the robot is drawn: the true ones, else the last measured ones in
        its own freedoms.
        """
        if TRUE in self.poses:
            return self.poses[TRUE]
        measured = self.poses[MEASURED]
        robot = self.cell.robot
        good = np.asarray(np.isfinite(measured).all(axis=1))
        last = np.maximum.accumulate(np.where(good, np.arange(len(good)), good.argmax()))
        return measured[last] if robot is None else robot.pose(robot.coordinates(measured[last]))


def motion_at_home(cell: Workcell, renderer: str = "analytic") -> Motion:
    """A workcell that stands still; renderer: what draws its images."""
    return Motion(
        cell, np.zeros(1), {TRUE: cell.home[None]}, renderer=renderer, title=cell.name.capitalize()
    )


def motion_names(run: RunFolder) -> list[str]:
    """Names of the motions that a run folder holds: "excitation", and the unseen "run01", ...,
    where there are any.
    """
    unseen = len(RunFiles(run).validation) if run.validation.is_file() else 0
    return [EXCITATION, *(run_name(number) for number in range(1, unseen + 1))]


def read_motion(folder: Path | str, name: str = EXCITATION) -> Motion:
    """The motion of a run folder of this name, see `motion_names`.

    Raises OutputFolderError: no record in it. Raises RecordError: a file that is damaged or of an
    older version, no such motion, or files that are not of one run. Raises dynamics.RobotFileError,
    EstimationError: the robot's file is gone, or another one than that of the record.
    """
    run = RunFolder(Path(folder))
    run.require("scenario.toml", "experiment.nc")
    files = RunFiles(run)
    names = motion_names(run)
    if name not in names:
        raise RecordError(f"{run.path} has no motion {name!r}; it has {', '.join(names)}")
    record = files.experiment if name == EXCITATION else files.validation[names.index(name) - 1]
    notes: list[str] = []
    cell = _cell(run, record, notes)
    seen = {MEASURED: poses(record, "measured")}
    truth = _truth(run, name)
    if truth is None:
        notes.append(
            "The record holds no truth, so no image can be drawn: the robot stands where it was "
            "measured."
        )
    else:
        seen = {TRUE: truth} | seen
    seen |= _models(run, files, name, len(record["time"]), notes)
    what = "exciting trajectory" if name == EXCITATION else f"unseen trajectory {names.index(name)}"
    if TRUE not in seen and not np.isfinite(seen[MEASURED]).all(axis=1).any():
        raise RecordError(
            f"{run.path} has neither a truth nor one measured frame: there is no pose to show"
        )
    title = f"Run {run.path.resolve().name}, {what}: {cell.name}"
    covariance = record["measured_covariance"].values
    seed = recorded_seed(record)
    return Motion(cell, record["time"].values, seen, covariance, seed, title=title, notes=notes)


def _cell(run: RunFolder, record: xr.Dataset, notes: list[str]) -> Workcell:
    """Robot and sensor of a run; the robot alone, with a note, where the sensor cannot be had."""
    scenario = load_scenario(run.whole_scenario)
    robot = known_geometry(scenario, run.path).robot
    check_robot(record, robot)
    try:
        return workcell_of_scenario(scenario, robot)
    except (CmmError, ScenarioError) as error:
        notes.append(f"Cameras, stickers and images are left out: {error}.")
        return workcell(robot)


def _truth(run: RunFolder, name: str) -> Array | None:
    """True poses (N, 6) of a motion; None where its file holds none."""
    path, group = (run.experiment, "") if name == EXCITATION else (run.validation, name)
    inside = f"{group}/{TRUTH_GROUP}" if group else TRUTH_GROUP
    return true_poses(read_truth(path, group)) if inside in group_names(path) else None


def _models(
    run: RunFolder, files: RunFiles, name: str, frames: int, notes: list[str]
) -> dict[str, Array]:
    """Poses (N, 6) of the identified and the starting model, as far as they are there and belong to
    the record.
    """
    missing = "so no model is shown; this command adds it: cmmsim validate --out"
    if not run.model.is_file() or not run.result.is_file():
        notes.append(f"The run is not validated yet, {missing} {run.path}.")
        return {}
    result = load_result(run.result)
    if "validation" not in result:
        notes.append(
            f"The run has been identified anew and not been validated since, {missing} {run.path}."
        )
        return {}
    files.check_made_of("experiment.nc", run.model.name, result=result)
    if name not in files.model or files.model[name].sizes["time"] != frames:
        raise RecordError(
            f"{run.model} does not belong to the records of {run.path}: run {name} differs"
        )
    found = {
        IDENTIFIED: poses(files.model[name], "identified"),
        STARTING: poses(files.model[name], "initial"),
    }
    return {kind: values for kind, values in found.items() if np.isfinite(values).any()}
