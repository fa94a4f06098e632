"""Data of a run for its report, read from the files of the run.

A record of a real robot has less data than a simulated run.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from cmmsim import CmmError, OpenGLMissingError
from dynamics import DynamicsError, load_robot
from identify.arrays import Array
from identify.errors import IdentifyError, RecordError
from identify.estimation.covariance import correlation_matrix
from identify.experiment.truth import read_truth, true_poses
from identify.files.dataset import group_names
from identify.files.run_folder import RunFolder, check_entries, load_result
from identify.record.model_runs import EXCITATION
from identify.record.provenance import RECORDS, RunFiles, recorded_scenario
from identify.record.recording import TRUTH_GROUP, intended_motion, poses, run_name
from identify.reporting.figures.fit import Fit
from identify.reporting.paper import repeats_the_paper
from identify.reporting.run_result import check_intervals
from identify.reporting.verdict import cameras_consistent
from identify.scenario import Scenario
from identify.scene import StereoView, Workcell, stereo_view, workcell
from identify.trajectory import TrajectorySet, load_trajectories


@dataclass(frozen=True)
class RunData:
    """Data of a run.

    For a record of a real robot, truth and trajectories are None, and there are no validation runs.

    folder             Folder of the run.
    result             Content of `result.json`.
    experiment, truth  Record of the excitation run, and its truth.
    validation         Records of the validation runs.
    validation_truth   Truth of the first validation run.
    models             Poses of the models, by the name of the run.
    covariance, names  Covariance (p + k, p + k) and names (p + k,) of the p parameters and the k
                       common errors of the poses.
    trajectories       Trajectories of excitation and validation.
    """

    folder: Path
    result: dict[str, Any]
    experiment: xr.Dataset
    truth: xr.Dataset | None
    validation: list[xr.Dataset]
    validation_truth: xr.Dataset | None
    models: Mapping[str, xr.Dataset]
    covariance: Array
    names: tuple[str, ...]
    trajectories: TrajectorySet | None = None

    @property
    def robot(self) -> str:
        """Name of the robot, or words for an unknown name."""
        return str(self.experiment.attrs.get("robot", "of an unknown name"))

    @property
    def scenario_toml(self) -> str:
        """Scenario that the record was made with, as TOML, or "" if the record states none."""
        return str(self.experiment.attrs.get("scenario", ""))

    @cached_property
    def scenario(self) -> Scenario:
        """Scenario that the record was made with.

        Raises RecordError if the record states none, or one that cannot be read.
        """
        return recorded_scenario(self.experiment)

    @cached_property
    def repeats_paper(self) -> bool:
        """True if the run repeats the experiment of the paper, so that both can be compared."""
        return repeats_the_paper(self.scenario_toml)

    @cached_property
    def cameras_consistent(self) -> bool | None:
        """True if the cameras cannot be the cause of the model's residuals.

        It is None if this is unknown, see `identify.reporting.verdict.cameras_consistent`.
        """
        return cameras_consistent(self.experiment, self.truth)

    @cached_property
    def scene(self) -> Workcell | str:
        """Robot and cameras as placed by the scenario, or the reason why they cannot be drawn.

        A missing file is such a reason. For a record without truth, there are no cameras.
        """
        try:
            robot = load_robot(self.scenario.robot)
            sensor = None if self.truth is None else self.scenario.sensor_file()
            return workcell(robot, sensor)
        except (CmmError, DynamicsError, IdentifyError) as error:
            return str(error)

    @cached_property
    def stereo_view(self) -> StereoView | None:
        """View of both cameras of a simulated run at the middle of the record.

        The images are rendered again from scenario, seed and true pose, without OpenGL if possible,
        and else with the renderer of the run. The view is None if they cannot be rendered.
        """
        if self.truth is None or isinstance(self.scene, str):
            return None
        seed = int(self.experiment.attrs.get("seed", 0))
        for renderer in ("analytic", self.scenario.renderer):
            try:
                return stereo_view(self.scene, self.middle, seed, renderer)
            except (CmmError, DynamicsError, OpenGLMissingError):
                continue
        return None

    @property
    def middle(self) -> Array:
        """Pose (6,) of the platform half way through the record, in m and rad.

        The true pose is used if known, otherwise the reference, or without one the measured pose.
        """
        motion = intended_motion(self.experiment) if self.truth is None else true_poses(self.truth)
        return motion[len(motion) // 2]

    @cached_property
    def excitation_fit(self) -> Fit:
        """Measurement with its noise, models and, if known, truth on the exciting trajectory."""
        covariances = self.experiment["measured_covariance"].values
        # One number per component: the root of the mean variance over the measured frames.
        noise = np.sqrt(np.nanmean(np.diagonal(covariances, axis1=1, axis2=2), axis=0))
        fit = replace(_fit(self.experiment, self.models[EXCITATION]), noise=noise)
        return fit if self.truth is None else replace(fit, truth=true_poses(self.truth))

    @cached_property
    def validation_fit(self) -> Fit | None:
        """Measurement, models and truth on the first validation trajectory, or None without one."""
        if not self.validation or self.validation_truth is None:
            return None
        fit = _fit(self.validation[0], self.models[run_name(1)])
        model = self.models[run_name(1)]
        fit = replace(fit, truth=true_poses(self.validation_truth))
        if "predicted_position" not in model:
            return fit
        return replace(fit, predicted=poses(model, "predicted"), std=poses(model, "std"))

    @cached_property
    def correlations(self) -> tuple[Array, list[str]]:
        """Correlations (n, n) of the identified parameters, and their names."""
        parameters = self.result["identification"]["parameters"]
        chosen = [
            k for k, name in enumerate(self.names) if parameters.get(name, {}).get("identifiable")
        ]
        names = [self.names[k] for k in chosen]
        return correlation_matrix(self.covariance[np.ix_(chosen, chosen)]), names


def _fit(record: xr.Dataset, model: xr.Dataset) -> Fit:
    initial = poses(model, "initial")
    return Fit(
        time=record["time"].values,
        measured=poses(record, "measured"),
        identified=poses(model, "identified"),
        initial=initial if np.isfinite(initial).any() else None,
    )


def read_run(run: RunFolder) -> RunData:
    """Read the files of a run. A record of a real robot, without truth, needs no validation.

    Raises OutputFolderError if an earlier stage has not been run. Raises RecordError if a file is
    damaged, or the files are not of one run.
    """
    # A missing file is reported before anything is read, with the stage that writes it.
    run.require("result.json", "covariance.nc", "experiment.nc")
    files = RunFiles(run)
    simulated = TRUTH_GROUP in group_names(run.experiment)
    run.require(*(["validation.nc"] if simulated else []), "model.nc")
    result = _checked_result(run, files, simulated)
    data = RunData(
        folder=run.path,
        result=result,
        experiment=files.experiment,
        truth=read_truth(run.experiment) if simulated else None,
        validation=files.validation if simulated else [],
        validation_truth=read_truth(run.validation, run_name(1)) if simulated else None,
        models=files.model,
        covariance=files.covariance,
        names=files.named_covariance[0],
        trajectories=load_trajectories(run.trajectories) if run.trajectories.is_file() else None,
    )
    # A model of another record would be drawn beside the wrong measurement.
    records = {EXCITATION: data.experiment}
    records |= {run_name(number): record for number, record in enumerate(data.validation, start=1)}
    for name, record in records.items():
        if name not in data.models or data.models[name].sizes["time"] != record.sizes["time"]:
            raise RecordError(
                f"{run.model} does not belong to the records of {run.path}: run {name} differs"
            )
    return data


def _checked_result(run: RunFolder, files: RunFiles, simulated: bool) -> dict[str, Any]:
    """Read the result of a run, and check that it was made from the present files.

    Raises RecordError if it was not, lacks entries, or has an estimate outside its interval.
    """
    result = load_result(run.result)
    check_entries(run.result, result, "identify", *(["validate"] if simulated else []))
    later = ["validation.nc"] if simulated else []
    files.check_made_of(*RECORDS, "covariance.nc", *later, "model.nc", result=result)
    try:
        check_intervals(result["identification"])
    except RecordError as error:
        raise RecordError(
            f"{run.result}: {error}; run `cmmsim identify --out {run.path}` again"
        ) from None
    return result
