"""What may stand in a sensor file (TOML), with units."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from cmmsim.checks import Section
from cmmsim.errors import SensorFileError
from cmmsim.geometry.pose import Array
from cmmsim.plugins import AUTO, DEFAULT_DETECTOR, require_detector, require_renderer

Vector3 = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Level = Annotated[int, Field(ge=0, le=255)]
WIDEST_JITTER = 3.0  # standard deviations: no frame's latency is farther from the mean
NARROWEST_PSF = 0.1  # px: a narrower point spread is lost between the points that images are drawn on


class Timing(Section):
    """When the sensor looks, and when its poses can be used.

    frame_rate Hz; exposure s: a measured pose is that in its middle; latency s, from the middle of the exposure to the
    use of the pose, and latency_jitter s, its standard deviation from frame to frame; dropout: probability that a frame
    is lost before anyone sees it.
    """

    frame_rate: Positive
    exposure: NotNegative = 0.0
    latency: NotNegative = 0.0
    latency_jitter: NotNegative = 0.0
    dropout: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0

    @model_validator(mode="after")
    def _possible(self) -> Timing:
        if self.exposure * self.frame_rate > 1.0 + 1e-9:
            raise ValueError(
                f"exposure {self.exposure:g} s is longer than a frame of {self.frame_rate:g} Hz, "
                f"{1.0 / self.frame_rate:.4g} s"
            )
        if self.latency_jitter > self.latency:
            raise ValueError(f"latency_jitter {self.latency_jitter:g} s is larger than latency {self.latency:g} s")
        return self

    @property
    def largest_latency(self) -> float:
        """The longest latency that can be drawn, s."""
        return self.latency + self._widest_deviation

    def drawn_latencies(self, frames: int, rng: np.random.Generator) -> Array:
        """Latency of each frame (frames,), s, from the middle of its exposure to the use of its pose.

        Normal about ``latency`` with standard deviation ``latency_jitter``, clipped on both sides to 3 of those or to
        the latency itself, whichever is less: none is negative, and the mean stays the stated latency.
        """
        widest = self._widest_deviation
        return self.latency + np.clip(rng.normal(0.0, self.latency_jitter, frames), -widest, widest)

    @property
    def _widest_deviation(self) -> float:
        return min(WIDEST_JITTER * self.latency_jitter, self.latency)


class Calibrated(Section):
    """A camera as calibrated: focal_px along x and y and centre_px, the principal point, px; distortion k1, k2, p1, p2,
    k3 of Brown and Conrady in OpenCV's order and meaning."""

    focal_px: tuple[Positive, Positive]
    centre_px: tuple[float, float]
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)


class RightFromLeft(Section):
    """Where the right camera stands: x_right = R(rotation_vector) x_left + translation; m and rad."""

    translation: Vector3
    rotation_vector: Vector3


class Rig(Section):
    """baseline m; focal_px, width, height px; position (the middle of the baseline) and target m in the base frame.

    distance m, where given: the position is moved along its line to the target to stand that far from it.
    left and right, where given, replace focal_px and the principal point in the middle of the image; right_from_left
    replaces the baseline and the toe-in towards the target.
    """

    baseline: Positive
    focal_px: Positive
    width: Annotated[int, Field(ge=64)]
    height: Annotated[int, Field(ge=64)]
    position: Vector3
    target: Vector3
    distance: Positive | None = None
    left: Calibrated | None = None
    right: Calibrated | None = None
    right_from_left: RightFromLeft | None = None

    @model_validator(mode="after")
    def _at_its_distance(self) -> Rig:
        if self.distance is not None:
            away = unit(np.subtract(self.position, self.target))
            self.__dict__["position"] = tuple((np.array(self.target) + self.distance * away).tolist())
        return self


