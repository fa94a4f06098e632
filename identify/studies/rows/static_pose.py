"""Rows of kind `static_pose`: the sensor alone looks at a platform that stands still at a pose drawn in the box.

The box is the scenario's excitation amplitude around the sensor's home pose. Each row draws one pose (or several) and
takes several pictures of it. Stickers are looked for where a tracker would expect them, a little beside the true place;
no picture is searched as a whole. The timing's dropout loses pictures, and changes nothing in the others. Teaching is
exact unless asked for otherwise: the rows show observation noise alone.
"""

import numpy as np
from pydantic import Field

import cmmsim
from cmmsim.geometry.pose import apply, invert
from cmmsim.pose_estimation.estimator import PoseEstimator
from identify.arrays import Array
from identify.errors import EstimationError
from identify.random_streams import stream_seed
from identify.scenario import Scenario
from identify.studies.rows.kind import (
    NOISE_OFF,
    PICTURES,
    POSE_COLUMNS,
    Column,
    Idle,
    Kind,
    Reads,
    Row,
    RowOptions,
    pose_figures,
    rms_um,
    timing,
)
from identify.studies.rows.sensor import RowSensor, Teaching, row_sensor

POSES, SENSOR, DROPOUT = 0, 1, 2
PREDICTION_ERROR = np.repeat([1e-4, 5e-4], 3)
"""Standard deviation [m, rad] of the pose near which a picture's stickers are looked for: what a tracker predicts."""

COLUMNS = {
    "captures": Column("1", "stereo pictures taken"),
    "lost_frames": Column("1", "pictures in which no pose was found; they count in no other figure"),
    "stickers": Column("1", "stickers used, mean over the pictures"),
    "pixel_noise_grey": Column("grey values", "rms noise of a grey value half-way between sticker and ring"),
    **POSE_COLUMNS,
    "mean_position_rms_um": Column("um", "error of the position averaged over the pictures of a pose", main=True),
    "mean_orientation_rms_urad": Column(
        "urad", "error of the orientation averaged over the pictures of a pose", main=True
    ),
    "sight_m": Column("m", "distance of the stickers from the middle of the baseline, mean"),
    "point_depth_rms_um": Column("um", "error of single stickers along the line from there to the sticker", main=True),
    "point_lateral_rms_um": Column("um", "error of single stickers across that line, rms over both axes"),
    "centre_rms_px": Column(
        "px", "error of sticker centres in the images, rms over stickers, cameras and axes", main=True
    ),
    "disparity_rms_px": Column("px", "error of the difference of a sticker's x in both images, rms over stickers"),
}


class StaticPoseOptions(RowOptions):
    """How much a row looks at."""

    poses: int = Field(1, ge=1, le=10_000, description="poses drawn a row")
    captures: int = Field(4, ge=1, le=100_000, description="pictures of each pose, where hold_s is not given")
    hold_s: float | None = Field(
        None, gt=0, le=3600, description="time for which each pose is held: pictures at the frame rate, not `captures`"
    )
    teaching: Teaching = Field("exact", description="exact, or by the sensor itself, seeded by the row")


READS = Reads(
    (
        *PICTURES,
        *timing("frame_rate_hz", "exposure_s", "dropout"),
        "scenario.excitation.position_amplitude_m",
        "scenario.excitation.orientation_amplitude_rad",
    ),
    but=("sensor.stickers.obstacle_level",),
    idle=(
        NOISE_OFF,
        Idle(
            ("options.captures",),
            {"options.hold_s": lambda hold: hold is not None},
            "options.hold_s is given: it sets the number of pictures",
        ),
        Idle(
            timing("frame_rate_hz"),
            {"options.hold_s": lambda hold: hold is None},
            "options.hold_s is not given: options.captures sets the number of pictures",
        ),
    ),
)


def compute(scenario: Scenario, seed: np.random.SeedSequence, options: StaticPoseOptions) -> Row:
    """One row. Raises EstimationError, with a reason, where every picture was lost, and what the sensor raises."""
    eye = row_sensor(scenario, options.teaching, stream_seed(seed, SENSOR))
    rng = np.random.default_rng(stream_seed(seed, POSES))
    amplitude = (scenario.excitation.position_amplitude_m, scenario.excitation.orientation_amplitude_rad)
    box = np.repeat(amplitude, 3)
    captures = options.captures if options.hold_s is None else max(1, scenario.timing.frames(options.hold_s))
    dropout = np.random.default_rng(stream_seed(seed, DROPOUT))
    looks = [
        _Look(eye, eye.sensor.home + box * rng.uniform(-1.0, 1.0, 6), captures, rng, dropout)
        for _ in range(options.poses)
    ]
    return _row(eye, looks, captures)


