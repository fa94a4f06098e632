"""Measurement of poses without images, frame by frame or many frames at once.

The results have the same distribution as those from ``DrawnStickers``, but the covariance of a
centre comes from a table, except in fast motion. There is no search: the window of each sticker is
centred at its ellipse.

The table describes the noise of a sticker's centre as a function of its ellipse. The covariance
from ``fit_covariances`` belongs to one position of the centre. It is averaged over positions within
a pixel and inverted. The inverse grows with the length of the rim. The table contains the inverse
divided by the mean half axis m, because this quotient depends only weakly on m. It depends smoothly
on the ovalness p = (A_xx - A_yy) / 2 m and q = A_xy / m of the ellipse's shape A.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from cmmsim.detection.ellipse_fit import SMALLEST_RADIUS_PX, fit_settings
from cmmsim.errors import CmmError
from cmmsim.geometry.camera_kernels import Cameras
from cmmsim.geometry.pose import Array, invert
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.measuring.frame_solver import CHANCE, lost_reason, solver_limits
from cmmsim.measuring.measurement import MeasuredPoses, Measurement, lost_measurement
from cmmsim.measuring.observation import GRAZING
from cmmsim.measuring.pose_estimator import PoseEstimator
from cmmsim.measuring.solver_kernels import COLUMNS, FIRST, LEFT, MEASURED, STATE, ObservedStickers
from cmmsim.radiometry.noise import CameraNoise
from cmmsim.radiometry.stereo_images import StereoImages
from cmmsim.without_images.drawn_fit_kernels import CentreNoise, fit_covariances
from cmmsim.without_images.drawn_frame_kernels import (
    Frame,
    Limits,
    StereoScene,
    Stickers,
    measure_frame,
    measure_frames,
)
from cmmsim.without_images.drawn_stickers import (
    THIN_PX,
    THIN_STD_PX,
    DrawnStickers,
    StatisticalStereoCamera,
)
from cmmsim.without_images.sticker_scene import CLEAR
from cmmsim.without_images.verified import require_short

# Tabulated values of p and of q.
OVAL = np.linspace(-0.78, 0.78, 14)
# Number of tabulated mean half axes. The largest is half the side of the fitted part.
RADII = 8
# Largest ovalness hypot(p, q) of an ellipse. Entries of the table with larger p and q are computed
# for this ovalness.
MOST_OVAL = 0.85
# Number of positions within a pixel along each axis, without and with a point spread.
SHARP_PHASES = 5
BLURRED_PHASES = 2
# Smallest distance between a tabulated ellipse that is centred and the edge of the fitted part, px.
EDGE_PX = 0.2
# Fractions of full light at which the growth of the covariance is computed.
LIGHTS = np.array([0.4, 0.7, 1.0])
# Probability that a good sticker is rejected because of its outline in either image.
OUTLINE_CHANCE = 2 * CHANCE
# A fit of the pose, which starts at the true pose, ends with a rotation smaller than this, rad.
STEP_TOLERANCE = 1e-4
# Number of frames that are measured by one thread with one random stream.
BLOCK = 512


@lru_cache(maxsize=16)
def centre_noise(
    noise: CameraNoise, psf_px: float, fit_size: int, sticker: float, ring: float
) -> CentreNoise:
    """Return the table of the centre's inverse covariance for fitted parts of ``fit_size`` px.

    ``sticker`` and ``ring`` are the radiances of stickers and rings, 0 to 1.
    """
    dark, bright, black = (
        float(noise.mean_grey(np.array(level))) for level in (ring, sticker, 0.0)
    )
    settings = fit_settings(noise, psf_px)
    phases = SHARP_PHASES if psf_px == 0.0 else BLURRED_PHASES
    within = (np.arange(phases) + 0.5) / phases - 0.5

    def covariances(shapes: Array, light: float) -> Array:
        """Return mean covariances (n, 2, 2) of centres of ellipses with shapes (n, 2, 2)."""
        of_fits = np.empty((len(shapes), 5, 5))
        total = np.zeros((len(shapes), 2, 2))
        for phase in np.stack(np.meshgrid(within, within), axis=-1).reshape(-1, 2):
            centres = np.tile(0.5 * (fit_size - 1) + phase, (len(shapes), 1))
            contrasts = np.full(len(shapes), light * (bright - dark))
            grounds = np.full(len(shapes), black + light * (dark - black))
            still = np.zeros((len(shapes), 2))
            fit_covariances(centres, shapes, still, contrasts, grounds, fit_size, settings, of_fits)
            total += of_fits[:, :2, :2]
        return total / phases**2

    radii = np.linspace(SMALLEST_RADIUS_PX, 0.5 * fit_size, RADII)
    m, p, q = np.meshgrid(radii, OVAL, OVAL, indexing="ij")
    tabulated = _shapes(m.ravel(), p.ravel(), q.ravel(), 0.5 * fit_size - EDGE_PX)
    inverses = np.linalg.inv(covariances(tabulated, 1.0))[:, [0, 0, 1], [0, 1, 1]]
    table = (inverses / m.reshape(-1, 1)).reshape(*m.shape, 3)
    # The growth of the covariance with less light hardly depends on the shape, so it is computed
    # for one typical ellipse.
    usual = _shapes(np.array([0.3 * fit_size]), np.array([0.25]), np.array([0.0]), 0.5 * fit_size)
    growth = [float(np.trace(covariances(usual, light)[0])) for light in LIGHTS]
    by_light = (
        np.polynomial.Polynomial.fit(LIGHTS, LIGHTS**2 * np.array(growth) / growth[-1], 2)
        .convert()
        .coef
    )
    first = np.array([radii[0], OVAL[0], OVAL[0]])
    steps = np.array([np.diff(radii)[0], *2 * [np.diff(OVAL)[0]]])
    return CentreNoise(
        table, first, steps, by_light, bright - dark, dark - black, black, fit_size, settings
    )


def _shapes(m: Array, p: Array, q: Array, largest: float) -> Array:
    """Return the shapes (n, 2, 2) for mean half axes m (n,) px and ovalness p, q (n,).

    Their half axes are limited to the range from SMALLEST_RADIUS_PX to ``largest``.
    """
    oval = np.minimum(np.hypot(p, q), MOST_OVAL)
    angle = 0.5 * np.arctan2(q, p)
    long, short = (
        np.clip(m * (1.0 + sign * oval), SMALLEST_RADIUS_PX, largest) for sign in (1.0, -1.0)
    )
    mean = 0.5 * (long + short)
    half = 0.5 * (long - short)
    xx = mean + half * np.cos(2 * angle)
    xy = half * np.sin(2 * angle)
    yy = mean - half * np.cos(2 * angle)
    return np.stack([xx, xy, xy, yy], axis=-1).reshape(-1, 2, 2)


class StatisticalTracker:
    """Tracker with the methods of `Tracker` that measures poses without images.

    It makes no predictions, so a lost frame does not affect the next one. Raises CmmError if the
    estimator's method is not registration.
    """

    def __init__(self, estimator: PoseEstimator) -> None:
        if estimator.method != "registration":
            raise CmmError(
                f"poses are measured without images by registration only, not by {estimator.method}"
            )
        self._estimator = estimator
        self._camera: StatisticalStereoCamera | None = None
        # The stickers of a single frame, which the next frame overwrites.
        self._single_frame = self._frame()

    def forget(self) -> None:
        """Do nothing, because this tracker has no memory."""

    def miss(self) -> None:
        """Do nothing for a missed frame, because this tracker has no memory."""

    def measure(self, exposure: StereoImages) -> Measurement:
        """Measure the pose in one frame from ``sensor.look``.

        Raises CmmError for images, and for motion blur beyond the verified length.
        """
        if not isinstance(exposure, DrawnStickers):
            raise CmmError(
                "a sensor without images measures only results of its own look(); use "
                "measure_frame for images"
            )
        frame = self._single_frame
        pose = np.empty(6)
        covariance = np.empty((6, 6))
        noise, kept = self._draws(exposure.rng, 1)
        scene = self._scene_of(exposure.camera)
        drawn = exposure.exposed, exposure.bodies, noise[0], kept[0]
        verdict = np.empty(COLUMNS)
        measure_frame(scene, *drawn, frame, pose, covariance, verdict)
        require_short(frame.longest[0])
        estimator = self._estimator
        used = frame.stickers.used
        ids = estimator.platform.sticker_ids
        if verdict[STATE] != MEASURED:
            places = estimator.taught.platform_places[used]
            first = str(ids[int(verdict[FIRST])])
            return lost_measurement(lost_reason(verdict, first, places))
        return Measurement(
            pose,
            covariance,
            frame.stickers.points[used],
            frame.stickers.covariances[used],
            frame.pixels[used, 0],
            frame.pixels[used, 1],
            ids[used],
            True,
            "",
            estimator.common_at,
            frame.variances[used],
        )

    def measure_many(
        self,
        camera: StatisticalStereoCamera,
        exposed: Array,
        bodies: Array,
        rng: np.random.Generator,
    ) -> MeasuredPoses:
        """Measure the poses in N frames with platform poses ``exposed`` (N, 6, 6).

        ``exposed`` comes from ``StatisticalStereoCamera.exposed``. ``bodies`` (b, 4, 4) are
        base_from_body of the base and the obstacles, which stand still. A lost frame has a pose and
        a covariance of NaN, and 0 stickers. Raises CmmError for motion blur beyond the verified
        length.
        """
        count = len(exposed)
        scene = self._scene_of(camera)
        measured = np.empty((count, 6))
        covariances = np.empty((count, 6, 6))
        stickers = np.empty(count, dtype=int)
        starts = range(0, count, BLOCK)

        def block(start: int, own: np.random.Generator) -> None:
            part = slice(start, start + BLOCK)
            poses = exposed[part]
            noise, kept = self._draws(own, len(poses))
            verdicts = np.empty((len(poses), COLUMNS))
            filled = measured[part], covariances[part], verdicts
            require_short(measure_frames(scene, poses, bodies, noise, kept, self._frame(), *filled))
            stickers[part] = np.where(verdicts[:, STATE] == MEASURED, verdicts[:, LEFT], 0)

        # Kernels release the interpreter's lock. Each block has its own random stream, so the
        # results do not depend on the number of threads.
        with ThreadPoolExecutor(min(len(starts) or 1, os.cpu_count() or 1)) as pool:
            list(pool.map(block, starts, rng.spawn(len(starts))))
        return MeasuredPoses(measured, covariances, stickers)

    def _scene_of(self, camera: StatisticalStereoCamera) -> StereoScene:
        """Return the cameras and their scene in the form that the kernels take.

        If only the cameras have changed since the previous call, the rest is reused.
        """
        if camera is not self._camera:
            if self._camera is None or camera.scene is not self._camera.scene:
                self._scene = _scene(camera, self._estimator)
            else:
                self._scene = self._scene._replace(
                    true_cameras=_cameras(camera.rig, camera.from_base)
                )
            self._camera = camera
        return self._scene

    def _frame(self) -> Frame:
        """Return an empty frame with all stickers of the platform."""
        # a copy, because the kernels would be compiled once more for a read-only array
        planes = self._estimator.platform.plane_index.copy()
        n = len(planes)
        rows = [np.empty(shape) for shape in ((n, 3), (n, 3, 3), (n, 3, 3), (n, 3), (n, 3), (n,))]
        stickers = ObservedStickers._make([np.empty(n, dtype=bool), *rows, planes])
        pixels = np.empty((n, 2, 2))
        return Frame(stickers, pixels, np.empty((n, 2, 2, 2)), np.empty(n), np.empty(1))

    def _draws(self, rng: np.random.Generator, frames: int) -> tuple[Array, NDArray[np.bool_]]:
        """Draw standard normal noise (N, 2, n, 3), and the mask (N, n) of stickers that are kept.

        Both are those of ``observe``. Stickers are omitted at random, because the test of outlines
        rejects a few good ones.
        """
        n = len(self._estimator.platform.sticker_ids)
        return rng.standard_normal((frames, 2, n, 3)), rng.random((frames, n)) >= OUTLINE_CHANCE


def _scene(camera: StatisticalStereoCamera, estimator: PoseEstimator) -> StereoScene:
    """Return the cameras and their scene in the form that the kernels take."""
    settings = estimator.settings
    taught = estimator.taught
    on_platform = camera.scene.owners == 0
    count = int(on_platform.sum())
    light = camera.light
    limits = Limits(
        GRAZING,
        THIN_PX,
        THIN_STD_PX,
        settings.largest_ray_gap,
        CLEAR * camera.scene.radius,
        light.optics.vignetting,
        settings.line_error_px**2,
    )
    places = camera.scene.places[on_platform]
    normals = camera.scene.normals[on_platform]
    # a copy, because the kernels would be compiled once more for a read-only array
    taught_places = np.array(taught.platform_places, order="C")
    return StereoScene(
        _cameras(camera.rig, camera.from_base),
        estimator.rig.kernel_cameras,
        Stickers(places, taught_places, normals, camera.scene.radius),
        np.zeros(count, dtype=int),
        camera.scene.occluders,
        centre_noise(
            estimator.noise, light.optics.psf_px, settings.fit_size, light.sticker, light.ring
        ),
        limits,
        solver_limits(count, settings, STEP_TOLERANCE),
        np.array(taught.base_from_camera, order="C"),
        invert(taught.base_from_camera),
    )


def _cameras(rig: StereoRig, extrinsics: Sequence[Array]) -> Cameras:
    return rig.kernel_cameras._replace(extrinsics=np.stack(extrinsics))
