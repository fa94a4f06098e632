"""Poses measured without images, one by one or many together.

What is found of the stickers is that of ``DrawnStickers``, but for a covariance from a table, and nothing is searched:
each sticker is looked for where it is. Where it is not plain what the estimator makes of it, since few stickers are
left or much contradicts, the estimator itself is asked with the same stickers.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from cmmsim.errors import CmmError, LostError
from cmmsim.geometry.pose import Array, invert
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.pose_estimation.consistency import CHANCE, EXCESS_CHANCE, FEWEST, LARGEST_EXCESS, LARGEST_MISFIT
from cmmsim.pose_estimation.estimator import Measurement, PoseEstimator, lost_measurement
from cmmsim.pose_estimation.many import MeasuredPoses
from cmmsim.pose_estimation.observation import GRAZING, StickerObservation
from cmmsim.radiometry.images import StereoImages
from cmmsim.statistical.centre_noise import centre_noise
from cmmsim.statistical.conditions import require_short
from cmmsim.statistical.exposure import THIN_PX, THIN_STD_PX, DrawnStickers, StatisticalStereoCamera
from cmmsim.statistical.pose_kernels import (
    CAREFUL,
    Cameras,
    Eyes,
    Limits,
    Stickers,
    measure_frame,
    measure_frames,
)
from cmmsim.statistical.scene import CLEAR
from cmmsim.statistical.solving_kernels import Belief, Frame

PLAIN = FEWEST + 2  # stickers from which on residuals alone tell a wrong one well
OUTLINE_CHANCE = 2 * CHANCE  # of a good sticker to be left out for its outline in one of both images
BLOCK = 512  # frames that share a stream of noise and a thread's turn


class StatisticalTracker:
    """Measures frame after frame as a `Tracker` does. Nothing is predicted: what is lost is found again at once."""

    def __init__(self, estimator: PoseEstimator) -> None:
        if estimator.method != "registration":
            raise CmmError(f"poses are measured without images by registration only, not by {estimator.method}")
        self._estimator = estimator
        self._camera: StatisticalStereoCamera | None = None
        self._one = self._frame()  # what is found in a frame, overwritten by the next

    def forget(self) -> None:
        """There is nothing to be forgotten."""

    def miss(self) -> None:
        """A frame passed that nobody saw."""

    def measure(self, exposure: StereoImages) -> Measurement:
        """Measure one frame, such as ``sensor.look`` returns; raises CmmError for images."""
        if not isinstance(exposure, DrawnStickers):
            raise CmmError("a sensor without images measures what its own look() returns; images go to measure_frame")
        frame, found, spread = self._one, np.empty(6), np.empty((6, 6))
        noise, kept = self._draws(exposure.rng, 1)
        eyes = self._eyes_of(exposure.camera)
        state = measure_frame(eyes, exposure.exposed, exposure.bodies, noise[0], kept[0], frame, found, spread)
        require_short(frame.longest[0])
        if state == CAREFUL:
            return self._carefully(frame)
        used, estimator = frame.used, self._estimator
        return Measurement(
            found, spread, frame.points[used], frame.covariances[used], frame.pixels[0, used], frame.pixels[1, used],
            estimator.platform.sticker_ids[used], True, "", estimator.common_at, frame.variances[used],
        )  # fmt: skip

    def measure_many(
        self, camera: StatisticalStereoCamera, exposed: Array, bodies: Array, rng: np.random.Generator
    ) -> MeasuredPoses:
        """Frames (N,6,6), as of ``StatisticalStereoCamera.exposed``, among bodies (b,4,4) that stand still."""
        count, eyes = len(exposed), self._eyes_of(camera)
        found, spreads = np.empty((count, 6)), np.empty((count, 6, 6))
        stickers, states = np.empty(count, dtype=int), np.empty(count, dtype=int)
        starts = range(0, count, BLOCK)

        def block(start: int, own: np.random.Generator) -> None:
            part, frame = slice(start, start + BLOCK), self._frame()
            noise, kept = self._draws(own, len(exposed[part]))
            filled = (values[part] for values in (found, spreads, stickers, states))
            require_short(measure_frames(eyes, exposed[part], bodies, noise, kept, frame, *filled))
            for k in np.flatnonzero(states[part] == CAREFUL):
                at = start + k
                measure_frame(eyes, exposed[at], bodies, noise[k], kept[k], frame, found[at], spreads[at])
                careful = self._carefully(frame)
                found[at], spreads[at], stickers[at] = careful.pose, careful.covariance, len(careful.target_ids)

        with ThreadPoolExecutor(min(len(starts) or 1, os.cpu_count() or 1)) as pool:
            list(pool.map(block, starts, rng.spawn(len(starts))))
        return MeasuredPoses(found, spreads, stickers)

    def _eyes_of(self, camera: StatisticalStereoCamera) -> Eyes:
        """What looks and measures; where a camera has only moved since the last frame, the rest stays."""
        if camera is not self._camera:
            if self._camera is None or camera.scene is not self._camera.scene:
                self._eyes = _eyes(camera, self._estimator)
            else:
                self._eyes = self._eyes._replace(looking=_cameras(camera.rig, camera.from_base))
            self._camera = camera
        return self._eyes

    def _frame(self) -> Frame:
        n = len(self._estimator.platform.sticker_ids)
        shapes = ((2, n, 2), (2, n, 2, 2), (n,), (n, 3), (n, 3, 3), (n, 3, 3), (n, 3), (n, 3), (1,))
        return Frame(*np.empty((2, n), dtype=bool), *(np.empty(shape) for shape in shapes))

    def _draws(self, rng: np.random.Generator, frames: int) -> tuple[Array, NDArray[np.bool_]]:
        """Unit normal noise (N,2,n,3) of centres and of how thin ellipses may be, and which stickers (N,n) are not
        left out for their outlines."""
        n = len(self._estimator.platform.sticker_ids)
        return rng.standard_normal((frames, 2, n, 3)), rng.random((frames, n)) >= OUTLINE_CHANCE

    def _carefully(self, frame: Frame) -> Measurement:
        """What the estimator makes of all of a frame's stickers."""
        index = np.flatnonzero(frame.seen)
        left, right = frame.pixels[:, index]
        found = frame.points[index], frame.covariances[index], frame.variances[index]
        seen = StickerObservation(index, left, right, *found)
        try:
            return self._estimator.measured(seen)[0]
        except LostError as error:
            return lost_measurement(str(error))


