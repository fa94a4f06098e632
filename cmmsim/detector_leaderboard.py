"""Leaderboard of the detectors: their errors on images of tilted discs, and the Cramer-Rao bound.

The discs are drawn exactly, at known random positions within a pixel, and the camera's noise is
added. An error is the detected centre minus the centre of the drawn ellipse. The eccentricity, the
distance of this centre from the image of the disc's centre, is not part of the error. Two methods
of OpenCV are compared as well.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cmmsim.allowed_plugins import DEFAULT_DETECTOR, DETECTORS
from cmmsim.detection.cramer_rao import cramer_rao_bound
from cmmsim.detection.detector import (
    DetectedCentres,
    Detector,
    FitLimits,
    SpotWindows,
    find_detector,
)
from cmmsim.errors import CmmError
from cmmsim.files.light_and_print import NARROWEST_PSF
from cmmsim.files.rig_and_bodies import marked_body, rig_from_file
from cmmsim.files.schema import SensorFile
from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.disc_image import coverage, project_discs
from cmmsim.geometry.pose import Array, apply, pose_to_transform
from cmmsim.radiometry.noise import CameraNoise
from cmmsim.sensor import Sensor

TOGETHER = 100  # largest number of discs that are drawn together
# Limits of a condition.
SMALLEST_RADIUS_PX = 1.0
LARGEST_RADIUS_PX = 50.0
LARGEST_TILT_DEG = 80.0
FREE_PX = 3  # pixels between a sharp disc's rim and the edge of the fitted part of the window
RESAMPLES = 1000  # number of bootstrap samples for the interval of a ratio
CONFIDENCE = 0.95  # probability that this interval contains the ratio
# If the noise is below half a grey value, the rounding errors of neighbouring pixels are
# correlated. A limit on the misfit assumes independent errors, so it would reject good windows.
LIMITS = FitLimits(largest_misfit=np.inf)


@dataclass(frozen=True)
class Condition:
    """Conditions under which a disc is seen.

    radius_px  semi-major axis of the disc's image
    tilt       angle between the disc's normal and the line of sight, rad
    noise      standard deviation of a grey value midway between disc and background, as a fraction
               of their contrast
    psf_px     sigma of the Gaussian point spread

    Raises CmmError for a disc that cannot be drawn.
    """

    radius_px: float
    tilt: float
    noise: float
    psf_px: float = 0.0

    def __post_init__(self) -> None:
        sized = SMALLEST_RADIUS_PX <= self.radius_px < np.inf
        tilted = 0.0 <= self.tilt <= np.radians(LARGEST_TILT_DEG)
        if not (sized and tilted and 0.0 < self.noise < 1.0):
            raise CmmError(
                f"a disc of {self} cannot be drawn: radius must be at least {SMALLEST_RADIUS_PX:g} "
                f"px, tilt 0 to {LARGEST_TILT_DEG:g} degrees, noise above 0 and below 100 % of the "
                "contrast"
            )
        if not (self.psf_px == 0.0 or NARROWEST_PSF <= self.psf_px < np.inf):
            raise CmmError(
                f"a disc of {self} cannot be drawn: psf must be 0 or at least {NARROWEST_PSF:g} px"
            )
        if self.radius_px > LARGEST_RADIUS_PX:
            raise CmmError(
                f"radius {self.radius_px:g} px is more than {LARGEST_RADIUS_PX:g} px: time and "
                "memory grow with its square, but errors fall only with its square root"
            )

    def __str__(self) -> str:
        return (
            f"radius {self.radius_px:g} px, tilt {np.degrees(self.tilt):g} degrees, noise "
            f"{100.0 * self.noise:g} % of the contrast and psf {self.psf_px:g} px"
        )


@dataclass(frozen=True)
class Scene:
    """Properties that all conditions share.

    They are the camera's noise, the radiances 0 to 1 of disc and background, and the focal length
    in px.
    """

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
        """Step in grey values from the background to the disc."""
        return float(self.noise.mean_grey(np.array(self.bright))) - self.ground

    @property
    def edge_noise(self) -> float:
        """Noise as in ``Condition``: standard deviation midway between disc and background."""
        return (
            float(np.sqrt(self.noise.variance(np.array(self.ground + 0.5 * self.contrast))))
            / self.contrast
        )

    def with_noise(self, fraction: float) -> "Scene":
        """Return the scene with light and gain such that ``edge_noise`` equals ``fraction``.

        Raises CmmError if the noise of rounding alone is larger.
        """
        rounding = 1.0 / 12.0
        analog = (self.edge_noise * self.contrast) ** 2 - rounding
        wanted = (fraction * self.contrast) ** 2 - rounding
        if wanted <= 0.0:
            raise CmmError(
                f"noise of {fraction:.2%} of the contrast is less than the noise of rounding, "
                f"{np.sqrt(rounding) / self.contrast:.2%}"
            )
        light = analog / wanted
        noise = self.noise
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
    """Return the scene that a sensor file's stickers and left camera determine."""
    rig = rig_from_file(file.rig)[0]
    # The fixed pattern is the same in all images, so it is not part of the noise.
    noise = replace(Sensor(file).noise, prnu=0.0, dsnu=0.0)
    return Scene(
        noise,
        file.stickers.sticker_level / 255.0,
        file.stickers.ring_level / 255.0,
        rig.left.focal_px,
    )


