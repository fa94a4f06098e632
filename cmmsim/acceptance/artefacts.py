"""Artefacts of the acceptance tests, and the sensor under test.

An artefact is a long board with a ridge and stickers on its three upper sides. The x axis of its
frame points along the board, and the z axis out of the front side A. The origin is the middle of
that side. Sides B and C slope away from A by SLOPE, so that all stickers are seen from the front.
"""

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from cmmsim.errors import AcceptanceError, LostError
from cmmsim.files.rig_and_bodies import MarkedBody, rig_from_file
from cmmsim.files.schema import Body, HalfSpace, Planes, Platform, Rig, SensorFile, StickerPlane
from cmmsim.geometry.pose import Array, frozen, invert, rigid
from cmmsim.imaging.pyrender_renderer import require_opengl
from cmmsim.imaging.renderer import choose_renderer
from cmmsim.measuring.pose_estimator import PoseEstimator
from cmmsim.measuring.taught import Taught
from cmmsim.radiometry.stereo_images import StereoImages
from cmmsim.sensor import Sensor

H = TypeVar("H", bound=HalfSpace)
SLOPE = np.deg2rad(15.0)  # angle between side A and each of sides B and C
# Half the width of side A, m.
HALF_RIDGE = 0.020
# Width of sides B and C, m.
SIDE_WIDTH = 0.060
# Length of the board beyond its outermost stickers, m.
END_LENGTH = 0.020
# Distance by which the base is moved behind the cameras, m.
OUT_OF_SIGHT = 100.0
# Distance between the origins of the two end frames of the rigid bar, which lie on its x axis, m.
LENGTH = 0.300
# Half the length and half the width of the rigid bar, rounded up, m.
HALF_LENGTH = 0.5 * LENGTH + 0.065
HALF_WIDTH = HALF_RIDGE + SIDE_WIDTH
# True transform from the frame of the second end to the frame of the first end.
FIRST_FROM_SECOND = frozen(rigid(np.eye(3), (LENGTH, 0.0, 0.0)))

# Coordinates of the stickers of one side: along (n,) and across (n,) the artefact, m. Along is
# counted from the middle of the artefact. Across is counted from the middle line on side A. On
# sides B and C, it is counted from the edge that is shared with side A.
StickerRow = tuple[ArrayLike, ArrayLike]


def board(a: StickerRow, b: StickerRow, c: StickerRow) -> Platform:
    """Return the sensor-file section of an artefact with rows of stickers on its sides A, B and C.

    Side B lies towards +y, and side C towards -y.
    """
    reach = max(float(np.abs(along).max()) for along, _ in (a, b, c)) + END_LENGTH
    sine = float(np.sin(SLOPE))
    cosine = float(np.cos(SLOPE))
    sides = {
        "A": _side((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), a, 1.0),
        "B": _side((0.0, sine, cosine), (0.0, HALF_RIDGE, 0.0), b, 1.0),
        "C": _side((0.0, -sine, cosine), (0.0, -HALF_RIDGE, 0.0), c, -1.0),
    }
    width = HALF_RIDGE + SIDE_WIDTH * cosine
    cuts = [
        HalfSpace(normal=normal, point=point)
        for normal, point in (
            ((1.0, 0.0, 0.0), (reach, 0.0, 0.0)),
            ((-1.0, 0.0, 0.0), (-reach, 0.0, 0.0)),
            ((0.0, 1.0, 0.0), (0.0, width, 0.0)),
            ((0.0, -1.0, 0.0), (0.0, -width, 0.0)),
            ((0.0, 0.0, -1.0), (0.0, 0.0, -SIDE_WIDTH * sine - 0.05)),
        )
    ]
    return Platform(planes=Planes(**sides), cuts=cuts, home=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))


def artefact_file(file: SensorFile, artefact: Platform) -> SensorFile:
    """Return the sensor file with an artefact instead of the platform, and the base out of sight.

    The artefact's stickers lie exactly at their nominal positions, which its certificate states.
    """
    stickers = file.stickers.model_copy(update={"placement": (0.0, 0.0)})
    return file.model_copy(
        update={"platform": artefact, "base": _behind(file.base, file.rig), "stickers": stickers}
    )


def _side(
    normal: tuple[float, float, float],
    point: tuple[float, float, float],
    row: StickerRow,
    sign: float,
) -> StickerPlane:
    """Return one side with its stickers.

    The axis u runs along the artefact. With the side's normal n, v = n x u points towards +y on all
    sides. On side C, ``sign`` is -1, because coordinates across are counted towards -y.
    """
    stickers = [(float(u), sign * float(v)) for u, v in np.column_stack(row)]
    return StickerPlane(normal=normal, point=point, across=(1.0, 0.0, 0.0), stickers=stickers)


