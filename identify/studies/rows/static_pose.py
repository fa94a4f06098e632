"""Rows of kind `static_pose`: the sensor alone looks at a platform that stands still.

Each row draws one or several poses in the scenario's excitation box around the sensor's home pose,
and takes several pictures of each pose. Stickers are searched near predicted pixels. The
predictions have random errors, like those of a tracker. No picture is searched as a whole. Dropout
removes pictures without changing the others. Teaching is exact by default, so that rows show
observation noise alone.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np
from pydantic import Field

import cmmsim
from cmmsim.geometry.pose import apply, invert
from identify.arrays import Array
from identify.errors import EstimationError
from identify.random_streams import stream_seed
from identify.scenario import Scenario
from identify.scenario.section import Section
from identify.setup import Setup
from identify.studies.rows.kind import (
    BOX,
    NOISE_OFF,
    PICTURES,
    Column,
    IneffectiveKeys,
    KeysRead,
    Kind,
    Row,
    timing,
)
from identify.studies.rows.row_sensor import (
    POSE_COLUMNS,
    RowSensor,
    Teaching,
    pose_figures,
    rms_um,
    row_sensor,
)

POSES, SENSOR, DROPOUT = range(3)  # random streams of a row
TOGETHER = 256  # pictures that are drawn and measured at once
# Standard deviation of the error of the predicted pose, m and rad. Stickers are searched near this
# pose, as by a tracker.
PREDICTION_ERROR = np.repeat([1e-4, 5e-4], 3)

COLUMNS = {
    "captures": Column("1", "stereo pictures taken"),
    "lost_frames": Column(
        "1", "pictures in which no pose was found; the other figures exclude them"
    ),
    "stickers": Column("1", "stickers used, mean over the pictures"),
    "pixel_noise_grey": Column(
        "grey values", "rms noise of a grey value half-way between sticker and ring"
    ),
    **POSE_COLUMNS,
    "mean_position_rms_um": Column(
        "um", "error of the position averaged over the pictures of a pose", main=True
    ),
    "mean_orientation_rms_urad": Column(
        "urad", "error of the orientation averaged over the pictures of a pose", main=True
    ),
    "sight_m": Column("m", "distance of the stickers from the middle of the baseline, mean"),
    "point_depth_rms_um": Column(
        "um", "error of single stickers along the line of sight", main=True
    ),
    "point_lateral_rms_um": Column(
        "um", "error of single stickers across the line of sight, rms over both axes"
    ),
    "centre_rms_px": Column(
        "px",
        "error of sticker centres in the images, rms over stickers, cameras and axes",
        main=True,
    ),
    "disparity_rms_px": Column(
        "px", "error of the difference of a sticker's x in both images, rms over stickers"
    ),
}


class StaticPoseOptions(Section):
    """Options of rows of kind `static_pose`."""

    poses: int = Field(1, ge=1, le=10_000, description="number of poses drawn per row")
    captures: int = Field(
        4, ge=1, le=100_000, description="pictures of each pose, if hold_s is not given"
    )
    hold_s: float | None = Field(
        None,
        gt=0,
        le=3600,
        description="time at each pose; it replaces captures by the frames in this time",
    )
    teaching: Teaching = Field(
        "exact",
        description="exact: without error; sensor: the sensor teaches itself, seeded by the row",
    )


READS = KeysRead(
    (*PICTURES, *timing("frame_rate_hz", "exposure_s", "dropout"), *BOX),
    excluding=("sensor.stickers.obstacle_level",),
    ineffective=(
        NOISE_OFF,
        IneffectiveKeys(
            ("options.captures",),
            {"options.hold_s": lambda hold: hold is not None},
            "options.hold_s is given: it sets the number of pictures",
        ),
        IneffectiveKeys(
            timing("frame_rate_hz"),
            {"options.hold_s": lambda hold: hold is None},
            "options.hold_s is not given: options.captures sets the number of pictures",
        ),
    ),
)


@dataclass(frozen=True)
class _Capture:
    """Result of one picture of a pose.

    pose               Number of the pose.
    error (6,)         Error of the measured pose.
    covariance (6, 6)  Stated covariance of the measured pose.
    points, centres    Errors of the stickers, as `_sticker_errors` returns them.
    """

    pose: int
    error: Array
    covariance: Array
    points: Array
    centres: Array


def compute(scenario: Scenario, seed: np.random.SeedSequence, options: StaticPoseOptions) -> Row:
    """Compute one row.

    Raises EstimationError, with a reason, if every picture was lost, and the exceptions of the
    sensor.
    """
    sensor = row_sensor(Setup(scenario).sensor_plan, options.teaching, stream_seed(seed, SENSOR))
    rng = np.random.default_rng(stream_seed(seed, POSES))
    dropout = np.random.default_rng(stream_seed(seed, DROPOUT))
    box = np.repeat(
        (scenario.excitation.position_amplitude_m, scenario.excitation.orientation_amplitude_rad), 3
    )
    captures = (
        options.captures
        if options.hold_s is None
        else max(1, scenario.timing.frames(options.hold_s))
    )
    seen: list[_Capture] = []
    lost = ""
    planned = _pictures(sensor.sensor.home, box, (options.poses, captures), rng)
    while together := list(islice(planned, TOGETHER)):
        poses, near = (np.array(values) for values in list(zip(*together, strict=True))[1:])
        # Pictures that drop out are measured too, so that dropout does not change later noise.
        for (number, pose, _), measured in zip(
            together, sensor.sensor.measure_each(poses, near), strict=True
        ):
            if dropout.random() < (probability := sensor.sensor.timing.dropout):
                lost = f"dropped frame (with a probability of {probability:.3g})"
            elif not measured.ok:
                lost = measured.reason
            else:
                errors = _sticker_errors(sensor, measured, pose)
                seen.append(_Capture(number, measured.pose - pose, measured.covariance, *errors))
    if not seen:
        raise EstimationError(
            f"no pose was found in any of {captures * options.poses} pictures: {lost}"
        )
    return _row(sensor, seen, captures * options.poses)


def _pictures(
    home: Array, box: Array, count: tuple[int, int], rng: np.random.Generator
) -> Iterator[tuple[int, Array, Array]]:
    """Yield for each picture the number of its pose, the pose (6,), and the predicted pose (6,).

    Stickers are searched near the predicted pose. `count` holds the number of poses, and the number
    of pictures per pose.
    """
    for number in range(count[0]):
        pose = home + box * rng.uniform(-1.0, 1.0, 6)
        for _ in range(count[1]):
            yield number, pose, pose + PREDICTION_ERROR * rng.standard_normal(6)


def _sticker_errors(
    sensor: RowSensor, seen: cmmsim.Measurement, pose: Array
) -> tuple[Array, Array]:
    """Return the errors of the k stickers seen.

    The first array (k, 3) holds the distance from the middle of the baseline, the signed error
    along the line of sight, and the norm of the error across it, m. The second array (2, k, 2)
    holds the errors of the centres in both images, px.
    """
    estimator = sensor.sensor.estimator
    index = np.flatnonzero(np.isin(estimator.platform.sticker_ids, seen.target_ids))
    in_base = apply(cmmsim.pose_to_transform(pose), sensor.truth.platform_places[index])
    in_camera = apply(invert(sensor.truth.base_from_camera), in_base)
    pixels, _ = estimator.rig.project(in_camera)
    sight = in_base - sensor.middle
    distance = np.linalg.norm(sight, axis=1)
    errors = (seen.points - in_camera) @ sensor.truth.base_from_camera[:3, :3].T
    along = np.einsum("ki,ki->k", errors, sight) / distance
    across = np.sqrt(np.maximum(np.einsum("ki,ki->k", errors, errors) - along**2, 0.0))
    return np.column_stack([distance, along, across]), np.stack(
        [seen.left_pixels, seen.right_pixels]
    ) - pixels


def _row(sensor: RowSensor, seen: list[_Capture], captures: int) -> Row:
    errors = np.array([one.error for one in seen])
    of_pose = np.array([one.pose for one in seen])
    means = np.array([errors[of_pose == number].mean(axis=0) for number in np.unique(of_pose)])
    points = np.concatenate([one.points for one in seen])
    centres = np.concatenate([one.centres for one in seen], axis=1)
    noise = sensor.sensor.noise
    rim_grey: Array = np.asarray(noise.mean_grey(np.array(sensor.rim)), dtype=float)
    return {
        "captures": captures,
        "lost_frames": captures - len(seen),
        "stickers": float(np.mean([len(one.points) for one in seen])),
        "pixel_noise_grey": float(np.sqrt(noise.variance(rim_grey))),
        **pose_figures(errors, np.array([one.covariance for one in seen])),
        "mean_position_rms_um": rms_um(means[:, :3]),
        "mean_orientation_rms_urad": rms_um(means[:, 3:]),
        "sight_m": float(points[:, 0].mean()),
        "point_depth_rms_um": rms_um(points[:, 1]),
        # The error across the line of sight has two axes.
        "point_lateral_rms_um": rms_um(points[:, 2]) / float(np.sqrt(2.0)),
        "centre_rms_px": float(np.sqrt(np.mean(centres**2))),
        "disparity_rms_px": float(np.sqrt(np.mean((centres[0, :, 0] - centres[1, :, 0]) ** 2))),
    }


STATIC_POSE = Kind(
    "static_pose",
    compute,
    "the sensor alone looks at a platform that stands still, at a pose drawn in the box",
    COLUMNS,
    StaticPoseOptions,
    READS,
)
