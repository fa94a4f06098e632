"""The sensor with an artefact in its volume, and the parts of its own chain that measure this artefact."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmmsim.acceptance.artefact import artefact_file
from cmmsim.acceptance_errors import AcceptanceError
from cmmsim.errors import LostError
from cmmsim.files.marked_body import MarkedBody
from cmmsim.files.rig import rig_from_file
from cmmsim.files.schema import Platform, SensorFile
from cmmsim.geometry.pose import Array, invert, pose_to_transform, transform_to_pose
from cmmsim.imaging.pyrender_renderer import require_opengl
from cmmsim.imaging.renderer import PYRENDER, choose_renderer
from cmmsim.pose_estimation.estimator import PoseEstimator
from cmmsim.pose_estimation.observation import StickerObservation, observe
from cmmsim.pose_estimation.taught import Taught
from cmmsim.radiometry.images import StereoImages
from cmmsim.sensor import Sensor


@dataclass(frozen=True)
class SensorUnderTest:
    """file: the sensor file; seed of all its noise; renderer: one of the sensor's, None for what the file says."""

    file: SensorFile
    seed: int = 0
    renderer: str | None = None

    def facing(self, artefact: Platform, stream: int) -> Sensor:
        """The sensor before an artefact instead of its platform; ``stream`` keeps the noise of the tests apart."""
        sensor = Sensor(artefact_file(self.file, artefact), self.seed, renderer=self.renderer)
        sensor.start_run(self.seed + 1000 * stream)
        return sensor

    def renderer_name(self) -> str:
        """The renderer that will draw. Raises UnknownOptionError, or OpenGLMissingError where it cannot."""
        name = choose_renderer(self.renderer or self.file.renderer).name
        if name == PYRENDER.name:
            require_opengl()
        return name

    @property
    def base_from_camera(self) -> Array:
        """Where the rig is said to stand (4,4)."""
        return invert(rig_from_file(self.file.rig)[1])


def estimator_of(sensor: Sensor, body: MarkedBody, base_from_camera: Array | None = None) -> PoseEstimator:
    """The sensor's pose estimator for a body whose certificate states its sticker places.

    Poses are in the camera frame unless the place of the base is given.
    """
    count = len(body.nominal)
    taught = Taught(
        sensor.name,
        np.eye(4) if base_from_camera is None else base_from_camera,
        np.zeros((6, 6)),
        body.nominal.copy(),
        np.zeros((count, 3, 3)),
        np.zeros((6, 6)),
        np.zeros((0, 3)),
    )
    return PoseEstimator(sensor.rig, sensor.noise, sensor.settings, body, taught)


def part_of_body(body: MarkedBody, name: str, keep: NDArray[np.int_], origin: Array) -> MarkedBody:
    """A rigid body of its own made of the stickers ``keep`` (k,), its axes moved to ``origin`` (3,) of the whole."""
    return replace(
        body,
        name=name,
        offsets=body.offsets - body.normals @ origin,
        sticker_ids=body.sticker_ids[keep],
        plane_index=body.plane_index[keep],
        nominal=body.nominal[keep] - origin,
        in_plane=body.in_plane[keep],
    )


def locate(estimator: PoseEstimator, images: StereoImages) -> Array:
    """Rough camera_from_body (4,4) from whole images. Raises AcceptanceError that names the body."""
    try:
        return estimator.locate(images)
    except LostError as error:
        raise AcceptanceError(f"the {estimator.platform.name} is not found in the images: {error}") from error


def observe_stickers(estimator: PoseEstimator, images: StereoImages, expected: Array) -> StickerObservation:
    """Points of the stickers near an expected camera_from_body (4,4): nothing of the layout enters the points."""
    body = estimator.platform
    return observe(
        images, estimator.rig, estimator.noise, estimator.settings, expected, body.nominal, body.sticker_normals
    )


def pose_in_base(base_from_volume: Array, rotation: Array, position: Array) -> Array:
    """Pose (6,) of an artefact from its rotation (3,3) and position (3,) in volume axes."""
    volume_from_artefact = np.eye(4)
    volume_from_artefact[:3, :3], volume_from_artefact[:3, 3] = rotation, position
    return transform_to_pose(base_from_volume @ volume_from_artefact)


def relative_pose(first: Array, second: Array) -> Array:
    """first_from_second (4,4) of two poses (6,) in one frame."""
    return invert(pose_to_transform(first)) @ pose_to_transform(second)