class Camera(Section):
    """EMVA 1288 figures: electrons, grey values per electron, grey values; prnu relative, dsnu electrons.

    noise = false leaves out all noise, the pattern of prnu and dsnu too; pattern_seed makes another specimen.
    """

    electrons_at_white: Positive
    gain: Positive
    dark_noise: NotNegative
    full_well: Positive
    black_level: NotNegative = 0.0
    noise: bool = True
    bit_depth: Literal[8, 10, 12] = 8
    prnu: Annotated[float, Field(ge=0.0, le=0.2)] = 0.0
    dsnu: NotNegative = 0.0
    pattern_seed: Annotated[int, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _black_below_white(self) -> Camera:
        if self.black_level >= 2**self.bit_depth - 1:
            raise ValueError(
                f"black_level {self.black_level:g} must lie below the largest grey value of bit_depth "
                f"{self.bit_depth}, {2**self.bit_depth - 1}"
            )
        return self


class Lens(Section):
    """What both lenses do beside the distortion that stands with each camera.

    psf_px: standard deviation of the Gaussian point spread, px; vignetting: share of the light missing in the corner
    farthest from the principal point, growing with the square of the distance.
    """

    psf_px: Annotated[float, Field(ge=0.0, le=4.0)] = 0.0
    vignetting: Annotated[float, Field(ge=0.0, le=0.9)] = 0.0

    @model_validator(mode="after")
    def _drawable(self) -> Lens:
        if 0.0 < self.psf_px < NARROWEST_PSF:
            raise ValueError(f"psf_px {self.psf_px:g} must be 0 or at least {NARROWEST_PSF:g} px")
        return self


class Detection(Section):
    """detector: which one finds the centres of stickers in windows when poses are measured, see :mod:`cmmsim.plugins`.

    Teaching always takes the maximum-likelihood one, whichever is named here; see :mod:`cmmsim.teaching`.
    """

    detector: Annotated[str, AfterValidator(require_detector)] = DEFAULT_DETECTOR


class Stickers(Section):
    """Radii and placement distances m; levels of 255.

    per_plane: that many stickers on each plane of the platform instead of those listed there, evenly on an ellipse.
    """

    radius: Positive
    ring_radius: Positive
    placement: tuple[NotNegative, NotNegative] = (0.0, 0.0)
    placement_seed: Annotated[int, Field(ge=0)] = 0
    sticker_level: Level
    ring_level: Level
    body_level: Level
    obstacle_level: Level
    background_level: Level = 0
    per_plane: Annotated[int, Field(ge=3)] | None = None

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
                f"placement {list(self.placement)} m is the smallest and the largest distance, in this order"
            )
        return self


class HalfSpace(Section):
    """normal outwards, any length; point on the plane, m."""

    normal: Vector3
    point: Vector3


class StickerPlane(HalfSpace):
    """across gives the u axis; stickers are nominal places [u, v], m from the point."""

    across: Vector3
    stickers: Annotated[list[tuple[float, float]], Field(min_length=3)]


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
    """The moving body; home is its pose at teaching, [m, rad]."""

    home: tuple[float, float, float, float, float, float]


class SensorFile(Section):
    """A whole sensor file.

    based_on: a built-in sensor, or a file beside this one, whose entries hold where this file has none; note: what a
    user must know of the figures, such as that they are assumed; renderer: which one draws, see
    :mod:`cmmsim.plugins`; "auto" takes pyrender where OpenGL works, else analytic.
    """

    name: str
    based_on: str | None = None
    note: str = ""
    renderer: Annotated[str, AfterValidator(require_renderer)] = AUTO
    timing: Timing
    rig: Rig
    camera: Camera
    lens: Lens = Field(default_factory=Lens)
    detection: Detection = Field(default_factory=Detection)
    stickers: Stickers
    platform: Platform
    base: Body


def unit(vector: Vector3 | Array) -> Array:
    """Vector (3,) of length one. Raises SensorFileError for a zero vector."""
    values = np.asarray(vector, dtype=float)
    length = float(np.linalg.norm(values))
    if length < 1e-9:
        raise SensorFileError(f"a direction must not be zero, got {values.tolist()}")
    return values / length
