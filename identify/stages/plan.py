"""Plan of a run: its trajectories and its scenario, which all later stages read."""

import time
from pathlib import Path

import xarray as xr

import cmmsim
from dynamics import Robot, load_robot
from identify.errors import EstimationError
from identify.excitation.design import design_trajectories
from identify.experiment.plant import Plant, build_plant
from identify.experiment.run import teach, untaught_sensor
from identify.experiment.sensor_in_loop import check_platform, sensor_file, with_renderer
from identify.experiment.warm_up import compile_robots
from identify.files.atomic import write_files
from identify.files.run_folder import (
    RunFolder,
)
from identify.files.seal import sealed_toml
from identify.geometry.before_a_run import calibrated_for_a_run
from identify.geometry.outcome import GeometryOutcome
from identify.loop_parameters import check_parameter_set
from identify.progress import Progress
from identify.record.checks import check_length, check_trajectory, fewest_frames
from identify.record.known_geometry import FOLDER, KnownGeometry, known_geometry
from identify.record.provenance import RECORDS
from identify.scenario import Scenario, load_scenario
from identify.trajectory import TrajectorySet, check_travel, load_trajectories, trajectories_json


def is_begun(scenario: Scenario, seed: int, folder: Path) -> bool:
    """Tell whether a folder has the plan of this run, and no report yet."""
    run_folder = RunFolder(folder)
    if not (run_folder.scenario.is_file() and run_folder.trajectories.is_file()):
        return False
    if run_folder.report.exists():
        return False
    text = sealed_toml(with_renderer(scenario).to_toml())
    same = run_folder.scenario.read_text(encoding="utf-8", errors="replace") == text
    return same and load_trajectories(run_folder.trajectories).seed == seed


def begin(
    scenario: Scenario, seed: int, folder: Path, progress: Progress
) -> tuple[cmmsim.Sensor, Plant, dict[str, float]]:
    """Excite and teach; return the taught sensor, the plant, and the seconds of each stage."""
    began = time.perf_counter()
    calibration, known = _calibrated(scenario, seed, progress)
    calibrated_at = time.perf_counter()
    plant = build_plant(scenario, seed=seed, known=known)
    sensor = untaught_sensor(scenario, plant.nominal, seed)
    # Fail before the search for a trajectory, which takes time.
    if scenario.renderer == "pyrender":
        cmmsim.require_opengl()
    trajectories = _designed(plant, seed, progress)
    excited_at = time.perf_counter()
    teach(sensor, progress)
    taught_at = time.perf_counter()
    _write_plan(folder, scenario, trajectories, calibration)
    seconds = {"geometry": calibrated_at - began} if calibration else {}
    seconds |= {"excite": excited_at - calibrated_at, "teach": taught_at - excited_at}
    return sensor, plant, seconds


def excite(scenario: Scenario, seed: int, folder: Path, progress: Progress) -> None:
    """Choose the trajectories; write scenario.toml and trajectories.json.

    The folder geometry is also written if the run calibrates it.
    """
    scenario = with_renderer(scenario)
    calibration, known = _calibrated(scenario, seed, progress)
    plant = build_plant(scenario, seed=seed, known=known)
    check_platform(plant.nominal, sensor_file(scenario), scenario.sensor)
    _write_plan(folder, scenario, _designed(plant, seed, progress), calibration)


def open_run(folder: Path) -> tuple[RunFolder, Scenario, TrajectorySet, KnownGeometry]:
    """Read the plan of a run folder and the geometry that its estimator knows."""
    run_folder = RunFolder(folder)
    scenario = load_scenario(run_folder.whole_scenario)
    return (
        run_folder,
        scenario,
        load_trajectories(run_folder.trajectories),
        known_geometry(load_robot(scenario.robot), scenario.geometry, folder),
    )


def _calibrated(
    scenario: Scenario, seed: int, progress: Progress
) -> tuple[GeometryOutcome | None, KnownGeometry]:
    """Calibration of the geometry before a run, if there is one, and the known geometry."""
    if scenario.geometry.known != "calibrated":
        return None, known_geometry(load_robot(scenario.robot), scenario.geometry)
    return calibrated_for_a_run(scenario, seed, progress)


def check_planned(
    file: Path, record: xr.Dataset, scenario: Scenario, trajectories: TrajectorySet
) -> None:
    """Raise EstimationError if a file's record does not follow the planned trajectory."""
    try:
        duration_s = scenario.excitation.duration_s
        check_trajectory(record, trajectories.excitation, scenario.timing, duration_s)
    except EstimationError as error:
        raise EstimationError(f"{file}: {error}") from None


def record_files(scenario: Scenario) -> tuple[str, ...]:
    """Return the names of the record and, if the scenario asks for one, of the run under a load."""
    return RECORDS if scenario.identification.scale_anchor == "payload" else RECORDS[:1]


def _designed(plant: Plant, seed: int, progress: Progress) -> TrajectorySet:
    """Trajectories that avoid limits and singularities. The robot is compiled on first use."""
    scenario = plant.scenario
    robot = plant.nominal
    check_length(
        scenario.timing.frames(scenario.excitation.duration_s),
        fewest_frames(scenario.timing, scenario.filter, scenario.excitation),
        scenario.timing.frame_rate_hz,
        "excitation.duration_s gives",
    )
    check_parameter_set(robot, scenario.model.start_parameters)
    compile_robots((robot, plant.robot), progress)
    plant.check()
    trajectories = design_trajectories(robot, scenario, seed, progress)
    _check_singularities(robot, scenario, trajectories)
    return trajectories


def _write_plan(
    folder: Path,
    scenario: Scenario,
    trajectories: TrajectorySet,
    calibration: GeometryOutcome | None,
) -> None:
    """Write the scenario last: with it a plan is finished."""
    if calibration is not None:
        calibration.write(folder / FOLDER)
    plan = {RunFolder(folder).trajectories: trajectories_json(trajectories).encode()}
    write_files(plan | scenario_file(RunFolder(folder), scenario), parents=True)


def scenario_file(run_folder: RunFolder, scenario: Scenario) -> dict[Path, bytes]:
    """Return the content of the scenario's file, by its path."""
    return {run_folder.scenario: sealed_toml(scenario.to_toml()).encode()}


def _check_singularities(robot: Robot, scenario: Scenario, trajectories: TrajectorySet) -> None:
    """Raise TrajectoryError if a trajectory comes near a singularity (section 3.3).

    The message names time and leg.
    """
    durations = [scenario.excitation.duration_s] + [scenario.validation.duration_s] * len(
        trajectories.validation
    )
    for trajectory, duration in zip(
        (trajectories.excitation, *trajectories.validation), durations, strict=True
    ):
        check_travel(
            robot,
            trajectory,
            scenario.timing.frame_times(duration),
            **scenario.excitation.singularity_limits,
        )
