"""Stage that compares the identified model with the plant on the validation trajectories.

Runs on several exciting trajectories can take the place of validation runs. They show the scatter
of the estimates.
"""

import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cmmsim
from dynamics import Robot
from identify.arrays import Array
from identify.errors import OutputFolderError, RecordError
from identify.excitation.design import design_trajectories
from identify.experiment.run import Experiment
from identify.experiment.truth import read_truth, true_parameters
from identify.files.atomic import write_files
from identify.files.dataset import netcdf
from identify.files.run_folder import (
    RunFolder,
    check_entries,
    load_result,
    result_json,
)
from identify.loop_parameters import settled_drive
from identify.progress import Progress, SilentProgress
from identify.random_streams import DESIGN, stream_seed
from identify.record import recording
from identify.record.files_of_record import warn_of_changed_sensor, warn_of_changes
from identify.record.model_runs import build_model_run, model_groups
from identify.record.provenance import ENTRY, RECORDS, RunFiles, check_robot, digest
from identify.reporting.run_result import (
    add_truth,
    parameter_vector,
    prediction_entry,
    sensor_entry,
    validation_entry,
)
from identify.runtime import mapped
from identify.setup import Setup
from identify.stages.plan import check_planned, open_run
from identify.trajectory import FourierTrajectory
from identify.validation.pose_prediction import predicted_runs
from identify.validation.unseen import model_on_record, run_unseen


def validate(
    folder: Path,
    progress: Progress,
    workers: int | None = None,
    taught: cmmsim.Taught | None = None,
) -> None:
    """Run plant and models on the validation trajectories, and compare with the truth.

    Writes validation.nc, model.nc and result.json. ``taught`` are the frames of the sensor. By
    default the sensor is taught again, with the same result. For the workers see `run_unseen`.

    Raises RecordError if the result is incomplete, or was made from another record or covariance.
    Raises OutputFolderError for a user's own record, because its truth is unknown.
    """
    if RunFolder(folder).holds_own_record:
        raise OutputFolderError(
            f"{folder} holds a record of your own: there is no plant that could run validation "
            f"trajectories; continue with: cmmsim report --out {folder}"
        )
    run_folder, setup, trajectories = open_run(folder)
    began = time.perf_counter()
    robot = setup.robot
    run_folder.require("covariance.nc")
    files = RunFiles(run_folder)
    result = load_result(run_folder.result)
    check_robot(files.experiment, robot)
    check_planned(run_folder.experiment, files.experiment, setup, trajectories)
    excitation_truth = read_truth(run_folder.experiment)
    check_entries(run_folder.result, result, "identify")
    files.check_made_of(*RECORDS, run_folder.covariance.name, result=result)
    covariance = files.covariance_of(robot)
    models = _identified_models(robot, run_folder, result)
    scenario = setup.scenario.with_drive(settled_drive(result["identification"]))
    setup = replace(setup, scenario=scenario)
    seed = setup.seed
    side = setup.side
    plan = setup.sensor_plan
    warn_of_changed_sensor(files.experiment, plan.file.model_dump_json(), scenario.sensor)
    plant = setup.plant
    warn_of_changes(
        f"robot file {scenario.robot}",
        true_parameters(excitation_truth),
        dict(zip(plant.robot.layout.names, map(float, plant.parameters), strict=True)),
    )
    taught = taught or plan.taught(robot, seed, progress).taught
    duration_s = scenario.validation.duration_s
    runs = run_unseen(
        setup.plant, plan, taught, trajectories.validation, duration_s, seed, workers, progress
    )
    records = [files.experiment, *(run.record for run in runs)]
    model_poses = [
        [model_on_record(side, values, record) for values in models] for record in records
    ]
    learned = result["identification"].get("nuisance_estimates", {})
    predictions = predicted_runs(side, records[1:], models[1], covariance, seed, progress, learned)
    # The exciting run was used for the fit, so there is no prediction for it.
    expected = [None, *((prediction.poses, prediction.std) for prediction in predictions)]
    of_models = [
        build_model_run(record["time"].values, initial, identified, each)
        for record, (initial, identified), each in zip(records, model_poses, expected, strict=True)
    ]
    model_runs = model_groups(of_models[0], of_models[1:])
    pairs = [(files.experiment, excitation_truth), *((run.record, run.truth) for run in runs)]
    result["sensor"] = sensor_entry(pairs)
    result["validation"] = [
        validation_entry(*pair, *poses) | prediction_entry(prediction, pair[1])
        for pair, poses, prediction in zip(pairs[1:], model_poses[1:], predictions, strict=True)
    ]
    add_truth(result["identification"], true_parameters(excitation_truth))
    result[ENTRY] = result.get(ENTRY, {}) | {
        "validation.nc": digest(records[1:]),
        "model.nc": digest(model_runs),
    }
    result["seconds"]["validate"] = time.perf_counter() - began
    unseen = recording.run_groups([(one.record, one.truth) for one in runs])
    write_files(
        {
            run_folder.validation: netcdf(unseen),
            run_folder.model: netcdf(model_runs),
            run_folder.result: result_json(result),
        }
    )


def _identified_models(robot: Robot, run_folder: RunFolder, result: dict[str, Any]) -> list[Array]:
    """Return the parameters (p,) of the initial guess and of the identified model."""
    try:
        return [
            parameter_vector(robot, result["identification"], column)
            for column in ("initial", "estimate")
        ]
    except RecordError as error:
        again = f"run `cmmsim identify --out {run_folder.path}` again"
        raise RecordError(f"{run_folder.result}: {error}; {again}") from None


def designed_runs(
    setup: Setup, count: int, workers: int | None, progress: Progress
) -> list[Experiment]:
    """Run the plant with images in the loop on `count` exciting trajectories.

    The scenario's method designs each trajectory from separate random candidates. All runs are as
    long as the exciting run. For the workers see `run_unseen`.

    Raises the errors of the stages `excite` and `record`.
    """
    # Separate seeds make these runs independent of the experiment's runs.
    stream = stream_seed(setup.seed, DESIGN)
    seeds = [stream_seed(stream, number) for number in range(count)]
    trajectories = []
    with (
        progress.stage("design the runs", count) as advance,
        mapped(workers, partial(_designed, setup), seeds) as designed,
    ):
        for trajectory in designed:
            trajectories.append(trajectory)
            advance()
    duration_s = setup.scenario.excitation.duration_s
    # These runs take the place of validation runs, so their duration is set as that of validation.
    scenario = setup.scenario.with_overrides({"validation.duration_s": duration_s})
    setup = replace(setup, scenario=scenario, seed=stream)
    plan = setup.sensor_plan
    taught = plan.taught(setup.robot, stream, progress).taught
    paths = tuple(trajectories)
    return run_unseen(setup.plant, plan, taught, paths, duration_s, stream, workers, progress)


def _designed(setup: Setup, seed: int) -> FourierTrajectory:
    return design_trajectories(setup.design, seed, SilentProgress()).excitation
