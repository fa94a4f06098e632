"""Experiment: the true plant runs a trajectory with the sensor in the loop, and its record is kept.

All random numbers come from the streams of `identify.random_streams`.
"""

from dataclasses import dataclass

import numpy as np
import xarray as xr

import cmmsim
from cmmsim.uncertainty.drift_watch import DriftWatch
from dynamics import Robot
from dynamics.closed_loop import ClosedLoopRun, RateSensor, Reference
from dynamics.closed_loop.command_schedule import acting_times
from identify.arrays import Array
from identify.estimation.prior import model_guess
from identify.estimation.scale_anchor import measured_anchor, store_anchor
from identify.experiment.law_in_loop import KnownModel, NamedMotion, by_images, prepared
from identify.experiment.plant import Plant, PlatformLoad, drawn_load
from identify.experiment.rig_as_known import known_rig
from identify.experiment.sensor_in_loop import (
    PoseSensor,
    SensorInLoop,
    make_sensor,
    sensor_file,
)
from identify.filtering import spline_derivatives, without_gaps
from identify.progress import Advance, Progress
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
from identify.record.drift import store_finding
from identify.record.geometry_errors import store_geometry_covariance
from identify.record.payload import store_payload
from identify.record.provenance import store_robot
from identify.record.recorded_law import SERVO, store_law
from identify.record.stored_common_errors import CommonErrors, store_common_errors
from identify.scenario import Scenario
from identify.trajectory import FourierTrajectory, check_travel

PAYLOAD_RUN = 1_000_000
"""Number of the run under a payload, beyond all others."""


@dataclass(frozen=True)
class Latencies:
    """Latencies (frames,) [s] of the commands of a run. None stands for those of the scenario.

    ``true`` are those that act. ``known`` are those that a control law and the record see, which
    lack the unknown error of their mean.
    """

    true: Array | None = None
    known: Array | None = None


@dataclass(frozen=True)
class Experiment:
    """One run: the record that the experimenter sees, and the truth."""

    record: xr.Dataset
    truth: xr.Dataset


def taught_sensor(scenario: Scenario, robot: Robot, seed: int, progress: Progress) -> cmmsim.Sensor:
    """Return the scenario's sensor with its frames taught."""
    sensor = untaught_sensor(scenario, robot, seed, progress)
    teach(sensor, progress)
    return sensor


def untaught_sensor(
    scenario: Scenario, robot: Robot, seed: int, progress: Progress | None = None
) -> cmmsim.Sensor:
    """Return the scenario's sensor before teaching.

    The run's seed decides its noise in teaching, and the error of the known rig.
    """
    rng = np.random.default_rng(stream_seed(seed, CALIBRATION))
    known = known_rig(scenario, sensor_file(scenario), rng, progress)
    return make_sensor(scenario, robot, stream_seed(seed, TEACHING), known=known)


def teach(sensor: cmmsim.Sensor, progress: Progress) -> None:
    """Teach the frames of a sensor, and report the progress in hundredths."""
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
    """Run the plant along the exciting trajectory, without or with the scenario's load.

    Raises the errors of `run_plant`.
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
    """Run the plant along a trajectory.

    Parameters
    ----------
    plant : Plant
        True robot in its loop.
    sensor : PoseSensor
        Sensor in the loop.
    trajectory : FourierTrajectory
        Desired motion.
    duration_s : float
        Length of the run.
    seed : int
        Seed of the experiment.
    run : int
        Number of the run; 0 is the excitation.
    advance : callable
        Receiver of the progress, once a frame.
    load : PlatformLoad, optional
        Load on the platform.
    law : str
        Name of the control law. It knows the scenario's starting model and the stated load.

    Raises
    ------
    TrajectoryError
        If the trajectory leaves the travel. This is checked before the run.
    ScenarioError
        If the law is not possible.
    LoopFailure
        If the loop is unstable.
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
        # The law knows no more than an experimenter: starting model and stated load.
        guess = model_guess(plant.nominal, scenario.model, scenario.identification)
        model = guess.values + (0.0 if load is None else load.stated)
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
        # An exposure that is late shifts a pose by its rate, so the rates are needed, too.
        poses = without_gaps(done.measured, done.measured_ok)
        rates = spline_derivatives(poses, scenario.timing.frame_rate_hz)[0]
        found = sensor.common_errors(poses, rates)
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
    """Delay the right camera's exposure by a random draw from its stated uncertainty.

    All runs of a seed have the same delay.
    """
    rig = scenario.rig
    if isinstance(sensor, cmmsim.Sensor) and rig.right_later_s is None and rig.right_later_std_s:
        drawn = np.random.default_rng(stream_seed(seed, EXPOSURES)).standard_normal()
        sensor.move_rig(rig.errors, rig.right_later_std_s * drawn)


def _watched(sensor: PoseSensor, scenario: Scenario, frames: int) -> DriftWatch | None:
    """Let the cameras drift during a run of this many frames, and return their watch.

    It is None where nothing can be watched: for poses by planes, or a sensor without images.
    """
    if not isinstance(sensor, cmmsim.Sensor):
        return None
    sensor.drift_rig(scenario.rig.drift, frames)
    if scenario.rig.watch == "none" or sensor.method != "registration":
        return None
    return sensor.watch_drift(base=scenario.rig.watch == "both")


def drawn_latencies(scenario: Scenario, frames: int, seed: int, run: int) -> Latencies:
    """Draw the latencies of the frames of a run.

    The unknown error of their mean is the same for all runs of a seed.
    """
    timing = scenario.timing
    known = timing.drawn_latencies(frames, np.random.default_rng(stream_seed(seed, LATENCY, run)))
    if not timing.latency_std_s:
        return Latencies(known, known)
    drawn = np.random.default_rng(stream_seed(seed, MEAN_LATENCY)).standard_normal()
    off = timing.latency_std_s * drawn
    # No command acts before it is issued.
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
    """Record of a run with the known latencies (frames,) [s]; None stands for the scenario's."""
    if latencies is None:
        latencies = np.full(len(run.time), plant.scenario.timing.latency_s)
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
    # Twenty reasons are enough to see why frames were lost.
    return record.assign_attrs(sensor_seconds=eye.seconds, lost_frames="; ".join(eye.lost[:20]))