def working_point(file: SensorFile) -> Condition:
    """Return the condition under which a file's left camera sees the platform's stickers at home.

    Radius and tilt are the medians over the stickers that face the camera. The noise is the
    camera's own.
    """
    rig, camera_from_base = rig_from_file(file.rig)
    body = marked_body("platform", file.platform)
    camera_from_platform = camera_from_base @ pose_to_transform(file.platform.home)
    centres = apply(camera_from_platform, body.nominal)
    normals = body.sticker_normals @ camera_from_platform[:3, :3].T
    cosine = -np.einsum("ni,ni->n", centres, normals) / np.linalg.norm(centres, axis=1)
    facing = cosine > 0.0
    shapes = project_discs(rig.left, centres, normals, np.full(len(centres), file.stickers.radius))[
        1
    ]
    return Condition(
        float(np.median(np.linalg.eigvalsh(shapes[facing])[:, 1])),
        float(np.median(np.arccos(cosine[facing]))),
        scene_of(file).edge_noise,
        file.lens.psf_px,
    )


def random_ellipses(
    condition: Condition, focal_px: float, size: int, count: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return centres (count, 2) and shapes (count, 2, 2), px, of the ellipses of random discs.

    The discs are tilted towards random directions. In x and in y, the images of their centres lie
    within half a pixel of the middle of a window of ``size`` px.
    """
    middle = 0.5 * (size - 1)
    camera = PinholeCamera(focal_px, middle, middle, size, size)
    offsets = rng.uniform(-0.5, 0.5, (count, 2))
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    sine = np.sin(condition.tilt)
    cosine = np.cos(condition.tilt)
    normals = np.column_stack([sine * np.cos(angle), sine * np.sin(angle), np.full(count, -cosine)])
    # The discs lie at depth 1, because only ratios of lengths matter.
    disc_centres = np.column_stack([offsets / focal_px, np.ones(count)])
    return project_discs(
        camera, disc_centres, normals, np.full(count, condition.radius_px / focal_px)
    )


def draw_discs(
    scene: Scene, centres: Array, shapes: Array, size: int, psf_px: float
) -> NDArray[np.float32]:
    """Return the radiance (n, size, size) of bright discs on dark background."""
    fractions = [coverage(*part, size, psf_px)[0] for part in _parts(centres, shapes)]
    return (scene.dark + (scene.bright - scene.dark) * np.concatenate(fractions)).astype(np.float32)


def _parts(centres: Array, shapes: Array) -> list[tuple[Array, Array]]:
    """Split discs into parts of at most `TOGETHER` discs."""
    return [
        (centres[k : k + TOGETHER], shapes[k : k + TOGETHER])
        for k in range(0, len(centres), TOGETHER)
    ]


@dataclass(frozen=True)
class Score:
    """Score of one detector under one condition; errors are per axis.

    bound_px               Cramer-Rao bound over all windows
    rms_px                 rms error over the windows with a detected disc; inf if there are none
    ratio                  ``rms_px`` divided by the Cramer-Rao bound of these windows
    ratio_low, ratio_high  ends of the 95 % interval of ``ratio``
    bias_px                rms error without noise and rounding
    lost                   fraction of windows without a detected disc
    """

    detector: str
    condition: Condition
    bound_px: float
    rms_px: float
    ratio: float
    ratio_low: float
    ratio_high: float
    bias_px: float
    lost: float


def contestants(own: str = DEFAULT_DETECTOR) -> list[Detector]:
    """Return the built-in detectors, ``own`` if it is another one, and two methods of OpenCV."""
    return [*map(find_detector, dict.fromkeys([*DETECTORS, own])), *PEERS]


def compete(
    scene: Scene,
    conditions: Sequence[Condition],
    draws: int,
    rng: np.random.Generator,
    detectors: Sequence[Detector] | None = None,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> list[Score]:
    """Return the scores of all detectors under all conditions, with ``draws`` discs each.

    Without ``detectors``, all ``contestants`` compete. ``report(done, total)`` is called after each
    condition. Raises CmmError for fewer than two draws, and for noise below that of rounding.
    """
    if draws < 2:
        raise CmmError(f"a leaderboard needs at least 2 draws, got {draws}")
    scenes = [scene.with_noise(condition.noise) for condition in conditions]
    scores: list[Score] = []
    chosen = detectors or contestants()
    for k, (own_scene, condition) in enumerate(zip(scenes, conditions, strict=True)):
        scores += _scores(own_scene, condition, draws, rng, chosen)
        report(k + 1, len(conditions))
    return scores


def _scores(
    scene: Scene,
    condition: Condition,
    draws: int,
    rng: np.random.Generator,
    detectors: Sequence[Detector],
) -> list[Score]:
    """Return the scores of all detectors under one condition."""
    fit_size = 2 * int(np.ceil(condition.radius_px + FREE_PX + condition.psf_px))
    centres, shapes = random_ellipses(condition, scene.focal_px, fit_size + 2, draws, rng)
    radiance = draw_discs(scene, centres, shapes, fit_size + 2, condition.psf_px)
    noisy = scene.noise.expose(radiance, rng)
    clean = scene.noise.mean_grey(radiance)
    bounds = _bounds(scene, condition.psf_px, centres, shapes, fit_size + 2)
    scores = []
    for detector in detectors:
        # Windows with noise show the whole error, and the same windows without noise the bias.
        with_noise, without_noise = (
            detector.detect(
                SpotWindows(
                    windows,
                    np.zeros((draws, 2), dtype=int),
                    scene.noise,
                    fit_size,
                    LIMITS,
                    condition.psf_px,
                )
            )
            for windows in (noisy, clean)
        )
        good = with_noise.good
        squared = 0.5 * ((with_noise.centres - centres)[good] ** 2).sum(axis=1)
        systematic = (without_noise.centres - centres)[without_noise.good] ** 2
        scores.append(
            Score(
                detector.name,
                condition,
                _root_mean(bounds),
                _root_mean(squared),
                *_ratio_interval(squared, bounds[good], rng),
                _root_mean(systematic),
                1.0 - float(good.mean()),
            )
        )
    return scores


def _bounds(scene: Scene, psf_px: float, centres: Array, shapes: Array, size: int) -> Array:
    """Return the Cramer-Rao bound (n,) of each centre's mean squared error per axis, px²."""
    parts = [
        cramer_rao_bound(*part, size, scene.contrast, scene.ground, scene.noise, psf_px)
        for part in _parts(centres, shapes)
    ]
    return 0.5 * np.trace(np.concatenate(parts), axis1=1, axis2=2)


def _ratio_interval(
    squared: Array, bounds: Array, rng: np.random.Generator
) -> tuple[float, float, float]:
    """Return the rms error divided by the rms bound, and the ratio's 95 % bootstrap interval."""
    if len(squared) == 0:
        return np.inf, np.inf, np.inf
    drawn = rng.integers(len(squared), size=(RESAMPLES, len(squared)))
    resampled = np.sqrt(squared[drawn].mean(axis=1) / bounds[drawn].mean(axis=1))
    low, high = np.quantile(resampled, [0.5 - 0.5 * CONFIDENCE, 0.5 + 0.5 * CONFIDENCE])
    return _root_mean(squared) / _root_mean(bounds), float(low), float(high)


def _root_mean(squared: Array) -> float:
    """Return the square root of the mean; inf without values."""
    return float(np.sqrt(squared.mean())) if squared.size else np.inf


def _by_window(
    find: Callable[[NDArray[np.uint8]], tuple[float, float] | None], spots: SpotWindows
) -> DetectedCentres:
    """Return the centres that ``find`` returns for the windows, which it gets as 8-bit images.

    A window is not good if ``find`` returns None. OpenCV states no covariance, so the covariances
    are zero.
    """
    grey = np.rint(spots.windows * (255.0 / spots.noise.white_level)).astype(np.uint8)
    results = [find(window) for window in grey]
    good = np.array([centre is not None for centre in results], dtype=bool)
    centres = np.array([centre or (0.0, 0.0) for centre in results]).reshape(-1, 2)
    return DetectedCentres(centres + spots.corners, np.zeros((len(results), 2, 2)), good)


def detect_by_blobs(spots: SpotWindows) -> DetectedCentres:
    """Return the centre of the largest bright blob of each window by ``cv2.SimpleBlobDetector``.

    The shape filters of this detector are off.
    """
    settings = cv2.SimpleBlobDetector.Params()
    settings.filterByCircularity = settings.filterByConvexity = settings.filterByInertia = False
    settings.blobColor = 255
    settings.minArea = 4.0
    settings.maxArea = float(spots.fit_size**2)
    blobs = cv2.SimpleBlobDetector.create(settings)

    def find(window: NDArray[np.uint8]) -> tuple[float, float] | None:
        points = blobs.detect(window)
        return max(points, key=lambda point: point.size).pt if points else None

    return _by_window(find, spots)


def detect_by_contour(spots: SpotWindows) -> DetectedCentres:
    """Return the centres of ``cv2.fitEllipse`` for the longest contours at Otsu's threshold."""

    def find(window: NDArray[np.uint8]) -> tuple[float, float] | None:
        mask = cv2.threshold(window, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)[1]
        contours = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
        longest = max(contours, key=len, default=())
        return cv2.fitEllipse(longest)[0] if len(longest) >= 5 else None

    return _by_window(find, spots)


# Methods of OpenCV with their biases, px.
PEERS = (
    Detector("opencv_blob", detect_by_blobs, 0.01),
    Detector("opencv_fit_ellipse", detect_by_contour, 0.05),
)
