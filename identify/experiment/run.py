"""Experiment: the true plant follows a trajectory with the sensor in the loop, and is recorded.

All random numbers come from the streams of `identify.random_streams`.
"""

from dataclasses import dataclass

import numpy as np
import xarray as xr

import cmmsim
from cmmsim.uncertainty.drift_watch import DriftWatch
from dynamics.closed_loop import ClosedLoopRun, Reference
from dynamics.closed_loop.command_schedule import acting_times
from identify.arrays import Array
from identify.estimation.prior import starting_guess
from identify.estimation.scale_anchor import measured_anchor, store_anchor
from identify.experiment.law_in_loop import KnownModel, NamedMotion, by_images, prepared
from identify.experiment.plant import Plant, PlatformLoad, drawn_load
from identify.experiment.sensor_in_loop import PoseSensor, SensorInLoop
from identify.filtering import spline_derivatives, without_gaps
from identify.progress import Advance
from identify.random_streams import (
    ANCHOR,
    EXPOSURES,
    LATENCY,
    LOAD,
    MEAN_LATENCY,
    NOISE,
    stream_seed,
)
from identify.record import recording
from identify.record.conditions import SERVO, store_finding, store_law
from identify.record.files_of_record import store_robot_file
from identify.record.known_geometry import store_geometry_covariance
from identify.record.load import store_load
from identify.record.provenance import store_robot
from identify.record.stored_common_errors import CommonErrors, store_common_errors
from identify.scenario import Excitation, Timing
from identify.scenario.payload import Payload
from identify.scenario.sections import Rig
from identify.trajectory import FourierTrajectory, check_travel

PAYLOAD_RUN = 1_000_000  # number of the run under a payload, larger than all other numbers of runs


@dataclass(frozen=True)
class Latencies:
    """Latencies (frames,) [s] of the commands of a run. None means the scenario's latency.

    ``true`` are the true latencies. ``known`` are the latencies for control law and record, without
    the unknown error of their mean.
    """

    true: Array | None = None
    known: Array | None = None


@dataclass(frozen=True)
class Experiment:
    """Record and truth of one run."""

    record: xr.Dataset
    truth: xr.Dataset


