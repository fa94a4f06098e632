"""Poses from square tags (ArUco, AprilTag), compared with poses from the stickers of a sensor.

A tag is drawn on each plane of the platform, as large as fits between the plane's stickers. It has
the grey levels of the stickers, and is seen by the same cameras with the same lens and noise.
OpenCV finds its corners. Tags and stickers are searched in the whole images of each frame, without
tracking. The rig and the positions of all corners and stickers are known exactly. The errors are
therefore those of the images alone.

Corners are triangulated and fitted rigidly like stickers, with equal weights. OpenCV states no
covariance of its corners. The covariance of a pose from tags is therefore that of least squares.
The variance of a corner's pixel coordinates is estimated from the residuals of the same frame.

The bias is the error without noise. It varies from pose to pose, so its root mean square is given.
The scatter is the difference that the noise makes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import NamedTuple

import cv2
import numpy as np

from cmmsim.detection.tags import REFINEMENTS, find_tags, tag_dictionary
from cmmsim.errors import CmmError
from cmmsim.files.rig_and_bodies import MarkedBody, marked_body
from cmmsim.files.schema import SensorFile, Stickers
from cmmsim.geometry.plane_frame import PLANE_NAMES
from cmmsim.geometry.pose import (
    Array,
    apply,
    compose_covariance,
    invert,
    pose_covariance,
    pose_to_transform,
    rigid,
    transform_to_pose,
)
from cmmsim.geometry.registration import register
from cmmsim.geometry.triangulation import triangulate
from cmmsim.imaging.formation import ImageFormation
from cmmsim.imaging.prints import PRINT_SUPERSAMPLING, Print, plates_image, print_renderer
from cmmsim.imaging.stereo_camera import VirtualStereoCamera
from cmmsim.measuring.pose_estimator import measure_frame
from cmmsim.radiometry.stereo_images import StereoFrame
from cmmsim.sensor import Sensor

# Largest difference of the random poses from home in each coordinate and each angle.
REACH_M = 0.01
REACH_RAD = 0.04
# Width of the bright margin of a tag, in units of the side of a cell.
QUIET_CELLS = 1
# Fewest corners from which a pose is computed: those of one tag on each of two planes.
FEWEST_CORNERS = 8


class Found(NamedTuple):
    """Stickers, or corners of tags, found in one frame, and the pose from them.

    pixels      (2, n, 2), px in the left and the right image
    expected    (2, n, 2), exact pixels of the same marks
    pose        (6,), m and rad; NaN if the frame is lost
    covariance  (6, 6), of the pose
    seconds     time from the images to the pose
    """

    pixels: Array
    expected: Array
    pose: Array
    covariance: Array
    seconds: float


# Pose and covariance of a lost frame.
LOST = (np.full(6, np.nan), np.full((6, 6), np.nan))


@dataclass(frozen=True)
class MarkScore:
    """Score of one kind of marks, found by one method.

    points               mean number of stickers or corners in a frame with noise
    bias_px, scatter_px  rms error of a point per axis without noise, and rms change by noise
    position_*_um        bias and scatter of the position, rms over axes
    angle_*_urad         bias and scatter of the orientation, rms over axes
    normalised_error     rms Mahalanobis distance of a pose, divided by √6; ideally 1
    lost                 fraction of frames with noise that have no pose
    milliseconds         median time from whole images to the pose
    """

    marks: str
    method: str
    points: float
    bias_px: float
    scatter_px: float
    position_bias_um: float
    position_scatter_um: float
    angle_bias_urad: float
    angle_scatter_urad: float
    normalised_error: float
    lost: float
    milliseconds: float


@dataclass(frozen=True)
class Tags:
    """Tags of one dictionary on the planes of a platform.

    ``corners`` (k, 4, 3) are the positions of the corners of k tags in platform axes, m, in the
    order of OpenCV. ``prints`` are the tags with their margins.
    """

    name: str
    corners: Array
    prints: tuple[Print, ...]


def tags_on(name: str, body: MarkedBody, stickers: Stickers) -> Tags:
    """Return tags of a dictionary, as large as fits between the stickers of each plane of a body.

    Raises UnknownOptionError for an unknown dictionary.
    """
    dictionary = tag_dictionary(name)
    cells = dictionary.markerSize + 2
    cells_across = cells + 2 * QUIET_CELLS
    prints = []
    for plane in range(len(PLANE_NAMES)):
        own = body.plane_index == plane
        axes = body.in_plane[own][0]
        coordinates = body.nominal[own] @ axes
        low, high = coordinates.min(axis=0), coordinates.max(axis=0)
        cell_side = float((high - low).min()) / cells_across
        normal = np.cross(axes[:, 0], axes[:, 1])
        rotation = np.column_stack([axes[:, 0], -axes[:, 1], -normal])
        middle = axes @ (0.5 * (low + high)) + body.offsets[plane] * normal
        first = middle - 0.5 * cells_across * cell_side * (rotation[:, 0] + rotation[:, 1])
        picture = cv2.aruco.generateImageMarker(dictionary, plane, cells) > 0
        bright = np.pad(picture, QUIET_CELLS, constant_values=True)
        levels = np.where(bright, stickers.sticker_level, stickers.ring_level) / 255.0
        prints.append(Print(levels.astype(np.float32), cell_side, rigid(rotation, first)))
    inner = QUIET_CELLS + cells * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    flat = np.column_stack([inner, np.zeros(4)])
    corners = [apply(each.body_from_print, each.side * flat) for each in prints]
    return Tags(name, np.stack(corners), tuple(prints))


def compare_tags(
    file: SensorFile,
    dictionaries: Sequence[str],
    poses: int,
    rng: np.random.Generator,
    report: Callable[[], None] = lambda: None,
) -> list[MarkScore]:
    """Return the scores of a sensor's stickers, and of tags of each dictionary.

    The platform takes ``poses`` random poses near home. ``report`` is called after each pose of
    each kind of marks. Raises CmmError for fewer than two poses, and UnknownOptionError for an
    unknown dictionary.
    """
    if poses < 2:
        raise CmmError(f"a comparison with tags needs at least 2 poses, got {poses}")
    sensor = Sensor(file, renderer="analytic")
    sensor = Sensor(file, renderer="analytic", taught=sensor.truth)
    camera = sensor.camera
    assert isinstance(camera, VirtualStereoCamera)
    body = marked_body("platform", file.platform)
    kinds = [tags_on(name, body, file.stickers) for name in dictionaries]
    reach = np.repeat([REACH_M, REACH_RAD], 3)
    true_poses = sensor.home + rng.uniform(-reach, reach, (poses, 6))
    seeds = rng.integers(2**32, size=poses)
    found = []
    for pose, seed in zip(true_poses, seeds, strict=True):
        pair = _sticker_frames(camera, pose, seed)
        found.append([_stickers_found(sensor, pose, frame) for frame in pair])
        report()
    scores = [_score("stickers", sensor.observer.detector.name, true_poses, found)]
    for tags in kinds:
        by_method: dict[str, list[list[Found]]] = {method: [] for method in REFINEMENTS}
        for pose, seed in zip(true_poses, seeds, strict=True):
            pair = _tag_frames(camera, file.stickers, tags, pose, seed)
            for method, results in by_method.items():
                results.append([_tags_found(sensor, tags, method, pose, frame) for frame in pair])
            report()
        scores += [
            _score(tags.name, method, true_poses, each) for method, each in by_method.items()
        ]
    return scores


def _sticker_frames(camera: VirtualStereoCamera, pose: Array, seed: int) -> list[StereoFrame]:
    """Return the images of the stickers at a pose without noise and with noise."""
    rng = np.random.default_rng(seed)
    clean = replace(camera, noise=replace(camera.noise, enabled=False))
    return [each.look(pose, rng).full() for each in (clean, camera)]


def _tag_frames(
    camera: VirtualStereoCamera, stickers: Stickers, tags: Tags, pose: Array, seed: int
) -> list[StereoFrame]:
    """Return the images of tags at a pose without noise and with noise."""
    drawn = ImageFormation(
        print_renderer(tags.prints),
        camera.formation.drawable,
        stickers.body_level / 255.0,
        camera.formation.optics,
    )
    plates = [
        apply(each.body_from_print, each.side * np.column_stack([each.corners, np.zeros(4)]))
        for each in tags.prints
    ]
    camera_from_platform = camera.camera_from_base @ pose_to_transform(pose)
    light = [
        plates_image(
            drawn, each, camera_from_left @ camera_from_platform, plates, PRINT_SUPERSAMPLING
        )
        for each, camera_from_left in zip(camera.rig.cameras, camera.rig.from_camera, strict=True)
    ]
    rng = np.random.default_rng(seed)
    clean = replace(camera.noise, enabled=False)
    return [
        StereoFrame(
            *(
                noise.expose(radiance, rng, pattern)
                for radiance, pattern in zip(light, camera.patterns, strict=True)
            )
        )
        for noise in (clean, camera.noise)
    ]


def _stickers_found(sensor: Sensor, pose: Array, frame: StereoFrame) -> Found:
    """Measure a frame of stickers, which are searched in the whole images."""
    begin = perf_counter()
    measured = measure_frame(frame, sensor.estimator)
    seconds = perf_counter() - begin
    names = sensor.platform.sticker_ids.tolist()
    used = [names.index(name) for name in measured.target_ids]
    camera_from_platform = sensor.camera.camera_from_base @ pose_to_transform(pose)
    places = apply(camera_from_platform, sensor.truth.platform_places[used])
    expected = sensor.rig.project(places)[0]
    pixels = np.stack([measured.left_pixels, measured.right_pixels])
    return Found(pixels, expected, measured.pose, measured.covariance, seconds)


def _tags_found(sensor: Sensor, tags: Tags, method: str, pose: Array, frame: StereoFrame) -> Found:
    """Find the tags of a frame in both whole images, and compute the pose."""
    dictionary = tag_dictionary(tags.name)
    scale = 255.0 / sensor.noise.white_level
    begin = perf_counter()
    left, right = (
        find_tags(np.rint(scale * image).astype(np.uint8), dictionary, method)
        for image in (frame.left, frame.right)
    )
    both = sorted(left.keys() & right.keys() & set(range(len(tags.corners))))
    pixels = np.array([[side[k] for k in both] for side in (left, right)]).reshape(2, -1, 2)
    places = tags.corners[both].reshape(-1, 3)
    measured, covariance = _pose_of(sensor, places, pixels)
    seconds = perf_counter() - begin
    camera_from_platform = sensor.camera.camera_from_base @ pose_to_transform(pose)
    expected = sensor.rig.project(apply(camera_from_platform, places))[0]
    return Found(pixels, expected, measured, covariance, seconds)


def _pose_of(sensor: Sensor, places: Array, pixels: Array) -> tuple[Array, Array]:
    """Return the pose (6,) of points (n, 3) at pixels (2, n, 2), and its covariance (6, 6).

    Both are NaN for fewer than `FEWEST_CORNERS` points.
    """
    if len(places) < FEWEST_CORNERS:
        return LOST
    unit_covariances = np.tile(np.eye(2), (len(places), 1, 1))
    points = triangulate(sensor.rig, pixels[0], pixels[1], unit_covariances, unit_covariances)
    fit = register(places, points.points, points.covariances)
    # Each point has four pixel coordinates, and the pose six unknowns.
    squares = points.ray_gap.sum() + fit.misfit.sum()
    variance = squares / (4 * len(places) - len(LOST[0]))
    base_from_camera = invert(sensor.camera.camera_from_base)
    base_from_platform = base_from_camera @ fit.transform
    covariance = compose_covariance(base_from_camera, variance * fit.covariance)
    return transform_to_pose(base_from_platform), pose_covariance(base_from_platform, covariance)


def _score(marks: str, method: str, poses: Array, found: Sequence[Sequence[Found]]) -> MarkScore:
    """Return the score of one kind of marks.

    ``found`` has two results per pose: without and with noise. ``poses`` (N, 6) are the true poses.
    """
    clean = np.array([pair[0].pose for pair in found]) - poses
    noisy = np.array([pair[1].pose for pair in found]) - poses
    good = np.isfinite(noisy).all(axis=1)
    both = good & np.isfinite(clean).all(axis=1)
    squares = [
        noisy[k] @ np.linalg.solve(found[k][1].covariance, noisy[k]) / noisy.shape[1]
        for k in np.flatnonzero(good).tolist()
    ]
    bias = np.concatenate([(pair[0].pixels - pair[0].expected).ravel() for pair in found])
    # Scatter is computed only where both frames of a pair have the same marks in the same order.
    alike = [pair for pair in found if np.array_equal(pair[0].expected, pair[1].expected)]
    scatter = np.concatenate(
        [np.zeros(0), *((pair[1].pixels - pair[0].pixels).ravel() for pair in alike)]
    )
    changes = (noisy - clean)[both]
    return MarkScore(
        marks,
        method,
        float(np.mean([pair[1].pixels.shape[1] for pair in found])),
        _rms(bias),
        _rms(scatter),
        1e6 * _rms(clean[both, :3]),
        1e6 * _rms(changes[:, :3]),
        1e6 * _rms(clean[both, 3:]),
        1e6 * _rms(changes[:, 3:]),
        _rms(np.sqrt(squares)),
        1.0 - float(good.mean()),
        1e3 * float(np.median([pair[1].seconds for pair in found])),
    )


def _rms(values: Array) -> float:
    """Return the root mean square; NaN without values."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")
