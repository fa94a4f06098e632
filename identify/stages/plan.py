"""Plan of a run: its trajectories and its scenario. All later stages read them."""

import time
from dataclasses import replace
from pathlib import Path

import xarray as xr

import cmmsim
from dynamics import load_robot
from identify.errors import EstimationError
from identify.excitation.design import design_trajectories
from identify.experiment.sensor_in_loop import check_platform, teach
from identify.experiment.warm_up import compile_robots
from identify.files.atomic import write_files
from identify.files.digest import toml_with_digest
from identify.files.run_folder import (
    RunFolder,
)
from identify.geometry.before_a_run import run_geometry
from identify.geometry.outcome import GeometryOutcome
from identify.loop_parameters import check_parameter_set, in_form
from identify.progress import Progress
from identify.record.checks import check_length, check_trajectory, fewest_frames
from identify.record.known_geometry import FOLDER, KnownGeometry, known_geometry
from identify.record.provenance import RECORDS
from identify.scenario import load_scenario
from identify.scenario.sections import Identification
from identify.setup import Setup
from identify.trajectory import TrajectorySet, check_travel, load_trajectories, trajectories_json


def is_begun(setup: Setup, folder: Path) -> bool:
    """Return whether a folder has the plan of this run, and no report yet."""
    return is_planned(setup, folder) and not RunFolder(folder).report.exists()


def is_planned(setup: Setup, folder: Path) -> bool:
    """Return whether a folder has the plan of this run: its scenario and its seed."""
    run_folder = RunFolder(folder)
    if not (run_folder.scenario.is_file() and run_folder.trajectories.is_file()):
        return False
    text = toml_with_digest(setup.scenario.to_toml())
    same = run_folder.scenario.read_text(encoding="utf-8", errors="replace") == text
    return same and load_trajectories(run_folder.trajectories).seed == setup.seed


def begin(setup: Setup, folder: Path, progress: Progress) -> tuple[Setup, dict[str, float]]:
    """Design the trajectories, teach the sensor, and write the plan into a folder.

    Returns the setup with the taught sensor, and the duration of each stage in seconds.
    """
    began = time.perf_counter()
    calibration, setup = _calibrated(setup, progress)
    calibrated_at = time.perf_counter()
    # Errors of plant, sensor and OpenGL are raised before the search for a trajectory, which takes
    # long.
    _ = setup.plant, setup.sensor
    if setup.scenario.renderer in ("pyrender", "scene"):
        cmmsim.require_opengl()
    trajectories = _designed(setup, progress)
    excited_at = time.perf_counter()
    teach(setup.sensor, progress)
    taught_at = time.perf_counter()
    _write_plan(folder, setup, trajectories, calibration)
    seconds = {"geometry": calibrated_at - began} if calibration else {}
    seconds |= {"excite": excited_at - calibrated_at, "teach": taught_at - excited_at}
    return setup, seconds


def excite(setup: Setup, folder: Path, progress: Progress) -> None:
    """Choose the trajectories, and write scenario.toml and trajectories.json.

    If the run calibrates the geometry, the folder geometry is also written.
    """
    calibration, setup = _calibrated(setup, progress)
    plan = setup.sensor_plan
    check_platform(setup.robot, plan.file, plan.name)
    _write_plan(folder, setup, _designed(setup, progress), calibration)


def open_run(
    folder: Path, progress: Progress | None = None
) -> tuple[RunFolder, Setup, TrajectorySet]:
    """Read the plan of a run folder. The setup has the geometry that the estimator knows."""
    run_folder = RunFolder(folder)
    scenario = load_scenario(run_folder.whole_scenario)
    trajectories = load_trajectories(run_folder.trajectories)
    robot = load_robot(scenario.robot)
    known = known_geometry(in_form(robot, scenario.model), scenario.geometry, folder)
    return run_folder, Setup(scenario, trajectories.seed, robot, known, progress), trajectories


def _calibrated(setup: Setup, progress: Progress) -> tuple[GeometryOutcome | None, Setup]:
    """Return the geometry calibration before a run, or None, and the setup that uses it."""
    if setup.scenario.geometry.known != "calibrated":
        return None, setup
    outcome = run_geometry(setup, progress)
    nominal = outcome.calibration.nominal
    calibrated = outcome.calibration.robot.geometry
    robot = nominal.moved(calibrated.deviations_from(nominal.geometry))
    known = KnownGeometry(robot, outcome.calibration.covariance)
    return outcome, replace(setup, loaded=setup.in_file, calibrated=known)


def check_planned(
    file: Path, record: xr.Dataset, setup: Setup, trajectories: TrajectorySet
) -> None:
    """Raise EstimationError if a file's record does not follow the planned exciting trajectory."""
    scenario = setup.scenario
    try:
        duration_s = scenario.excitation.duration_s
        check_trajectory(record, trajectories.excitation, scenario.timing, duration_s)
    except EstimationError as error:
        raise EstimationError(f"{file}: {error}") from None


def record_files(settings: Identification) -> tuple[str, ...]:
    """Return the file names of the record and, if it is the anchor, of the run with the payload."""
    return RECORDS if settings.scale_anchor == "payload" else RECORDS[:1]


def identified_files(run_folder: RunFolder, settings: Identification) -> tuple[str, ...]:
    """Return the names of the files from which a run identifies: planned, or a user's own."""
    return run_folder.records if run_folder.holds_own_record else record_files(settings)


def own_record_files(count: int, settings: Identification) -> tuple[str, ...]:
    """Return the file names for a number of a user's own records, in their order."""
    if count == len(RECORDS) and settings.scale_anchor == "payload":
        return RECORDS
    return (RECORDS[0], *(f"experiment{number:02d}.nc" for number in range(2, count + 1)))


def _designed(setup: Setup, progress: Progress) -> TrajectorySet:
    """Return trajectories that avoid limits and singularities. The robot is compiled first."""
    scenario = setup.scenario
    plant = setup.plant
    robot = plant.nominal
    check_length(
        scenario.timing.frames(scenario.excitation.duration_s),
        fewest_frames(scenario.timing, scenario.filter, scenario.excitation),
        scenario.timing.frame_rate_hz,
        "excitation.duration_s gives",
    )
    check_parameter_set(robot, scenario.model.start_parameters)
    # Fast checks come first, because compiling takes seconds, and the search minutes.
    compile_robots((robot, plant.robot), progress)
    plant.check()
    trajectories = design_trajectories(setup.design, setup.seed, progress)
    # The message of check_travel names time and leg of a singularity (section 3.3).
    unseen = [(path, scenario.validation.duration_s) for path in trajectories.validation]
    for path, duration_s in [(trajectories.excitation, scenario.excitation.duration_s), *unseen]:
        check_travel(robot, path, scenario.timing.frame_times(duration_s), **plant.runs.limits)
    return trajectories


def _write_plan(
    folder: Path, setup: Setup, trajectories: TrajectorySet, calibration: GeometryOutcome | None
) -> None:
    """Write the plan. The scenario is written last, and marks a complete plan."""
    run_folder = RunFolder(folder)
    if calibration is not None:
        calibration.write(folder / FOLDER)
    plan = {run_folder.trajectories: trajectories_json(trajectories).encode()}
    write_files(plan | scenario_file(run_folder, setup.scenario.to_toml()), parents=True)


def scenario_file(run_folder: RunFolder, text: str) -> dict[Path, bytes]:
    """Return the content of the scenario file, by its path."""
    return {run_folder.scenario: toml_with_digest(text).encode()}