def excitation_run(
    plant: Plant,
    sensor: PoseSensor,
    trajectory: FourierTrajectory,
    settings: Excitation,
    seed: int,
    advance: Advance = lambda n=1: None,
    payload: Payload | None = None,
) -> Experiment:
    """Run the plant along the exciting trajectory, without or with a known load.

    Raises the errors of `run_plant`.
    """
    load = None
    number = 0
    if payload is not None:
        number = PAYLOAD_RUN
        rng = np.random.default_rng(stream_seed(seed, LOAD))
        load = drawn_load(plant.robot.layout, payload, rng)
    return run_plant(
        plant, sensor, trajectory, settings.duration_s, seed, number, advance, load, settings.law
    )


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

    plant       True robot in its loop.
    sensor      Sensor in the loop.
    trajectory  Desired motion.
    duration_s  Length of the run.
    seed        Seed of the experiment.
    run         Number of the run, 0 for the excitation.
    advance     Function that is called with the number of further frames, 1 by default.
    load        Load on the platform.
    law         Name of the control law. It knows the scenario's initial guess and the stated load.

    Raises TrajectoryError, before the run, if a pose is out of reach, beyond the travel or near a
    singularity. Raises the errors of `prepared` for a law, and LoopFailure for an unstable loop.
    """
    runs = plant.runs
    times = runs.timing.frame_times(duration_s)
    # The whole trajectory is checked before the run, because images take minutes.
    check_travel(plant.nominal, trajectory, times, **runs.limits)
    reference = trajectory.reference(times)
    delay_right_camera(sensor, runs.rig, seed)
    watch = _watched(sensor, runs.rig, len(times))
    eye = SensorInLoop(sensor, plant.robot, stream_seed(seed, NOISE, run), advance)
    latencies = drawn_latencies(runs.timing, len(times), seed, run)
    true_load = None if load is None else load.true
    in_loop = None
    if law != SERVO:
        motion = NamedMotion("the trajectory", trajectory, duration_s)
        start = plant.loop.side.model
        # The law knows only the initial guess and the stated load, like an experimenter.
        guess = starting_guess(
            plant.nominal, start.start_parameters, 1.0, plant.loop.prior, start.drive_law
        )
        model = guess.values + (0.0 if load is None else load.stated)
        in_loop = prepared(plant, law, KnownModel(model), motion, by_images(eye), latencies.known)
    loop_run = plant.run(reference, eye.over(times), latencies.true, true_load, in_loop)
    record = _record(plant, reference, loop_run, eye, seed, latencies.known)
    truth = plant.truth(loop_run)
    if in_loop is not None:
        store_law(record, law, in_loop.drives)
    rng = np.random.default_rng(stream_seed(seed, ANCHOR))
    layout = plant.robot.layout
    if (
        isinstance(sensor, cmmsim.Sensor)
        and (not runs.rig.exact or sensor.method == "registration")
        and loop_run.measured_ok.any()
    ):
        # A late exposure shifts a pose in proportion to its rate, so rates are needed.
        poses = without_gaps(loop_run.measured, loop_run.measured_ok)
        rates = spline_derivatives(poses, runs.timing.frame_rate_hz)[0]
        common = sensor.common_errors(poses, rates)
        store_common_errors(record, CommonErrors(common.names, common.changes, common.covariance))
    if watch is not None and (finding := watch.finding).judged_frames:
        store_finding(record, finding.to_dict())
    store_anchor(
        record, measured_anchor(runs.anchor, runs.anchor_std, layout, plant.parameters, rng)
    )
    if load is not None:
        store_load(record, load.figures, load.figures_std)
        store_load(truth, load.true_figures, 0.0 * load.figures_std)
    return Experiment(record, truth)


def delay_right_camera(sensor: PoseSensor, rig: Rig, seed: int) -> None:
    """Delay the right camera's exposure by a random draw from its stated uncertainty.

    All runs of a seed have the same delay. A rig with a stated delay keeps this delay.
    """
    if isinstance(sensor, cmmsim.Sensor) and rig.right_later_s is None and rig.right_later_std_s:
        drawn = np.random.default_rng(stream_seed(seed, EXPOSURES)).standard_normal()
        sensor.move_rig(rig.errors, rig.right_later_std_s * drawn)


def _watched(sensor: PoseSensor, rig: Rig, frames: int) -> DriftWatch | None:
    """Let the cameras drift during a run of this many frames, and return the drift watch.

    The watch is None if it is turned off, for poses by planes, and for a sensor without images.
    """
    if not isinstance(sensor, cmmsim.Sensor):
        return None
    sensor.drift_rig(rig.drift, frames)
    if rig.watch == "none" or sensor.method != "registration":
        return None
    return sensor.watch_drift(base=rig.watch == "both")


def drawn_latencies(timing: Timing, frames: int, seed: int, run: int) -> Latencies:
    """Draw the latencies of the frames of a run.

    The unknown error of their mean is the same for all runs of a seed.
    """
    known = timing.drawn_latencies(frames, np.random.default_rng(stream_seed(seed, LATENCY, run)))
    if not timing.latency_std_s:
        return Latencies(known, known)
    drawn = np.random.default_rng(stream_seed(seed, MEAN_LATENCY)).standard_normal()
    error = timing.latency_std_s * drawn
    # No command acts before it is issued.
    true = np.maximum((timing.latency_s if known is None else known) + np.full(frames, error), 0.0)
    return Latencies(true, known)


def _record(
    plant: Plant,
    reference: Reference,
    run: ClosedLoopRun,
    eye: SensorInLoop,
    seed: int,
    latencies: Array | None,
) -> xr.Dataset:
    """Return the record of a run. latencies (frames,) [s]: None means the scenario's latency."""
    if latencies is None:
        latencies = np.full(len(run.time), plant.runs.timing.latency_s)
    record = recording.build_record(
        time=run.time,
        reference_pose=reference.poses,
        reference_rate=reference.rates,
        measured_pose=run.measured,
        measured_covariance=np.array(eye.covariances),
        measured_ok=run.measured_ok,
        command=run.command,
        command_time=acting_times(run.time, latencies),
        scenario_toml=plant.runs.scenario_toml,
        robot=plant.nominal.name,
        seed=seed,
        frame_rate_hz=plant.runs.timing.frame_rate_hz,
        prismatic=plant.nominal.layout.prismatic,
    )
    store_robot(record, plant.nominal)
    store_robot_file(record, plant.nominal, plant.loop.side.model.start_parameters)
    if plant.geometry_covariance is not None:
        store_geometry_covariance(record, plant.nominal, plant.geometry_covariance)
    # The first twenty reasons show why frames were lost.
    return record.assign_attrs(sensor_seconds=eye.seconds, lost_frames="; ".join(eye.lost[:20]))
