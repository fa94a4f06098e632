"""The experiment: the true plant runs a trajectory with the images in the loop, and what is seen is
recorded.

What is random is drawn from the streams of `identify.random_streams`.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import platformdirs
import xarray as xr

import cmmsim
from cmmsim.uncertainty.drift_watch import DriftWatch
from dynamics import Robot
from dynamics.closed_loop import ClosedLoopRun, RateSensor, Reference
from dynamics.closed_loop.command_schedule import acting_times
from identify.arrays import Array
from identify.errors import WriteError
from identify.estimation.prior import model_guess
from identify.estimation.scale_anchor import measured_anchor, store_anchor
from identify.excitation.design import design_trajectories
from identify.experiment.known_rig import known_rig
from identify.experiment.law_in_loop import KnownModel, NamedMotion, by_images, prepared
from identify.experiment.plant import Plant, PlatformLoad, build_plant, drawn_load
from identify.experiment.sensor_in_loop import (
    PoseSensor,
    SensorInLoop,
    make_sensor,
    sensor_file,
    with_renderer,
)
from identify.files.atomic import write_bytes
from identify.files.dataset import netcdf
from identify.filtering import spline_derivatives, without_gaps
from identify.progress import Advance, Progress, SilentProgress
from identify.random_streams import (
    ANCHOR,
    CALIBRATION,
    EXPOSURES,
    LATENCY,
    LOAD,
    MEAN_LATENCY,
    NOISE,
    TEACHING,
    stream_seed,
)
from identify.record import recording
from identify.record.common_errors import CommonErrors, store_common_errors
from identify.record.drift import store_finding
from identify.record.geometry_errors import store_geometry_covariance
from identify.record.law import SERVO, store_law
from identify.record.payload import store_payload
from identify.record.provenance import store_robot
from identify.scenario import Scenario
from identify.trajectory import FourierTrajectory, check_travel

PAYLOAD_RUN = 1_000_000
"""Number of the run under a payload, beyond all others."""


@dataclass(frozen=True)
class Latencies:
    """Of the frames of a run (frames,), s: the true ones, and as they are known to a law of control
    and to the record, which do not know how far their mean is from the scenario's. None: all are
    the scenario's."""

    true: Array | None = None
    known: Array | None = None


@dataclass(frozen=True)
class Experiment:
    """One run: what the experimenter sees, and the truth."""

    record: xr.Dataset
    truth: xr.Dataset


def run_experiment(
    scenario: Scenario,
    seed: int = 0,
    path: Path | str | None = None,
    progress: Progress | None = None,
    payload: bool = False,
) -> xr.Dataset:
    """Choose the exciting trajectory, run it with images in the loop, and return the record.

    payload: with the scenario's known load on the platform; such a record beside one without it
    shows the scale. The record holds the load as stated, the truth as drawn from its standard
    deviations.

    Record and truth are also written as netCDF: to `path`, or to the user's cache folder; attribute
    `path` says where (`identify.experiment.truth.read_truth(path)` opens the truth). Where the
    cache cannot be written, a warning says so, and there is no such attribute. Raises
    ScenarioError, TrajectoryError, WriteError, cmmsim.CmmError, dynamics.DynamicsError.
    """
    progress = progress or SilentProgress()
    scenario = with_renderer(scenario)
    plant = build_plant(scenario, seed=seed)
    trajectories = design_trajectories(plant.nominal, scenario, seed, progress)
    sensor = taught_sensor(scenario, plant.nominal, seed, progress)
    with progress.stage(
        "record", scenario.timing.frames(scenario.excitation.duration_s)
    ) as advance:
        experiment = excitation_run(plant, sensor, trajectories.excitation, seed, advance, payload)
    content = netcdf(recording.record_groups(experiment.record, experiment.truth))
    if path is not None:
        write_bytes(path, content, parents=True)
        return experiment.record.assign_attrs(path=str(path))
    kept = Path(platformdirs.user_cache_dir("cmmsim")) / "records"
    target = kept / f"{scenario.name}-{seed}{'-payload' if payload else ''}.nc"
    try:
        write_bytes(target, content, parents=True)
    except WriteError as error:
        warnings.warn(f"the record is not kept: {error}", stacklevel=2)
        return experiment.record
    return experiment.record.assign_attrs(path=str(target))


