"""The stages of a run, each reading what the one before wrote into the run folder."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import xarray as xr

import cmmsim
from dynamics import Robot
from identify.arrays import Array
from identify.errors import EstimationError, OutputFolderError, RecordError
from identify.estimation import identification
from identify.estimation.result import IdentificationResult
from identify.excitation.design import design_trajectories
from identify.experiment.plant import Plant, build_plant
from identify.experiment.run import compile_robots, excitation_run, taught_sensor, teach, untaught_sensor
from identify.experiment.sensor_in_loop import check_platform, sensor_file, with_renderer
from identify.experiment.truth import read_truth, true_parameters
from identify.files.atomic import write_text
from identify.files.dataset import write_covariance
from identify.files.run_folder import RunFolder, check_entries, load_result, rms_figures, save_result
from identify.files.versions import versions
from identify.geometry.outcome import GeometryOutcome
from identify.geometry.run import calibrated_for_a_run
from identify.loop_parameters import check_parameter_set, settled_drive, with_drive
from identify.progress import Progress
from identify.record import recording
from identify.record.checks import check_length, check_trajectory
from identify.record.drift import DRIFT, read_finding
from identify.record.geometry_errors import COVARIANCE as GEOMETRY_COVARIANCE
from identify.record.geometry_errors import store_geometry_covariance
from identify.record.known_geometry import FOLDER, KnownGeometry, known_geometry
from identify.record.own_record import read_own_records
from identify.record.provenance import ENTRY, RECORDS, RunFiles, check_robot, digest
from identify.record.recording import build_model_run, write_model_runs
from identify.reporting.run_result import add_truth, parameter_vector, prediction_entry, sensor_entry, validation_entry
from identify.scenario import Scenario, load_scenario
from identify.scenario.scenario import estimator_settings, with_estimator_settings
from identify.trajectory import TrajectorySet, check_travel, load_trajectories, save_trajectories
from identify.validation.unseen import model_on_record, predicted_runs, run_unseen


def run(scenario: Scenario, seed: int, folder: Path, progress: Progress, workers: int | None = None) -> None:
    """All stages: excite, record, identify, validate, report. What cannot work is refused before any file."""
    began, scenario = time.perf_counter(), with_renderer(scenario)
    calibration, known = _calibrated(scenario, seed, progress)
    calibrated_at = time.perf_counter()
    plant = build_plant(scenario, seed=seed, known=known)
    sensor = untaught_sensor(scenario, plant.nominal, seed)
    if scenario.renderer == "pyrender":
        cmmsim.require_opengl()
    trajectories = _designed(plant, seed, progress)
    excited_at = time.perf_counter()
    teach(sensor, progress)
    taught_at = time.perf_counter()
    _write_plan(folder, scenario, trajectories, calibration)
    taught = record(folder, progress, workers, sensor, plant)
    identify(folder, progress)
    validate(folder, progress, workers, taught)
    report(folder, progress)
    seconds = {"geometry": calibrated_at - began} if calibration else {}
    seconds |= {"excite": excited_at - calibrated_at, "teach": taught_at - excited_at}
    seconds["total"] = time.perf_counter() - began
    _add_seconds(RunFolder(folder), **seconds)


def excite(scenario: Scenario, seed: int, folder: Path, progress: Progress) -> None:
    """Choose the trajectories; writes scenario.toml and trajectories.json, and the folder geometry, where that is
    calibrated."""
    scenario = with_renderer(scenario)
    calibration, known = _calibrated(scenario, seed, progress)
    plant = build_plant(scenario, seed=seed, known=known)
    check_platform(plant.nominal, sensor_file(scenario), scenario.sensor)
    _write_plan(folder, scenario, _designed(plant, seed, progress), calibration)


def record(
    folder: Path,
    progress: Progress,
    workers: int | None = None,
    sensor: cmmsim.Sensor | None = None,
    plant: Plant | None = None,
) -> cmmsim.Taught:
    """Run the plant on the exciting trajectory; writes experiment.nc, and payload.nc where the scale anchor is a
    payload. Returns what the sensor was taught.

    sensor, plant: those of the scenario where they are at hand, the sensor taught.
    """
    run_folder, scenario, trajectories, known = _open(folder)
    began = time.perf_counter()
    sensor = sensor or taught_sensor(scenario, known.robot, trajectories.seed, progress)
    plant = plant or build_plant(scenario, seed=trajectories.seed, known=known)
    names = _record_files(scenario)
    frames = scenario.timing.frames(scenario.excitation.duration_s)
    with progress.stage("record", frames * len(names)) as advance:
        for name in names:
            loaded = name == run_folder.payload.name
            experiment = excitation_run(plant, sensor, trajectories.excitation, trajectories.seed, advance, loaded)
            stored = experiment.record.assign_attrs(record_seconds=time.perf_counter() - began)
            recording.write(run_folder.path / name, stored, experiment.truth)
    return sensor.taught


def identify(folder: Path, progress: Progress, settings: Mapping[str, Any] | None = None) -> None:
    """Estimate the parameters from the record; writes result.json (without the truth) and covariance.nc.

    settings: of the estimator, by dotted path, instead of the scenario's. Once they have given a result, scenario.toml
    holds them for the stages that follow.
    Raises as `identification.identify` does, and ScenarioError for a setting that the record was made with.
    """
    run_folder = RunFolder(folder)
    if run_folder.holds_own_record:
        planned, seed = load_scenario(run_folder.scenario), None
    else:
        _, planned, trajectories, _ = _open(folder)
        seed = trajectories.seed
    scenario = with_estimator_settings(planned, settings or {})
    files, names = RunFiles(run_folder), _record_files(scenario)
    run_folder.require(*names)
    records = {name: files.content(name) for name in names}
    if seed is not None:
        for name, one in records.items():
            _check_planned(run_folder.path / name, one, scenario, trajectories)
    found = _identified(records, scenario, progress, folder)
    if scenario != planned:
        write_text(run_folder.scenario, scenario.to_toml())
    _write_identified(run_folder, found, scenario, seed)


def identify_own(paths: Sequence[Path], folder: Path, progress: Progress, settings: Mapping[str, Any]) -> None:
    """Estimate the parameters from records of one's own, `read_own_records`; writes a run folder without the truth.

    Nothing is written where they cannot carry an identification. Raises as `identify`, and as `read_own_records`.
    """
    run_folder = RunFolder(folder)
    contents, stated = read_own_records(list(paths))
    scenario = with_estimator_settings(stated, settings)
    records, known = dict(zip(RECORDS, contents, strict=False)), known_geometry(scenario)
    for one in contents:
        if known.covariance is not None and GEOMETRY_COVARIANCE not in one:
            store_geometry_covariance(one, known.robot, known.covariance)
    found = _identified(records, scenario, progress)
    folder.mkdir(parents=True, exist_ok=True)
    write_text(run_folder.scenario, scenario.to_toml())
    for name, one in records.items():
        recording.write(run_folder.path / name, one)
    _write_identified(run_folder, found, scenario, None)


@dataclass(frozen=True)
class _Identified:
    """Records by file, what an identification made of them, the models' poses (N, 6) on the first, before and after,
    and the time that it took."""

    records: Mapping[str, xr.Dataset]
    result: IdentificationResult
    models: tuple[Array, Array]
    seconds: float

    @property
    def record(self) -> xr.Dataset:
        """The first record."""
        return next(iter(self.records.values()))


def _identified(
    records: Mapping[str, xr.Dataset], scenario: Scenario, progress: Progress, folder: Path | None = None
) -> _Identified:
    began, robot = time.perf_counter(), known_geometry(scenario, folder).robot
    result = identification.identify(list(records.values()), robot, scenario, progress)
    first, scenario = next(iter(records.values())), with_drive(scenario, result.drive.law)
    before, after = (model_on_record(robot, scenario, values, first) for values in (result.initial, result.estimate))
    return _Identified(records, result, (before, after), time.perf_counter() - began)


def _write_identified(run_folder: RunFolder, found: _Identified, scenario: Scenario, seed: int | None) -> None:
    """Write covariance.nc and result.json; and of a record of one's own, which has no seed, model.nc: `validate`, which
    writes it else, has nothing to judge it by."""
    seen, result = found.record, found.result
    measured, ok = recording.poses(seen, "measured"), seen["measured_ok"].values.astype(bool)
    before, after = found.models
    covariance = result.whole_covariance
    made_of = {name: digest(one) for name, one in found.records.items()} | {"covariance.nc": digest(covariance)}
    if seed is None:
        runs = write_model_runs(run_folder.model, build_model_run(seen["time"].values, before, after))
        made_of["model.nc"] = digest(runs)
    seconds = {f"identify.{stage}": value for stage, value in result.seconds.items()}
    write_covariance(run_folder.covariance, result.layout, covariance, result.common_errors.names)
    save_result(
        run_folder.result,
        {
            "scenario": scenario.name,
            "seed": seed,
            "settings": estimator_settings(scenario),
            "date": str(seen.attrs.get("created", ""))[:10] or None,
            "versions": versions(),
            ENTRY: made_of,
            "seconds": {"record": seen.attrs.get("record_seconds"), "identify": found.seconds, **seconds},
            DRIFT: read_finding(seen),
            "identification": result.to_dict(),
            "before": rms_figures(before - measured, ok),
            "after": rms_figures(after - measured, ok),
        },
    )


def validate(folder: Path, progress: Progress, workers: int | None = None, taught: cmmsim.Taught | None = None) -> None:
    """Run plant and models on the unseen trajectories and open the truth: validation.nc, model.nc, result.json.

    Raises RecordError for a result that is not whole, or was made of another record or covariance. Raises
    OutputFolderError for a record of one's own, whose truth nobody knows.
    """
    if RunFolder(folder).holds_own_record:
        raise OutputFolderError(
            f"{folder} holds a record of your own: no plant is there that could run unseen trajectories; go on with: "
            f"cmmsim report --out {folder}"
        )
    run_folder, scenario, trajectories, known = _open(folder)
    began, robot = time.perf_counter(), known.robot
    run_folder.require("covariance.nc")
    files, result = RunFiles(run_folder), load_result(run_folder.result)
    check_robot(files.experiment, robot)
    _check_planned(run_folder.experiment, files.experiment, scenario, trajectories)
    excitation_truth = read_truth(run_folder.experiment)
    check_entries(run_folder.result, result, "identify")
    files.check_made_of(*RECORDS, run_folder.covariance.name, result=result)
    covariance = files.covariance_of(robot)
    models = _identified_models(robot, run_folder, result)
    scenario = with_drive(scenario, settled_drive(result["identification"]))
    taught = taught or taught_sensor(scenario, robot, trajectories.seed, progress).taught
    runs = run_unseen(scenario, trajectories.validation, trajectories.seed, taught, workers, progress, known)
    recording.write_runs(run_folder.validation, [(unseen.record, unseen.truth) for unseen in runs])
    records = [files.experiment, *(run.record for run in runs)]
    model_poses = [[model_on_record(robot, scenario, values, seen) for values in models] for seen in records]
    found = result["identification"].get("nuisance_estimates", {})
    predictions = predicted_runs(
        robot, scenario, records[1:], models[1], covariance, trajectories.seed, progress, found
    )
    deviations = [None, *(prediction.std for prediction in predictions)]
    drawn = [
        build_model_run(seen["time"].values, initial, identified, std)
        for seen, (initial, identified), std in zip(records, model_poses, deviations, strict=True)
    ]
    model_runs = write_model_runs(run_folder.model, drawn[0], drawn[1:])
    pairs = [(files.experiment, excitation_truth), *((run.record, run.truth) for run in runs)]
    result["sensor"] = sensor_entry(pairs)
    result["validation"] = [
        validation_entry(*pair, *poses) | prediction_entry(prediction, pair[1])
        for pair, poses, prediction in zip(pairs[1:], model_poses[1:], predictions, strict=True)
    ]
    add_truth(result["identification"], true_parameters(excitation_truth))
    result[ENTRY] = result.get(ENTRY, {}) | {"validation.nc": digest(records[1:]), "model.nc": digest(model_runs)}
    result["seconds"]["validate"] = time.perf_counter() - began
    save_result(run_folder.result, result)


def report(folder: Path, progress: Progress) -> None:
    """Draw the figures and write report.html."""
    from identify.reporting.report import write_report  # imports Matplotlib, for which no other stage waits

    began = time.perf_counter()
    write_report(folder, progress)
    _add_seconds(RunFolder(folder), report=time.perf_counter() - began)


def _open(folder: Path) -> tuple[RunFolder, Scenario, TrajectorySet, KnownGeometry]:
    run_folder = RunFolder(folder)
    scenario = load_scenario(run_folder.scenario)
    return run_folder, scenario, load_trajectories(run_folder.trajectories), known_geometry(scenario, folder)


def _calibrated(scenario: Scenario, seed: int, progress: Progress) -> tuple[GeometryOutcome | None, KnownGeometry]:
    """The calibration of the geometry that precedes a run, where there is one, and what is known of the geometry."""
    if scenario.geometry.known != "calibrated":
        return None, known_geometry(scenario)
    return calibrated_for_a_run(scenario, seed, progress)


def _check_planned(file: Path, record: xr.Dataset, scenario: Scenario, trajectories: TrajectorySet) -> None:
    """The record of a file must be of the folder's exciting trajectory."""
    try:
        check_trajectory(record, trajectories.excitation, scenario)
    except EstimationError as error:
        raise EstimationError(f"{file}: {error}") from None