def _eyes(camera: StatisticalStereoCamera, estimator: PoseEstimator) -> Eyes:
    """What looks and what measures, as the kernels take it."""
    settings, taught = estimator.settings, estimator.taught
    own = camera.scene.owners == 0
    count, light = int(own.sum()), camera.light
    limits = Limits(
        GRAZING,
        THIN_PX,
        THIN_STD_PX,
        settings.largest_ray_gap,
        CLEAR * camera.scene.radius,
        light.optics.vignetting,
        settings.line_error_px**2,
    )
    totals = np.asarray(chi2.isf(EXCESS_CHANCE, np.maximum(np.arange(3 * count + 1), 1)))
    places, normals = camera.scene.places[own], camera.scene.normals[own]
    taught_places = np.ascontiguousarray(taught.platform_places)
    return Eyes(
        _cameras(camera.rig, camera.from_base),
        _cameras(estimator.rig, estimator.rig.from_camera),
        Stickers(places, taught_places, normals, camera.scene.radius),
        np.zeros(count, dtype=int),
        camera.scene.hiding,
        centre_noise(estimator.noise, light.optics.psf_px, settings.fit_size, light.sticker, light.ring),
        limits,
        Belief(LARGEST_MISFIT, LARGEST_EXCESS, PLAIN, totals),
        np.ascontiguousarray(taught.base_from_camera),
        invert(taught.base_from_camera),
    )


def _cameras(rig: StereoRig, moves: Sequence[Array]) -> Cameras:
    return Cameras(
        np.array([camera.intrinsics for camera in rig.cameras]),
        np.array([(camera.width, camera.height) for camera in rig.cameras], dtype=float),
        np.stack(moves),
    )
