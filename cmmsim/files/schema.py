"""Schema of a sensor file (TOML), with units and ranges.

The ranges cover stereo cameras from microscopes to surveying. A number outside its range is a
typing error or has a wrong unit, and would make the computed results meaningless. Schemas for
editors show the ranges as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    model_validator,
)
from pydantic_core import CoreSchema, core_schema

from cmmsim.allowed_plugins import AUTO, DEFAULT_DETECTOR, require_detector, require_renderer
from cmmsim.checks import Section, check_name
from cmmsim.errors import SensorFileError
from cmmsim.geometry.pose import Array

Level = Annotated[int, Field(ge=0, le=255)]
# Standard deviations: no frame's latency is farther from the mean.
WIDEST_JITTER = 3.0
# px: a narrower point spread is lost between the points that images are drawn on.
NARROWEST_PSF = 0.1


@dataclass(frozen=True)
class Within:
    """Range of a number from ``least`` to ``most``, in a unit; ``zero`` says that 0 is valid as
    well.
    """

    least: float
    most: float
    unit: str = ""
    zero: bool = False

    def check(self, value: float | None) -> float | None:
        """Return the value. Raises ValueError, with the range, if it lies outside."""
        if value is None or self.least <= value <= self.most or (self.zero and value == 0.0):
            return value
        also = "0 or " if self.zero else ""
        words = f"{also}{self.least:g} to {self.most:g} {self.unit}".rstrip()
        raise ValueError(f"{value:g} is beyond what a machine can have, {words}")

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        inner = handler(source)
        # Neither texts nor truth values are numbers.
        if inner["type"] == "float":
            inner = {**inner, "strict": True, "allow_inf_nan": False}
        return core_schema.no_info_after_validator_function(self.check, inner)

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        least = min(self.least, 0.0) if self.zero else self.least
        # A field may have narrower limits of its own, which hold as well.
        shown = handler(schema)
        return {
            **shown,
            "minimum": max(least, shown.get("minimum", least)),
            "maximum": min(self.most, shown.get("maximum", self.most)),
        }


Length = Annotated[float, Within(1e-6, 1e3, "m")]
Distance = Annotated[float, Within(1e-9, 1e3, "m", zero=True)]
Place = Annotated[float, Within(-1e3, 1e3, "m")]
"""Coordinate of a point."""
Angle = Annotated[float, Within(-1e2, 1e2, "rad")]
Component = Annotated[float, Within(-1e6, 1e6)]
"""Component of a direction, whose length does not count."""
Pixels = Annotated[float, Within(1.0, 1e7, "px")]
ImagePlace = Annotated[float, Within(-1e6, 1e6, "px")]
Distortion = Annotated[float, Within(-1e4, 1e4)]
Electrons = Annotated[float, Within(1e-6, 1e9, "electrons", zero=True)]
GreyPerElectron = Annotated[float, Within(1e-9, 1e6, "grey values per electron")]
Grey = Annotated[float, Within(1e-6, 1e5, "grey values", zero=True)]
Frequency = Annotated[float, Within(1e-3, 1e6, "Hz")]
Duration = Annotated[float, Within(1e-9, 1e4, "s", zero=True)]


Vector3 = tuple[Place, Place, Place]
Turn3 = tuple[Angle, Angle, Angle]
Direction3 = tuple[Component, Component, Component]


def quantity(default: Any, unit: str, what: str) -> Any:
    """Return a field with a unit, which may be empty; the default ``...`` means that there is
    none.
    """
    return Field(default, description=what, json_schema_extra={"unit": unit} if unit else None)


class Timing(Section):
    """Times of the exposures, and of the use of their poses.

    A measured pose is the pose in the middle of its exposure.
    """

    frame_rate: Frequency = quantity(..., "Hz", "stereo frames a second")
    exposure: Duration = quantity(
        0.0, "s", "time in which a picture gathers light; 0 is an instant"
    )
    latency: Duration = quantity(
        0.0, "s", "mean delay from the middle of the exposure to the use of the pose"
    )
    latency_jitter: Duration = quantity(
        0.0, "s", "standard deviation of the latency from frame to frame"
    )
    dropout: Annotated[float, Field(ge=0.0, le=1.0)] = quantity(
        0.0, "", "probability that a frame is lost"
    )

    @model_validator(mode="after")
    def _possible(self) -> Timing:
        if self.exposure * self.frame_rate > 1.0 + 1e-9:
            raise ValueError(
                f"exposure {self.exposure:g} s is longer than a frame of {self.frame_rate:g} Hz, "
                f"{1.0 / self.frame_rate:.4g} s"
            )
        if self.latency_jitter > self.latency:
            raise ValueError(
                f"latency_jitter {self.latency_jitter:g} s is larger than latency {self.latency:g} "
                "s"
            )
        return self

    @property
    def largest_latency(self) -> float:
        """The longest latency that can be drawn, s."""
        return self.latency + self._widest_deviation

    def drawn_latencies(self, frames: int, rng: np.random.Generator) -> Array:
        """Draw the latency of each frame (frames,), s, from the middle of its exposure to the
        pose's use.

        It is normal about ``latency`` with standard deviation ``latency_jitter``. Its deviation is
        clipped to 3 standard deviations or to ``latency``, whichever is less. So no latency is
        negative, and the mean remains ``latency``.
        """
        widest = self._widest_deviation
        return self.latency + np.clip(rng.normal(0.0, self.latency_jitter, frames), -widest, widest)

    @property
    def _widest_deviation(self) -> float:
        return min(WIDEST_JITTER * self.latency_jitter, self.latency)


class Calibrated(Section):
    """A camera as calibrated; distortion in OpenCV's order and meaning."""

    focal_px: tuple[Pixels, Pixels] = quantity(..., "px", "focal lengths along x and y")
    centre_px: tuple[ImagePlace, ImagePlace] = quantity(..., "px", "principal point")
    distortion: tuple[Distortion, Distortion, Distortion, Distortion, Distortion] = quantity(
        (0.0, 0.0, 0.0, 0.0, 0.0), "", "k1, k2, p1, p2, k3 of Brown and Conrady"
    )


