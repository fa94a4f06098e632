"""Rows of kind `path_pose`: the sensor alone follows a platform along a random path.

The path is a random trajectory with the scenario's settings of the excitation. Exposure, latency,
its jitter and dropout have the scenario's values. A row is a short stretch of the path from a
random instant on. All pictures of the stretch are measured in one call. Each sticker is expected at
its true pixel, so there is neither search nor tracking. A measured pose refers to the middle of its
exposure. The row has the error of the measured poses, and the error of the pose in use, which is
the most recent pose that has arrived. Teaching is exact by default.
"""

import numpy as np
from pydantic import Field

from dynamics.kinematics.platform import Chart
from identify.arrays import Array
from identify.errors import EstimationError
from identify.excitation.design import drawn_trajectory
from identify.random_streams import stream_seed
from identify.scenario import Scenario
from identify.scenario.section import Section
from identify.setup import Setup
from identify.studies.rows.kind import (
    NOISE_OFF,
    PATH,
    PICTURES,
    Column,
    KeysRead,
    Kind,
    Row,
    timing,
)
from identify.studies.rows.row_sensor import (
    POSE_COLUMNS,
    Teaching,
    pose_figures,
    rms_um,
    row_sensor,
)
from identify.trajectory import FourierTrajectory

DRAWN_PATH, SENSOR, LATENCY = range(3)  # random streams of a row
# Number of instants per frame period at which the pose in use is compared with the true pose.
INSTANTS_PER_FRAME = 16

COLUMNS = {
    "frames": Column("1", "stereo pictures taken"),
    "lost_frames": Column(
        "1", "frames without a pose; they count only in the errors of the pose in use"
    ),
    "speed_rms_mm_s": Column("mm/s", "speed of the platform along each axis, rms over the frames"),
    **POSE_COLUMNS,
    "used_position_rms_um": Column(
        "um", "error of the last arrived position, from the first arrival to the last", main=True
    ),
    "used_orientation_rms_urad": Column(
        "urad",
        "error of the last arrived orientation, from the first arrival to the last",
        main=True,
    ),
}


class PathPoseOptions(Section):
    """Options of rows of kind `path_pose`."""

    stretch_s: float = Field(
        0.5, gt=0, le=3600, description="time along the path, at least two frames"
    )
    teaching: Teaching = Field(
        "exact",
        description="exact: taught without error; sensor: taught from images, seeded by the row",
    )


READS = KeysRead(
    (
        *PICTURES,
        *timing("frame_rate_hz", "exposure_s", "latency_s", "latency_jitter_s", "dropout"),
        *PATH,
    ),
    excluding=("sensor.stickers.obstacle_level",),
    ineffective=(NOISE_OFF,),
)


def compute(scenario: Scenario, seed: np.random.SeedSequence, options: PathPoseOptions) -> Row:
    """Compute one row.

    Raises EstimationError if fewer than two poses were measured, and any exception of the sensor.
    """
    on_path = row_sensor(Setup(scenario).sensor_plan, options.teaching, stream_seed(seed, SENSOR))
    rng = np.random.default_rng(stream_seed(seed, DRAWN_PATH))
    path = drawn_trajectory(rng, Chart("free", tuple(on_path.sensor.home)), scenario.excitation)
    # The path is periodic with the fundamental frequency.
    start = rng.uniform(0.0, 1.0 / scenario.excitation.fundamental_hz)
    frames = max(2, scenario.timing.frames(options.stretch_s))
    times: Array = start + scenario.timing.frame_period_s * np.arange(frames, dtype=float)
    seen = on_path.sensor.measure_many(path.pose(times), path.pose_rate(times))
    ok = np.isfinite(seen.poses[:, 0])
    if ok.sum() < 2:
        raise EstimationError(
            f"{ok.sum()} of {frames} frames along the path gave a pose, but 2 are needed"
        )
    errors = (seen.poses - path.pose(times))[ok]
    latencies = scenario.timing.drawn_latencies(
        len(times), np.random.default_rng(stream_seed(seed, LATENCY))
    )
    arrivals: Array = times + (scenario.timing.latency_s if latencies is None else latencies)
    used = _used_errors(path, seen.poses[ok], arrivals[ok], scenario.timing.frame_period_s)
    return {
        "frames": frames,
        "lost_frames": int(np.sum(~ok)),
        "speed_rms_mm_s": 1e-3 * rms_um(path.pose_rate(times)[:, :3]),
        **pose_figures(errors, seen.covariances[ok]),
        "used_position_rms_um": rms_um(used[:, :3]),
        "used_orientation_rms_urad": rms_um(used[:, 3:]),
    }


def _used_errors(path: FourierTrajectory, poses: Array, arrivals: Array, period_s: float) -> Array:
    """Return the errors (m, 6) of the pose in use from the first arrival to the last.

    Poses come into use in the order in which they were measured.
    """
    arrivals = np.maximum.accumulate(arrivals)
    count = max(1, round(INSTANTS_PER_FRAME * float(arrivals[-1] - arrivals[0]) / period_s))
    # Instants are the midpoints of equal time steps.
    instants = arrivals[0] + (np.arange(count) + 0.5) / count * (arrivals[-1] - arrivals[0])
    in_use = np.searchsorted(arrivals, instants, side="right") - 1
    return np.asarray(poses[in_use] - path.pose(instants), dtype=float)


FRAME = 4.3e3  # memory per frame, bytes, as measured with up to 1,800,000 frames


def memory(setup: Setup, options: PathPoseOptions) -> float:
    """Return the memory needed to follow a stretch of a path, bytes."""
    return FRAME * setup.scenario.timing.frames(options.stretch_s)


PATH_POSE = Kind(
    "path_pose",
    compute,
    "the sensor alone follows a platform along a random path, with the scenario's timing",
    COLUMNS,
    PathPoseOptions,
    READS,
    memory=memory,
)
