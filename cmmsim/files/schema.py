"""Schema of a sensor file (TOML), with units and ranges.

The ranges cover stereo cameras from microscopes to surveying instruments. A number outside of its
range probably has a typing error or a wrong unit, so it is refused. The JSON schema for editors
contains the ranges as well.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from cmmsim.allowed_plugins import AUTO, DEFAULT_DETECTOR, require_detector, require_renderer
from cmmsim.checks import Section, check_name
from cmmsim.errors import SensorFileError
from cmmsim.files.light_and_print import Lens, Light, Print
from cmmsim.files.quantities import (
    Angle,
    Bounds,
    Direction3,
    Distance,
    Distortion,
    Duration,
    Electrons,
    Frequency,
    Grey,
    GreyPerElectron,
    ImagePlace,
    Length,
    Level,
    Pixels,
    Place,
    Turn3,
    Vector3,
    quantity,
)
from cmmsim.geometry.pose import Array

# Deviations of a frame's latency from the mean are clipped to this many standard deviations.
WIDEST_JITTER = 3.0


class Timing(Section):
    """Timing of exposures and of the use of measured poses.

    A measured pose is the pose in the middle of its exposure.
    """

    frame_rate: Frequency = quantity(..., "Hz", "stereo frames per second")
    exposure: Duration = quantity(
        0.0, "s", "exposure time of an image; 0 means an instantaneous image without blur"
    )
    row_time: Annotated[float, Bounds(1e-9, 1e-4, "s", zero=True)] = quantity(
        0.0,
        "s",
        "time between the exposures of two rows of pixels; 0 means all rows at once, and the pose "
        "is that at the middle row",
    )
    latency: Duration = quantity(
        0.0, "s", "mean delay from the middle of the exposure to the use of the pose"
    )
    latency_jitter: Duration = quantity(
        0.0, "s", "standard deviation of the latency from frame to frame"
    )
    dropout: Annotated[float, Field(ge=0.0, le=1.0)] = quantity(
        0.0, "", "probability that a frame drops out"
    )

    @model_validator(mode="after")
    def _possible(self) -> Timing:
        """Raise ValueError for an exposure or a jitter that is too long."""
        if self.exposure * self.frame_rate > 1.0 + 1e-9:
            raise ValueError(
                f"exposure {self.exposure:g} s is longer than the frame period at "
                f"{self.frame_rate:g} Hz, {1.0 / self.frame_rate:.4g} s"
            )
        if self.latency_jitter > self.latency:
            raise ValueError(
                f"latency_jitter {self.latency_jitter:g} s is larger than latency {self.latency:g} "
                "s"
            )
        return self

    @property
    def largest_latency(self) -> float:
        """Largest latency that `drawn_latencies` can return, s."""
        return self.latency + self._widest_deviation

    def drawn_latencies(self, frames: int, rng: np.random.Generator) -> Array:
        """Draw a random latency (frames,) for each frame, s.

        Latencies are normal with mean ``latency`` and standard deviation ``latency_jitter``.
        Deviations from the mean are clipped to 3 standard deviations or to ``latency``, whichever
        is less, so that no latency is negative and the mean remains ``latency``.
        """
        widest = self._widest_deviation
        return self.latency + np.clip(rng.normal(0.0, self.latency_jitter, frames), -widest, widest)

    @property
    def _widest_deviation(self) -> float:
        return min(WIDEST_JITTER * self.latency_jitter, self.latency)


class Calibrated(Section):
    """Calibrated parameters of a camera, with the distortion coefficients of OpenCV."""

    focal_px: tuple[Pixels, Pixels] = quantity(..., "px", "focal lengths along x and y")
    centre_px: tuple[ImagePlace, ImagePlace] = quantity(..., "px", "principal point")
    distortion: tuple[Distortion, Distortion, Distortion, Distortion, Distortion] = quantity(
        (0.0, 0.0, 0.0, 0.0, 0.0), "", "k1, k2, p1, p2, k3 of the Brown-Conrady model"
    )


class RightFromLeft(Section):
    """Pose of the right camera: x_right = R(rotation_vector) x_left + translation."""

    translation: Vector3 = quantity(
        ..., "m", "position of the left camera in the right camera's frame"
    )
    rotation_vector: Turn3 = quantity(
        ..., "rad", "rotation from the left camera's frame to the right camera's frame"
    )


Row = Annotated[list[float], Field(min_length=24, max_length=24)]


class RigCovariance(Section):
    """Covariance of the calibrated parameters of both cameras, as ``cmmsim calibrate`` writes it.

    The parameters are fx, fy, cx, cy, k1, k2, p1, p2, k3 of the left and of the right camera, then
    translation and rotation vector of ``right_from_left``. Teaching from photographs adjusts the
    cameras within this covariance.
    """

    matrix: Annotated[list[Row], Field(min_length=24, max_length=24)] = quantity(
        ..., "", "covariance of 24 parameters, in squares of px, m and rad"
    )


class Rig(Section):
    """Both cameras and their poses.

    ``distance`` moves ``position`` along the line to ``target``, to this distance from ``target``.
    ``left`` and ``right`` replace ``focal_px`` and the principal point in the middle of the image.
    ``right_from_left`` replaces ``baseline`` and the toe-in of both cameras towards ``target``.
    """

    baseline: Length = quantity(..., "m", "distance between the cameras")
    focal_px: Pixels = quantity(..., "px", "focal length")
    width: Annotated[int, Field(ge=64, le=20_000)] = quantity(..., "px", "width of an image")
    height: Annotated[int, Field(ge=64, le=20_000)] = quantity(..., "px", "height of an image")
    position: Vector3 = quantity(..., "m", "middle of the baseline in the base frame")
    target: Vector3 = quantity(..., "m", "point at which both cameras look, in the base frame")
    distance: Length | None = quantity(
        None, "m", "distance from the middle of the baseline to the target"
    )
    left: Calibrated | None = None
    right: Calibrated | None = None
    right_from_left: RightFromLeft | None = None
    covariance: RigCovariance | None = None

    @model_validator(mode="after")
    def _at_its_distance(self) -> Rig:
        """Move ``position`` to the stated distance from ``target``."""
        if self.distance is not None:
            away = unit(np.subtract(self.position, self.target))
            self.__dict__["position"] = tuple(
                (np.array(self.target) + self.distance * away).tolist()
            )
        return self


class Camera(Section):
    """Noise parameters of both cameras after EMVA 1288.

    ``noise = false`` switches off all noise, including the fixed pattern of prnu and dsnu.
    ``pattern_seed`` is the seed of the fixed pattern. ``grey_noise_percent`` is stated
    in place of ``dark_noise``; a file, or its changes, with both is refused.
    """

    electrons_at_white: Electrons = quantity(..., "electrons", "electrons of a white pixel")
    gain: GreyPerElectron = quantity(..., "grey values per electron", "system gain")
    dark_noise: Electrons = quantity(..., "electrons", "dark noise, rms")
    grey_noise_percent: Annotated[float, Field(ge=0.0, le=20.0)] | None = quantity(
        None, "%", "grey-value noise without light in % of white, rms; in place of dark_noise"
    )
    full_well: Electrons = quantity(..., "electrons", "saturation capacity of a pixel")
    black_level: Grey = quantity(0.0, "grey values", "grey value without light")
    noise: bool = quantity(True, "", "true for images with noise")
    bit_depth: Literal[8, 10, 12, 14, 16] = quantity(8, "bit", "number of bits of a grey value")
    prnu: Annotated[float, Field(ge=0.0, le=0.2)] = quantity(
        0.0, "", "relative differences between the sensitivities of pixels, rms"
    )
    dsnu: Electrons = quantity(
        0.0, "electrons", "differences between the dark signals of pixels, rms"
    )
    pattern_seed: Annotated[int, Field(ge=0)] = quantity(0, "", "seed of the fixed pattern")

    @model_validator(mode="after")
    def _black_below_white(self) -> Camera:
        """Raise ValueError for a black level that is not below white."""
        if self.black_level >= 2**self.bit_depth - 1:
            raise ValueError(
                f"black_level {self.black_level:g} must lie below the largest grey value of "
                f"bit_depth {self.bit_depth}, {2**self.bit_depth - 1}"
            )
        return self

    @model_validator(mode="after")
    def _noise_of_white(self) -> Camera:
        """Set ``dark_noise`` to the value that ``grey_noise_percent`` states."""
        if self.grey_noise_percent is not None:
            white = (2**self.bit_depth - 1) / self.gain
            self.__dict__["dark_noise"] = self.grey_noise_percent / 100 * white
        return self


class Detection(Section):
    """Detection of stickers during measurement.

    :mod:`cmmsim.allowed_plugins` lists the detectors. Teaching always uses the maximum-likelihood
    detector, see :mod:`cmmsim.teaching`.
    """

    detector: Annotated[str, AfterValidator(require_detector)] = quantity(
        DEFAULT_DETECTOR, "", "detector of the centres of stickers"
    )


class Stickers(Section):
    """Stickers, which are bright discs in dark rings or the reverse, and grey levels of the scene.

    With ``sticker_level`` below ``ring_level``, stickers are dark discs in bright rings, such as
    the dots of a board.

    ``per_plane`` replaces the listed stickers on each plane of the platform by this number of
    stickers, evenly distributed on an ellipse.
    """

    radius: Length = quantity(..., "m", "radius of a sticker")
    ring_radius: Length = quantity(..., "m", "radius of the dark ring around a sticker")
    placement: tuple[Distance, Distance] = quantity(
        (0.0, 0.0), "m", "smallest and largest distance of a sticker from its nominal position"
    )
    placement_seed: Annotated[int, Field(ge=0)] = quantity(0, "", "seed of the stickers' positions")
    sticker_level: Level = quantity(..., "", "grey level of stickers, 0 to 255")
    ring_level: Level = quantity(..., "", "grey level of the dark rings, 0 to 255")
    body_level: Level = quantity(..., "", "grey level of platform and base, 0 to 255")
    obstacle_level: Level = quantity(..., "", "grey level of obstacles, 0 to 255")
    background_level: Level = quantity(0, "", "grey level of the background, 0 to 255")
    per_plane: Annotated[int, Field(ge=3, le=1000)] | None = quantity(
        None, "", "number of stickers on each plane of the platform, instead of the listed ones"
    )

    @model_validator(mode="after")
    def _disc_in_ring(self) -> Stickers:
        """Raise ValueError for stickers that cannot be detected, or impossible distances."""
        if self.ring_radius < self.radius:
            raise ValueError(
                f"ring_radius {self.ring_radius:g} m must be at least radius {self.radius:g} m: "
                "stickers are detected as discs in rings"
            )
        if self.sticker_level == self.ring_level:
            raise ValueError(
                f"sticker_level {self.sticker_level} must not be ring_level: stickers are detected "
                "as bright discs in dark rings, or as dark discs in bright rings"
            )
        if self.placement[0] > self.placement[1]:
            raise ValueError(
                f"placement {list(self.placement)} m must be the smallest and the largest "
                "distance, in this order"
            )
        return self

    @property
    def dark(self) -> bool:
        """True if stickers are darker than their rings."""
        return self.sticker_level < self.ring_level


class HalfSpace(Section):
    """Half space with an outward normal and a point on its plane, m.

    The normal need not have length one.
    """

    normal: Direction3
    point: Vector3


class StickerPlane(HalfSpace):
    """Plane with stickers at nominal positions [u, v] relative to ``point``, m.

    The u axis is ``across``, projected onto the plane.
    """

    across: Direction3
    stickers: Annotated[list[tuple[Place, Place]], Field(min_length=3)]


class Planes(Section):
    """The three planes of a body that carry stickers."""

    A: StickerPlane
    B: StickerPlane
    C: StickerPlane


class Body(Section):
    """Body with stickers on three planes.

    The body is the convex solid that the planes and ``cuts``, its other sides, enclose. With
    ``mesh``, it is a closed triangle mesh instead, in the same axes. The format is STL, OBJ, PLY or
    GLB. A relative path starts at the folder of the file that names the mesh.
    """

    planes: Planes
    cuts: list[HalfSpace] = Field(default_factory=list)
    mesh: str | None = quantity(None, "", "file of a closed triangle mesh")
    mesh_unit: Literal["m", "cm", "mm", "in"] = quantity("m", "", "unit of the mesh's coordinates")
    drop: bool = quantity(
        False, "", "true to move each plane of stickers along its normal onto the mesh"
    )

    @model_validator(mode="after")
    def _dropped_on_something(self) -> Body:
        if self.drop and self.mesh is None:
            raise ValueError("drop = true needs a mesh, onto which the stickers are dropped")
        return self


class Platform(Body):
    """Moving body. ``home`` is its pose at teaching, m and rad."""

    home: tuple[Place, Place, Place, Angle, Angle, Angle] = quantity(
        ..., "m, rad", "pose of the platform at teaching"
    )


class SensorFile(Section):
    """Sensor file.

    ``based_on`` is a built-in sensor, or the path of another sensor file relative to the folder of
    this file. It supplies the entries that this file lacks. ``note`` is a warning about the
    numbers, for example that they are assumed. :mod:`cmmsim.allowed_plugins` lists the values of
    ``renderer``; "auto" selects pyrender if OpenGL works, and otherwise analytic.
    """

    name: Annotated[str, AfterValidator(check_name)] = quantity(..., "", "name of the sensor")
    based_on: str | None = quantity(
        None,
        "",
        "built-in sensor, or path relative to this file's folder; supplies missing entries",
    )
    note: str = quantity("", "", "warning about the numbers in this file")
    renderer: Annotated[str, AfterValidator(require_renderer)] = quantity(
        AUTO, "", "renderer of the images, or statistical for detected stickers without images"
    )
    timing: Timing
    rig: Rig
    camera: Camera
    lens: Lens = Field(default_factory=Lens)
    light: Light = Field(default_factory=Light)
    print: Print = Field(default_factory=Print)
    detection: Detection = Field(default_factory=Detection)
    stickers: Stickers
    platform: Platform
    base: Body


def unit(vector: Vector3 | Array) -> Array:
    """Return a vector (3,), scaled to length one. Raises SensorFileError for a zero vector."""
    values = np.asarray(vector, dtype=float)
    length = float(np.linalg.norm(values))
    if length < 1e-9:
        raise SensorFileError(f"a direction must not be zero, got {values.tolist()}")
    return values / length