def taught_sensor(scenario: Scenario, robot: Robot, seed: int, progress: Progress) -> cmmsim.Sensor:
    """The scenario's sensor with its frames taught."""
    sensor = untaught_sensor(scenario, robot, seed, progress)
    teach(sensor, progress)
    return sensor


def untaught_sensor(
    scenario: Scenario, robot: Robot, seed: int, progress: Progress | None = None
) -> cmmsim.Sensor:
    """The scenario's sensor, its teaching and what is known of its rig seeded by the run's seed."""
    rng = np.random.default_rng(stream_seed(seed, CALIBRATION))
    known = known_rig(scenario, sensor_file(scenario), rng, progress)
    return make_sensor(scenario, robot, stream_seed(seed, TEACHING), known=known)


def teach(sensor: cmmsim.Sensor, progress: Progress) -> None:
    """Teach the frames of a sensor, in hundredths of the work."""
    with progress.stage("teach the sensor", 100) as advance:
        shown = 0

        def report(done: int, total: int) -> None:
            nonlocal shown
            advance(100 * done // total - shown)
            shown = 100 * done // total

        sensor.teach(report)


def excitation_run(
    plant: Plant,
    sensor: PoseSensor,
    trajectory: FourierTrajectory,
    seed: int,
    advance: Advance = lambda n=1: None,
    payload: bool = False,
) -> Experiment:
    """Run the plant along the exciting trajectory, bare or under the scenario's load. Raises as
    `run_plant` does.
    """
    duration_s = plant.scenario.excitation.duration_s
    law = plant.scenario.excitation.law
    if not payload:
        return run_plant(plant, sensor, trajectory, duration_s, seed, 0, advance, law=law)
    load = drawn_load(
        plant.robot.layout, plant.scenario, np.random.default_rng(stream_seed(seed, LOAD))
    )
    return run_plant(plant, sensor, trajectory, duration_s, seed, PAYLOAD_RUN, advance, load, law)


def run_plant(
    plant: Plant,
    sensor: PoseSensor,
    trajectory: FourierTrajectory,
    duration_s: float,
    seed: int,
    run: int,
    advance: Advance = lambda n=1: None,
    load: PlatformLoad | None = None,
    law: str = SERVO,
) -> Experiment:
    """Run the plant along a trajectory; `run`: number of the run (0: excitation); `load`: what the
    platform carries; `law`: under which it runs, with the scenario's starting model, and the load
    as stated.

    Raises TrajectoryError before the run when the trajectory leaves the travel, ScenarioError for a
    law that cannot be, LoopFailure when the loop is unstable.
    """
    scenario = plant.scenario
    times = plant.scenario.timing.frame_times(duration_s)
    check_travel(plant.nominal, trajectory, times, **scenario.excitation.singularity_limits)
    reference = trajectory.reference(times)
    part_exposures(sensor, scenario, seed)
    watch = _watched(sensor, scenario, len(times))
    eye = SensorInLoop(sensor, plant.robot, stream_seed(seed, NOISE, run), advance)
    latencies = drawn_latencies(scenario, len(times), seed, run)
    true_load = None if load is None else load.true
    in_loop = None
    if law != SERVO:
        motion = NamedMotion("the trajectory", trajectory, duration_s)
        model = model_guess(plant.nominal, scenario).values + (0.0 if load is None else load.stated)
        in_loop = prepared(plant, law, KnownModel(model), motion, by_images(eye), latencies.known)
    done = plant.run(reference, RateSensor(eye.measure), latencies.true, true_load, in_loop)
    record = _record(plant, reference, done, eye, seed, latencies.known)
    truth = plant.truth(done)
    if in_loop is not None:
        store_law(record, law, in_loop.drives)
    settings = scenario.identification
    rng = np.random.default_rng(stream_seed(seed, ANCHOR))
    layout = plant.robot.layout
    if not scenario.rig.exact and isinstance(sensor, cmmsim.Sensor) and done.measured_ok.any():
        poses = without_gaps(done.measured, done.measured_ok)
        found = sensor.common_errors(
            poses, spline_derivatives(poses, scenario.timing.frame_rate_hz)[0]
        )
        store_common_errors(record, CommonErrors(found.names, found.changes, found.covariance))
    if watch is not None and (finding := watch.finding).judged_frames:
        store_finding(record, finding.to_dict())
    store_anchor(
        record,
        measured_anchor(settings.scale_anchor, settings.anchor_std, layout, plant.parameters, rng),
    )
    if load is not None:
        store_payload(record, layout, load.stated, load.std)
        store_payload(truth, layout, load.true)
    return Experiment(record, truth)


def part_exposures(sensor: PoseSensor, scenario: Scenario, seed: int) -> None:
    """Have the right camera expose later than the left by what is not known of it, one draw for all
    runs of a seed.
    """
    rig = scenario.rig
    if isinstance(sensor, cmmsim.Sensor) and rig.right_later_s is None and rig.right_later_std_s:
        drawn = np.random.default_rng(stream_seed(seed, EXPOSURES)).standard_normal()
        sensor.move_rig(rig.errors, rig.right_later_std_s * drawn)


def _watched(sensor: PoseSensor, scenario: Scenario, frames: int) -> DriftWatch | None:
    """What watches the cameras during a run of so many frames, in which they drift as the scenario
    says; None where nothing can: poses by planes, or a sensor that draws no images."""
    if not isinstance(sensor, cmmsim.Sensor):
        return None
    sensor.drift_rig(scenario.rig.drift, frames)
    if scenario.rig.watch == "none" or sensor.method != "registration":
        return None
    return sensor.watch_drift(base=scenario.rig.watch == "both")


def drawn_latencies(scenario: Scenario, frames: int, seed: int, run: int) -> Latencies:
    """Latencies of the frames of a run. What is not known of their mean is one draw for all runs of
    a seed.
    """
    timing = scenario.timing
    known = timing.drawn_latencies(frames, np.random.default_rng(stream_seed(seed, LATENCY, run)))
    if not timing.latency_std_s:
        return Latencies(known, known)
    off = (
        timing.latency_std_s
        * np.random.default_rng(stream_seed(seed, MEAN_LATENCY)).standard_normal()
    )
    true = np.maximum((timing.latency_s if known is None else known) + np.full(frames, off), 0.0)
    return Latencies(true, known)


def _record(
    plant: Plant,
    reference: Reference,
    run: ClosedLoopRun,
    eye: SensorInLoop,
    seed: int,
    latencies: Array | None,
) -> xr.Dataset:
    """What is seen of a run; latencies (frames,) s as they are known, None: all are the
    scenario's."""
    latencies = (
        np.full(len(run.time), plant.scenario.timing.latency_s) if latencies is None else latencies
    )
    record = recording.build_record(
        time=run.time,
        reference_pose=reference.poses,
        reference_rate=reference.rates,
        measured_pose=run.measured,
        measured_covariance=np.array(eye.covariances),
        measured_ok=run.measured_ok,
        command=run.command,
        command_time=acting_times(run.time, latencies),
        scenario_toml=plant.scenario.to_toml(),
        robot=plant.nominal.name,
        seed=seed,
        frame_rate_hz=plant.scenario.timing.frame_rate_hz,
        prismatic=plant.nominal.layout.prismatic,
    )
    store_robot(record, plant.nominal)
    if plant.geometry_covariance is not None:
        store_geometry_covariance(record, plant.nominal, plant.geometry_covariance)
    return record.assign_attrs(sensor_seconds=eye.seconds, lost_frames="; ".join(eye.lost[:20]))