class _Look:
    """What the pictures of one pose gave: errors and covariances of the pose (n, 6), (n, 6, 6), and what
    `_sticker_errors` says of all stickers in them."""

    def __init__(
        self, eye: RowSensor, pose: Array, captures: int, rng: np.random.Generator, dropout: np.random.Generator
    ) -> None:
        estimator = eye.sensor.estimator
        self._dropout = dropout
        self.reasons: list[str] = []
        seen = [self._measured(eye, estimator, pose, rng) for _ in range(captures)]
        good = [one for one in seen if one is not None]
        self.errors = np.array([one.pose - pose for one in good]).reshape(-1, 6)
        self.covariances = np.array([one.covariance for one in good]).reshape(-1, 6, 6)
        self.counts = [len(one.target_ids) for one in good]
        pairs = [_sticker_errors(eye, estimator, one, pose) for one in good]
        self.points = np.concatenate([points for points, _ in pairs]) if pairs else np.zeros((0, 3))
        self.centres = np.concatenate([centres for _, centres in pairs], axis=1) if pairs else np.zeros((2, 0, 2))

    def _measured(
        self, eye: RowSensor, estimator: PoseEstimator, pose: Array, rng: np.random.Generator
    ) -> cmmsim.Measurement | None:
        predicted = pose + PREDICTION_ERROR * rng.standard_normal(6)
        expected = invert(estimator.taught.base_from_camera) @ cmmsim.pose_to_transform(predicted)
        images = eye.sensor.look(pose)  # also of one that drops out, so that the next have the noise they had
        if self._dropout.random() < (share := eye.sensor.timing.dropout):
            self.reasons.append(f"dropped frame (a share of {share:.3g} drops out)")
            return None
        try:
            return estimator.measure(images, expected)[0]
        except cmmsim.LostError as error:
            self.reasons.append(str(error))
            return None


def _sticker_errors(
    eye: RowSensor, estimator: PoseEstimator, seen: cmmsim.Measurement, pose: Array
) -> tuple[Array, Array]:
    """Of the stickers seen: [distance, error along the line of sight, error across it] (k, 3), m, and the errors of
    their centres in both images (2, k, 2), px."""
    index = np.flatnonzero(np.isin(estimator.platform.sticker_ids, seen.target_ids))
    places = apply(cmmsim.pose_to_transform(pose), eye.truth.platform_places[index])
    in_camera = apply(invert(eye.truth.base_from_camera), places)
    pixels, _ = estimator.rig.project(in_camera)
    sight = places - eye.middle
    distance = np.linalg.norm(sight, axis=1)
    errors = (seen.points - in_camera) @ eye.truth.base_from_camera[:3, :3].T
    along = np.einsum("ki,ki->k", errors, sight) / distance
    across = np.sqrt(np.maximum(np.einsum("ki,ki->k", errors, errors) - along**2, 0.0))
    return np.column_stack([distance, along, across]), np.stack([seen.left_pixels, seen.right_pixels]) - pixels


def _row(eye: RowSensor, looks: list[_Look], captures: int) -> Row:
    errors = np.concatenate([look.errors for look in looks])
    if not len(errors):
        raise EstimationError(f"no pose was found in any of {captures * len(looks)} pictures: {looks[-1].reasons[-1]}")
    means = np.array([look.errors.mean(axis=0) for look in looks if len(look.errors)])
    points = np.concatenate([look.points for look in looks])
    centres = np.concatenate([look.centres for look in looks], axis=1)
    noise = eye.sensor.noise
    rim_grey: Array = np.asarray(noise.mean_grey(np.array(eye.rim)), dtype=float)
    return {
        "captures": captures * len(looks),
        "lost_frames": captures * len(looks) - len(errors),
        "stickers": float(np.mean([count for look in looks for count in look.counts])),
        "pixel_noise_grey": float(np.sqrt(noise.variance(rim_grey))),
        **pose_figures(errors, np.concatenate([look.covariances for look in looks])),
        "mean_position_rms_um": rms_um(means[:, :3]),
        "mean_orientation_rms_urad": rms_um(means[:, 3:]),
        "sight_m": float(points[:, 0].mean()),
        "point_depth_rms_um": rms_um(points[:, 1]),
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