def rigid_bar() -> Platform:
    """Return the sensor-file section of the bar, with a cluster of six stickers at each end.

    The sensor measures each cluster as a separate rigid body. The clusters differ, so that the
    sensor cannot confuse them.
    """
    return board(
        ((-0.190, -0.115, 0.110, 0.186), (0.006, -0.010, 0.010, -0.004)),
        ((-0.172, -0.120, 0.126, 0.194), (0.018, 0.045, 0.044, 0.030)),
        ((-0.194, -0.138, 0.108, 0.160), (0.044, 0.022, 0.028, 0.046)),
    )


def bar_ends(bar: MarkedBody) -> tuple[MarkedBody, MarkedBody]:
    """Return the sticker clusters at -x and at +x as two bodies with axes parallel to the bar's.

    The origins of the bodies lie on the bar's x axis, ``LENGTH`` apart.
    """
    return _end(bar, "first end of the bar", -1.0), _end(bar, "second end of the bar", 1.0)


def _end(bar: MarkedBody, name: str, side: float) -> MarkedBody:
    """Return the stickers at one end of the bar as a body.

    The end lies towards -x or +x, as the sign ``side`` states. The body's origin lies half of
    ``LENGTH`` from the middle of the bar.
    """
    keep = np.flatnonzero(side * bar.nominal[:, 0] > 0.0)
    origin = np.array([0.5 * side * LENGTH, 0.0, 0.0])
    return replace(
        bar,
        name=name,
        offsets=bar.offsets - bar.normals @ origin,
        sticker_ids=bar.sticker_ids[keep],
        plane_index=bar.plane_index[keep],
        nominal=bar.nominal[keep] - origin,
        in_plane=bar.in_plane[keep],
    )


def _behind(body: Body, rig: Rig) -> Body:
    """Return a body moved by OUT_OF_SIGHT against the direction of view."""
    view = np.array(rig.target) - np.array(rig.position)
    shift = -OUT_OF_SIGHT * view / np.linalg.norm(view)
    planes = Planes(
        A=_moved(body.planes.A, shift),
        B=_moved(body.planes.B, shift),
        C=_moved(body.planes.C, shift),
    )
    return body.model_copy(
        update={"planes": planes, "cuts": [_moved(cut, shift) for cut in body.cuts]}
    )


def _moved(half_space: H, shift: Array) -> H:
    """Return the half-space moved by ``shift`` (3,) m."""
    x, y, z = np.array(half_space.point) + shift
    return half_space.model_copy(update={"point": (float(x), float(y), float(z))})


@dataclass(frozen=True)
class SensorUnderTest:
    """Sensor under test: its file, the seed of all its noise, and the name of a renderer.

    The default renderer is that of the file.
    """

    file: SensorFile
    seed: int = 0
    renderer: str | None = None

    def facing(self, artefact: Platform, stream: int) -> Sensor:
        """Return the sensor with an artefact instead of its platform.

        Different values of ``stream`` give independent noise.
        """
        sensor = Sensor(artefact_file(self.file, artefact), self.seed, renderer=self.renderer)
        sensor.start_run(self.seed + 1000 * stream)
        return sensor

    def renderer_name(self) -> str:
        """Return the name of the renderer in use; "auto" is resolved.

        Raises UnknownOptionError for an unknown renderer, and OpenGLMissingError if the renderer
        needs OpenGL but OpenGL is missing.
        """
        name = choose_renderer(self.renderer or self.file.renderer).name
        if name == "pyrender":
            require_opengl()
        return name

    @property
    def base_from_camera(self) -> Array:
        """Transform base_from_camera (4, 4) from the sensor file."""
        return invert(rig_from_file(self.file.rig)[1])


def estimator_of(
    sensor: Sensor, body: MarkedBody, base_from_camera: Array | None = None
) -> PoseEstimator:
    """Return the sensor's pose estimator for a body with certified sticker positions.

    Poses are in the base frame if ``base_from_camera`` (4, 4) is given, else in the camera frame.
    """
    output_from_camera = np.eye(4) if base_from_camera is None else base_from_camera
    taught = Taught.without_error(
        sensor.name, output_from_camera, body.nominal.copy(), np.zeros((0, 3))
    )
    return PoseEstimator(sensor.rig, sensor.noise, sensor.settings, body, taught)


def locate(estimator: PoseEstimator, images: StereoImages) -> Array:
    """Return a rough camera_from_body (4, 4), found in whole images.

    Raises AcceptanceError, which names the body, if the body is not found.
    """
    try:
        return estimator.locate(images)
    except LostError as error:
        raise AcceptanceError(
            f"the {estimator.platform.name} is not found in the images: {error}"
        ) from error
