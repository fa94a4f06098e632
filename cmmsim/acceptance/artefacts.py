"""Artefacts of the tests: boards with a ridge and a rigid bar, with stickers, and the sensor that sees them.

Artefacts of the tests: long boards with a ridge, stickers on their three upper sides, and the sensor that sees them.
An artefact's frame has x along it, z out of its front side A and the origin in the middle of that side. Sides B and C
slope away from A by SLOPE, so that all stickers are seen from the front.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmmsim.errors import AcceptanceError, LostError
from cmmsim.files.schema import Body, HalfSpace, Planes, Platform, Rig, SensorFile, StickerPlane
from cmmsim.files.setup import MarkedBody, rig_from_file
from cmmsim.geometry.pose import Array, invert, pose_to_transform, transform_to_pose
from cmmsim.imaging.pyrender_renderer import require_opengl
from cmmsim.imaging.renderer import choose_renderer
from cmmsim.pose_estimation.estimator import PoseEstimator
from cmmsim.pose_estimation.observation import StickerObservation
from cmmsim.pose_estimation.taught import Taught
from cmmsim.radiometry.images import StereoImages
from cmmsim.sensor import Sensor

H = TypeVar("H", bound=HalfSpace)
SLOPE = np.deg2rad(15.0)
HALF_RIDGE = 0.020  # m: half the width of side A
SIDE = 0.060  # m: width of sides B and C
END = 0.020  # m: the board goes on beyond the outermost stickers
OUT_OF_SIGHT = 100.0  # m behind the cameras


@dataclass(frozen=True)
class StickerRow:
    """Stickers of one side: along (n,) m from the middle of the artefact, and across (n,) m from the edge of side A
    (sides B and C) or from its middle line (side A)."""

    along: ArrayLike
    across: ArrayLike


def board(a: StickerRow, b: StickerRow, c: StickerRow) -> Platform:
    """The sensor-file section of an artefact with rows of stickers on its sides A, B (towards +y) and C (towards -y).

    B's across counts away from A, C's as well.
    """
    reach = max(float(np.abs(row.along).max()) for row in (a, b, c)) + END
    sine, cosine = float(np.sin(SLOPE)), float(np.cos(SLOPE))
    sides = {
        "A": _side((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), a, 1.0),
        "B": _side((0.0, sine, cosine), (0.0, HALF_RIDGE, 0.0), b, 1.0),
        "C": _side((0.0, -sine, cosine), (0.0, -HALF_RIDGE, 0.0), c, -1.0),
    }
    width = HALF_RIDGE + SIDE * cosine
    cuts = [
        _half_space(normal, point)
        for normal, point in (
            ((1.0, 0.0, 0.0), (reach, 0.0, 0.0)),
            ((-1.0, 0.0, 0.0), (-reach, 0.0, 0.0)),
            ((0.0, 1.0, 0.0), (0.0, width, 0.0)),
            ((0.0, -1.0, 0.0), (0.0, -width, 0.0)),
            ((0.0, 0.0, -1.0), (0.0, 0.0, -SIDE * sine - 0.05)),
        )
    ]
    return Platform(planes=Planes(**sides), cuts=cuts, home=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))


def artefact_file(file: SensorFile, artefact: Platform) -> SensorFile:
    """The sensor file with an artefact in place of the platform and nothing else in sight.

    The artefact's stickers sit exactly at their places: they are what its certificate states.
    """
    stickers = file.stickers.model_copy(update={"placement": (0.0, 0.0)})
    return file.model_copy(update={"platform": artefact, "base": _behind(file.base, file.rig), "stickers": stickers})


def facing_rotation(along: Array, towards: Array) -> Array:
    """Rotation (3,3) that lays an artefact's x axis on ``along`` and turns its side A towards ``towards``, both (3,)
    and of any length."""
    x = along / np.linalg.norm(along)
    z = towards - (towards @ x) * x
    z = z / np.linalg.norm(z)
    return np.column_stack([x, np.cross(z, x), z])


def _side(
    normal: tuple[float, float, float], point: tuple[float, float, float], row: StickerRow, sign: float
) -> StickerPlane:
    """u runs along the artefact; v = n x u points to +y on all sides, so that C counts backwards."""
    return StickerPlane(
        normal=normal,
        point=point,
        across=(1.0, 0.0, 0.0),
        stickers=[(float(u), sign * float(v)) for u, v in np.column_stack([row.along, row.across])],
    )


def _half_space(normal: tuple[float, float, float], point: tuple[float, float, float]) -> HalfSpace:
    return HalfSpace(normal=normal, point=point)


def _behind(body: Body, rig: Rig) -> Body:
    """The body moved far behind both cameras."""
    view = np.array(rig.target) - np.array(rig.position)
    shift = -OUT_OF_SIGHT * view / np.linalg.norm(view)

    planes = Planes(A=_moved(body.planes.A, shift), B=_moved(body.planes.B, shift), C=_moved(body.planes.C, shift))
    return body.model_copy(update={"planes": planes, "cuts": [_moved(cut, shift) for cut in body.cuts]})


def _moved(half_space: H, shift: Array) -> H:
    x, y, z = np.array(half_space.point) + shift
    return half_space.model_copy(update={"point": (float(x), float(y), float(z))})


# The sensor with an artefact in its volume, and the parts of its own chain that measure this artefact.


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
        if name == "pyrender":
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
    return estimator.observe(images, expected, body.nominal, body.sticker_normals)


def pose_in_base(base_from_volume: Array, rotation: Array, position: Array) -> Array:
    """Pose (6,) of an artefact from its rotation (3,3) and position (3,) in volume axes."""
    volume_from_artefact = np.eye(4)
    volume_from_artefact[:3, :3], volume_from_artefact[:3, 3] = rotation, position
    return transform_to_pose(base_from_volume @ volume_from_artefact)


def relative_pose(first: Array, second: Array) -> Array:
    """first_from_second (4,4) of two poses (6,) in one frame."""
    return invert(pose_to_transform(first)) @ pose_to_transform(second)


# The rigid bar: two clusters of six stickers at its ends, each a rigid body of its own to the sensor.


LENGTH = 0.300  # m between the origins of the clusters, which lie on the bar's x axis
HALF_LENGTH, HALF_WIDTH = 0.5 * LENGTH + 0.065, HALF_RIDGE + SIDE
END_FROM_END = np.eye(4)  # first_from_second, what is true of the two clusters
END_FROM_END[0, 3] = LENGTH
END_FROM_END.setflags(write=False)


def rigid_bar() -> Platform:
    """The sensor-file section of the bar. The clusters differ, so that one cannot be taken for the other."""
    return board(
        StickerRow((-0.190, -0.115, 0.110, 0.186), (0.006, -0.010, 0.010, -0.004)),
        StickerRow((-0.172, -0.120, 0.126, 0.194), (0.018, 0.045, 0.044, 0.030)),
        StickerRow((-0.194, -0.138, 0.108, 0.160), (0.044, 0.022, 0.028, 0.046)),
    )


def bar_ends(bar: MarkedBody) -> tuple[MarkedBody, MarkedBody]:
    """The clusters at -x and at +x, with their origins on the bar's axis, ``LENGTH`` apart, and axes like the bar's."""
    first = np.flatnonzero(bar.nominal[:, 0] < 0.0)
    second = np.flatnonzero(bar.nominal[:, 0] > 0.0)
    middle = np.array([0.5 * LENGTH, 0.0, 0.0])
    return (
        part_of_body(bar, "first end of the bar", first, -middle),
        part_of_body(bar, "second end of the bar", second, middle),
    )