def _record_files(scenario: Scenario) -> tuple[str, ...]:
    """The file of the record and, where the scenario asks for one, that of the run under a load."""
    return RECORDS if scenario.identification.scale_anchor == "payload" else RECORDS[:1]


def _designed(plant: Plant, seed: int, progress: Progress) -> TrajectorySet:
    """Trajectories that stay clear of limits and singularities; compiles the robot on first use."""
    scenario, robot = plant.scenario, plant.nominal
    check_length(scenario.timing.frames(scenario.excitation.duration_s), scenario, "excitation.duration_s gives")
    check_parameter_set(robot, scenario.model.start_parameters)
    compile_robots((robot, plant.robot), progress)
    plant.check()
    trajectories = design_trajectories(robot, scenario, seed, progress)
    _check_singularities(robot, scenario, trajectories)
    return trajectories


def _write_plan(
    folder: Path, scenario: Scenario, trajectories: TrajectorySet, calibration: GeometryOutcome | None
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    if calibration is not None:
        calibration.write(folder / FOLDER)
    write_text(RunFolder(folder).scenario, scenario.to_toml())
    save_trajectories(RunFolder(folder).trajectories, trajectories)


def _check_singularities(robot: Robot, scenario: Scenario, trajectories: TrajectorySet) -> None:
    """Raise TrajectoryError, with time and leg, where a trajectory comes near a singularity (section 3.3)."""
    durations = [scenario.excitation.duration_s] + [scenario.validation.duration_s] * len(trajectories.validation)
    for trajectory, duration in zip((trajectories.excitation, *trajectories.validation), durations, strict=True):
        check_travel(robot, trajectory, scenario.timing.frame_times(duration), **scenario.excitation.singularity_limits)


def _identified_models(robot: Robot, run_folder: RunFolder, result: dict[str, Any]) -> list[Array]:
    """Parameters (p,) of the starting and of the identified model."""
    try:
        return [parameter_vector(robot, result["identification"], column) for column in ("initial", "estimate")]
    except RecordError as error:
        again = f"run `cmmsim identify --out {run_folder.path}` again"
        raise RecordError(f"{run_folder.result}: {error}; {again}") from None


def _add_seconds(run_folder: RunFolder, **seconds: float) -> None:
    result = load_result(run_folder.result)
    result["seconds"].update(seconds)
    save_result(run_folder.result, result)
