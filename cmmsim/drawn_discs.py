"""Drawn images of tilted discs whose centres are known: exact, with the camera's noise, anywhere within a pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmmsim.detection.cramer_rao import light_shares
from cmmsim.errors import CmmError
from cmmsim.files.marked_body import marked_body
from cmmsim.files.rig import rig_from_file
from cmmsim.files.schema import NARROWEST_PSF, SensorFile
from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import Array, apply, pose_to_transform
from cmmsim.geometry.projected_disc import project_discs
from cmmsim.radiometry.noise import CameraNoise
from cmmsim.sensor import Sensor

TOGETHER = 100  # discs drawn at once
SMALLEST_RADIUS_PX, LARGEST_RADIUS_PX = 1.0, 50.0
LARGEST_TILT_DEG = 80.0


@dataclass(frozen=True)
class Condition:
    """How a disc is seen.

    radius_px: long half axis of the disc's image; tilt rad between its normal and the view; noise: standard deviation
    of a grey value half-way up the edge, as a share of the contrast; psf_px: sigma of the Gaussian point spread.
    """

    radius_px: float
    tilt: float
    noise: float
    psf_px: float = 0.0

    def __post_init__(self) -> None:
        if not (
            SMALLEST_RADIUS_PX <= self.radius_px < np.inf
            and 0.0 < self.noise < 1.0
            and 0.0 <= self.tilt <= np.radians(LARGEST_TILT_DEG)
        ):
            raise CmmError(
                f"a disc of {self} cannot be drawn: radius must be at least {SMALLEST_RADIUS_PX:g} px, tilt "
                f"0 to {LARGEST_TILT_DEG:g} degrees, noise above 0 and below 100 % of the contrast"
            )
        if not (self.psf_px == 0.0 or NARROWEST_PSF <= self.psf_px < np.inf):
            raise CmmError(f"a disc of {self} cannot be drawn: psf must be 0 or at least {NARROWEST_PSF:g} px")
        if self.radius_px > LARGEST_RADIUS_PX:
            raise CmmError(
                f"radius {self.radius_px:g} px is more than {LARGEST_RADIUS_PX:g} px: time and memory grow "
                "with its square, and errors only fall with its root"
            )

    def __str__(self) -> str:
        return (
            f"radius {self.radius_px:g} px, tilt {np.degrees(self.tilt):g} degrees, noise {100.0 * self.noise:g} % "
            f"of the contrast and psf {self.psf_px:g} px"
        )


@dataclass(frozen=True)
class Scene:
    """What is common to all conditions: the camera's noise, levels 0 to 1 of disc and ground, focal length px."""

    noise: CameraNoise
    bright: float
    dark: float
    focal_px: float

    @property
    def ground(self) -> float:
        """Mean grey value beside the disc."""
        return float(self.noise.mean_grey(np.array(self.dark)))

    @property
    def contrast(self) -> float:
        """Grey values from the ground to the disc."""
        return float(self.noise.mean_grey(np.array(self.bright))) - self.ground

    @property
    def edge_noise(self) -> float:
        """Standard deviation of a grey value half-way up the edge, as a share of the contrast."""
        return float(np.sqrt(self.noise.variance(np.array(self.ground + 0.5 * self.contrast)))) / self.contrast

    def with_noise(self, share: float) -> Scene:
        """The same camera with more or less light and less or more gain, so that ``edge_noise`` is ``share``.

        Raises CmmError where rounding alone makes more noise.
        """
        rounding = 1.0 / 12.0
        analog = (self.edge_noise * self.contrast) ** 2 - rounding
        wanted = (share * self.contrast) ** 2 - rounding
        if wanted <= 0.0:
            raise CmmError(
                f"noise of {share:.2%} of the contrast is less than that of rounding, "
                f"{np.sqrt(rounding) / self.contrast:.2%}"
            )
        light, noise = analog / wanted, self.noise
        return replace(
            self,
            noise=replace(
                noise,
                electrons_at_white=noise.electrons_at_white * light,
                full_well=noise.full_well * light,
                gain=noise.gain / light,
                dark_noise=noise.dark_noise * np.sqrt(light),
            ),
        )


def scene_of(file: SensorFile) -> Scene:
    """The scene of a sensor file's stickers and left camera."""
    rig = rig_from_file(file.rig)[0]
    noise = replace(Sensor(file).noise, prnu=0.0, dsnu=0.0)  # a pattern is no noise: it stays from image to image
    return Scene(noise, file.stickers.sticker_level / 255.0, file.stickers.ring_level / 255.0, rig.left.focal_px)


def working_point(file: SensorFile) -> Condition:
    """What a sensor file's left camera sees of the platform at home: median radius and tilt of the stickers that face
    it, and the camera's own noise."""
    rig, camera_from_base = rig_from_file(file.rig)
    body = marked_body("platform", file.platform)
    move = camera_from_base @ pose_to_transform(file.platform.home)
    centres, normals = apply(move, body.nominal), body.sticker_normals @ move[:3, :3].T
    cosine = -np.einsum("ni,ni->n", centres, normals) / np.linalg.norm(centres, axis=1)
    facing = cosine > 0.0
    shapes = project_discs(rig.left, centres, normals, np.full(len(centres), file.stickers.radius))[1]
    return Condition(
        float(np.median(np.linalg.eigvalsh(shapes[facing])[:, 1])),
        float(np.median(np.arccos(cosine[facing]))),
        scene_of(file).edge_noise,
        file.lens.psf_px,
    )


def random_ellipses(
    condition: Condition, focal_px: float, size: int, count: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Images of discs tilted towards random sides, centres (count,2) anywhere in a window's middle pixel, shapes
    (count,2,2), px."""
    middle = 0.5 * (size - 1)
    camera = PinholeCamera(focal_px, middle, middle, size, size)
    away = rng.uniform(-0.5, 0.5, (count, 2))
    side = rng.uniform(0.0, 2.0 * np.pi, count)
    normals = np.column_stack(
        [
            np.sin(condition.tilt) * np.cos(side),
            np.sin(condition.tilt) * np.sin(side),
            np.full(count, -np.cos(condition.tilt)),
        ]
    )
    places = np.column_stack([away / focal_px, np.ones(count)])  # at depth 1: only ratios matter
    return project_discs(camera, places, normals, np.full(count, condition.radius_px / focal_px))


def draw_discs(scene: Scene, centres: Array, shapes: Array, size: int, psf_px: float) -> NDArray[np.float32]:
    """Radiance (n, size, size) of bright discs on dark ground."""
    shares = [
        light_shares(centres[k : k + TOGETHER], shapes[k : k + TOGETHER], size, psf_px)
        for k in range(0, len(centres), TOGETHER)
    ]
    return (scene.dark + (scene.bright - scene.dark) * np.concatenate(shares)).astype(np.float32)