class RightFromLeft(Section):
    """Place of the right camera: x_right = R(rotation_vector) x_left + translation."""

    translation: Vector3 = quantity(
        ..., "m", "place of the left camera's origin in the right camera's frame"
    )
    rotation_vector: Turn3 = quantity(
        ..., "rad", "rotation from the left camera's frame to the right one's"
    )


class Rig(Section):
    """Both cameras and their places.

    With ``distance``, the position is moved along its line to the target to stand that far from it.
    ``left`` and ``right`` replace focal_px and the principal point in the middle of the image.
    ``right_from_left`` replaces the baseline and the toe-in towards the target.
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

    @model_validator(mode="after")
    def _at_its_distance(self) -> Rig:
        if self.distance is not None:
            away = unit(np.subtract(self.position, self.target))
            self.__dict__["position"] = tuple(
                (np.array(self.target) + self.distance * away).tolist()
            )
        return self


class Camera(Section):
    """EMVA 1288 figures of a camera.

    ``noise = false`` leaves out all noise, and the pattern of prnu and dsnu. ``pattern_seed`` makes
    another specimen.
    """

    electrons_at_white: Electrons = quantity(..., "electrons", "electrons of a white pixel")
    gain: GreyPerElectron = quantity(..., "grey values per electron", "grey values per electron")
    dark_noise: Electrons = quantity(..., "electrons", "dark noise, rms")
    full_well: Electrons = quantity(..., "electrons", "electrons that a pixel holds")
    black_level: Grey = quantity(0.0, "grey values", "grey value of black")
    noise: bool = quantity(True, "", "whether pictures have noise")
    bit_depth: Literal[8, 10, 12] = quantity(8, "bit", "bits of a grey value")
    prnu: Annotated[float, Field(ge=0.0, le=0.2)] = quantity(
        0.0, "", "relative differences between the gains of pixels, rms"
    )
    dsnu: Electrons = quantity(
        0.0, "electrons", "differences between the dark levels of pixels, rms"
    )
    pattern_seed: Annotated[int, Field(ge=0)] = quantity(0, "", "which specimen of a camera")

    @model_validator(mode="after")
    def _black_below_white(self) -> Camera:
        if self.black_level >= 2**self.bit_depth - 1:
            raise ValueError(
                f"black_level {self.black_level:g} must lie below the largest grey value of "
                f"bit_depth {self.bit_depth}, {2**self.bit_depth - 1}"
            )
        return self


class Lens(Section):
    """Effects of both lenses beside the distortion that stands with each camera.

    The vignetting grows with the square of the distance from the principal point.
    """

    psf_px: Annotated[float, Field(ge=0.0, le=4.0)] = quantity(
        0.0, "px", "standard deviation of the Gaussian point spread"
    )
    vignetting: Annotated[float, Field(ge=0.0, le=0.9)] = quantity(
        0.0, "", "share of the light missing in the farthest corner"
    )

    @model_validator(mode="after")
    def _drawable(self) -> Lens:
        if 0.0 < self.psf_px < NARROWEST_PSF:
            raise ValueError(f"psf_px {self.psf_px:g} must be 0 or at least {NARROWEST_PSF:g} px")
        return self


class Detection(Section):
    """Detector of stickers in windows when poses are measured, see :mod:`cmmsim.allowed_plugins`.

    Teaching always uses the maximum-likelihood detector, see :mod:`cmmsim.teaching`.
    """

    detector: Annotated[str, AfterValidator(require_detector)] = quantity(
        DEFAULT_DETECTOR, "", "what finds the centres of stickers"
    )


class Stickers(Section):
    """Bright discs in dark rings.

    ``per_plane`` puts that many stickers on each plane of the platform instead of those listed
    there, evenly on an ellipse.
    """

    radius: Length = quantity(..., "m", "radius of a sticker")
    ring_radius: Length = quantity(..., "m", "radius of the dark ring around a sticker")
    placement: tuple[Distance, Distance] = quantity(
        (0.0, 0.0), "m", "smallest and largest distance of a sticker from its nominal place"
    )
    placement_seed: Annotated[int, Field(ge=0)] = quantity(0, "", "which places of the stickers")
    sticker_level: Level = quantity(..., "", "grey level of a sticker, of 255")
    ring_level: Level = quantity(..., "", "grey level of its ring, of 255")
    body_level: Level = quantity(..., "", "grey level of the bodies, of 255")
    obstacle_level: Level = quantity(..., "", "grey level of what stands in the way, of 255")
    background_level: Level = quantity(0, "", "grey level of the background, of 255")
    per_plane: Annotated[int, Field(ge=3, le=1000)] | None = quantity(
        None, "", "stickers on each plane of the platform"
    )

    @model_validator(mode="after")
    def _bright_on_dark(self) -> Stickers:
        if self.ring_radius < self.radius:
            raise ValueError(
                f"ring_radius {self.ring_radius:g} m must be at least radius {self.radius:g} m: "
                "stickers are found as bright discs within dark rings"
            )
        if self.sticker_level <= self.ring_level:
            raise ValueError(
                f"sticker_level {self.sticker_level} must be above ring_level {self.ring_level}: "
                "stickers are found as bright discs within dark rings"
            )
        if self.placement[0] > self.placement[1]:
            raise ValueError(
                f"placement {list(self.placement)} m is the smallest and the largest distance, in "
                "this order"
            )
        return self


class HalfSpace(Section):
    """Half space with an outward normal of any length, and a point on its plane, m."""

    normal: Direction3
    point: Vector3


class StickerPlane(HalfSpace):
    """Plane with stickers at nominal places [u, v], m from its point; ``across`` gives the u
    axis.
    """

    across: Direction3
    stickers: Annotated[list[tuple[Place, Place]], Field(min_length=3)]


class Planes(Section):
    """The three planes of a body."""

    A: StickerPlane
    B: StickerPlane
    C: StickerPlane


class Body(Section):
    """A convex body with stickers on three planes."""

    planes: Planes
    cuts: list[HalfSpace]


class Platform(Body):
    """Moving body; ``home`` is its pose at teaching, m and rad."""

    home: tuple[Place, Place, Place, Angle, Angle, Angle] = quantity(
        ..., "m, rad", "pose of the platform at teaching"
    )


class SensorFile(Section):
    """Whole sensor file.

    ``based_on`` names a built-in sensor, or a file by its path from this file's folder. It supplies
    the entries that this file lacks. ``note`` is a warning about the figures, such as that they are
    assumed. ``renderer`` is one of :mod:`cmmsim.allowed_plugins`; "auto" takes pyrender where
    OpenGL works, and otherwise analytic.
    """

    name: Annotated[str, AfterValidator(check_name)] = quantity(..., "", "name of the sensor")
    based_on: str | None = quantity(
        None,
        "",
        "built-in sensor, or path of a file from this folder; supplies missing entries",
    )
    note: str = quantity("", "", "what a user must know of the figures")
    renderer: Annotated[str, AfterValidator(require_renderer)] = quantity(
        AUTO, "", "what draws the images, or says what would be found in them"
    )
    timing: Timing
    rig: Rig
    camera: Camera
    lens: Lens = Field(default_factory=Lens)
    detection: Detection = Field(default_factory=Detection)
    stickers: Stickers
    platform: Platform
    base: Body


def unit(vector: Vector3 | Array) -> Array:
    """Return a vector (3,) of length one. Raises SensorFileError for a zero vector."""
    values = np.asarray(vector, dtype=float)
    length = float(np.linalg.norm(values))
    if length < 1e-9:
        raise SensorFileError(f"a direction must not be zero, got {values.tolist()}")
    return values / length
