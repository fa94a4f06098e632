"""Poses measured without images, one by one or many together.

What is found of the stickers is that of ``DrawnStickers``, but for a covariance from a table, and nothing is searched:
each sticker is looked for where it is. Where it is not plain what the estimator makes of it, since few stickers are
left or much contradicts, the estimator itself is asked with the same stickers.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from cmmsim.detection.ellipse_fit import SMALLEST_RADIUS_PX
from cmmsim.errors import CmmError, LostError
from cmmsim.geometry.pose import Array, invert
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.pose_estimation.consistency import CHANCE, EXCESS_CHANCE, FEWEST, LARGEST_EXCESS, LARGEST_MISFIT
from cmmsim.pose_estimation.estimator import Measurement, PoseEstimator, lost_measurement
from cmmsim.pose_estimation.observation import GRAZING, LONGEST_SMEAR_PX, StickerObservation
from cmmsim.statistical.centre_noise import centre_noise
from cmmsim.statistical.exposure import StatisticalStereoCamera
from cmmsim.statistical.pose_kernels import CAREFUL, Cameras, Eyes, Frame, Limits, Stickers, measure_frame, measure_frames
from cmmsim.statistical.scene import CLEAR

PLAIN = FEWEST + 2  # stickers from which on residuals alone tell a wrong one well
OUTLINE_CHANCE = 2 * CHANCE  # of a good sticker to be left out for its outline in one of both images
BLOCK = 512  # frames that share a stream of noise and a thread's turn


@dataclass(frozen=True)
class MeasuredPoses:
    """N frames: poses (N,6) m, rad and covariances (N,6,6), NaN where lost; stickers (N,) used, 0 where lost."""

    poses: Array
    covariances: Array
    stickers: NDArray[np.int_]


@dataclass(frozen=True)
class StatisticalMeasuring:
    """What a camera without images sees, and the estimator that measures."""

    camera: StatisticalStereoCamera
    estimator: PoseEstimator

    def __post_init__(self) -> None:
        if self.estimator.method != "registration":
            raise CmmError(f"many poses are measured by registration only, not by {self.estimator.method}")

    def measure(self, pose: Array, rate: Array, bodies: Array, rng: np.random.Generator) -> Measurement:
        """One frame of the platform at a pose (6,) in motion at a rate (6,), among ``bodies`` (b,4,4), base_from_body of
        the base and of the obstacles."""
        frame, found, spread = self._frame(), np.empty(6), np.empty((6, 6))
        noise, kept = self._draws(rng, 1)
        state = measure_frame(self._eyes, self._exposed(pose[None], rate[None])[0], bodies, noise[0], kept[0], frame,
                              found, spread)  # fmt: skip
        if state == CAREFUL:
            return self._carefully(frame)
        used = frame.used
        return Measurement(
            found, spread, frame.points[used], frame.covariances[used], frame.pixels[0, used], frame.pixels[1, used],
            self.estimator.platform.sticker_ids[used], True,
        )  # fmt: skip

    def measure_many(self, poses: Array, rates: Array, bodies: Array, rng: np.random.Generator) -> MeasuredPoses:
        """Frames (N,) of the platform at poses (N,6) in motion at rates (N,6), each with noise of its own."""
        exposed, count = self._exposed(poses, rates), len(poses)
        found, spreads = np.empty((count, 6)), np.empty((count, 6, 6))
        stickers, states = np.empty(count, dtype=int), np.empty(count, dtype=int)
        starts = range(0, count, BLOCK)

        def block(start: int, own: np.random.Generator) -> None:
            part = slice(start, start + BLOCK)
            noise, kept = self._draws(own, len(exposed[part]))
            frame = self._frame()
            measure_frames(self._eyes, exposed[part], bodies, noise, kept, frame, found[part], spreads[part],
                           stickers[part], states[part])  # fmt: skip
            for k in np.flatnonzero(states[part] == CAREFUL):
                measure_frame(self._eyes, exposed[start + k], bodies, noise[k], kept[k], frame, found[start + k],
                              spreads[start + k])  # fmt: skip
                careful = self._carefully(frame)
                found[start + k], spreads[start + k] = careful.pose, careful.covariance
                stickers[start + k] = len(careful.target_ids)

        with ThreadPoolExecutor(min(len(starts) or 1, os.cpu_count() or 1)) as pool:
            list(pool.map(block, starts, rng.spawn(len(starts))))
        return MeasuredPoses(found, spreads, stickers)

    @cached_property
    def _eyes(self) -> Eyes:
        camera, estimator = self.camera, self.estimator
        settings, taught = estimator.settings, estimator.taught
        own = camera.scene.owners == 0
        count, light = int(own.sum()), camera.light
        freedoms = np.arange(3 * count + 1)
        limits = Limits(
            GRAZING,
            1.01 * SMALLEST_RADIUS_PX,
            LONGEST_SMEAR_PX,
            settings.largest_ray_gap,
            LARGEST_MISFIT,
            LARGEST_EXCESS,
            PLAIN,
            np.asarray(chi2.isf(EXCESS_CHANCE, np.maximum(freedoms, 1))),
            CLEAR * camera.scene.radius,
            light.optics.vignetting,
            settings.line_error_px**2,
        )
        stickers = Stickers(
            *(np.ascontiguousarray(v) for v in (camera.scene.places[own], taught.platform_places, camera.scene.normals[own])),
            camera.scene.radius,
        )
        return Eyes(
            _cameras(camera.rig, [move @ camera.camera_from_base for move in camera.rig.from_camera]),
            _cameras(estimator.rig, estimator.rig.from_camera),
            stickers,
            np.zeros(count, dtype=int),
            camera.scene.hiding,
            centre_noise(estimator.noise, light.optics.psf_px, settings.fit_size, light.sticker, light.ring),
            limits,
            np.ascontiguousarray(taught.base_from_camera),
            invert(taught.base_from_camera),
        )

    def _frame(self) -> Frame:
        n = len(self.estimator.platform.sticker_ids)
        shapes = ((2, n, 2), (2, n, 2, 2), (n, 3), (n, 3, 3), (n, 3, 3), (n, 3), (n, 3))
        return Frame(*np.empty((2, n), dtype=bool), *(np.empty(shape) for shape in shapes))

    def _draws(self, rng: np.random.Generator, frames: int) -> tuple[Array, NDArray[np.bool_]]:
        """Unit normal noise (N,2,n,2) of centres, and which stickers (N,n) are not left out for their outlines."""
        n = len(self.estimator.platform.sticker_ids)
        return rng.standard_normal((frames, 2, n, 2)), rng.random((frames, n)) >= OUTLINE_CHANCE

    def _exposed(self, poses: Array, rates: Array) -> Array:
        """Poses (N,6,6) as ``pose_kernels.look`` takes them."""
        half, lag = 0.5 * self.camera.exposure * rates, self.camera.right_later * rates
        return np.stack([poses + share + later for later in (0.0, lag) for share in (0.0, -half, half)], axis=1)

    def _carefully(self, frame: Frame) -> Measurement:
        """What the estimator makes of all of a frame's stickers."""
        index = np.flatnonzero(frame.seen)
        seen = StickerObservation(
            index, frame.pixels[0, index], frame.pixels[1, index], frame.points[index], frame.covariances[index]
        )
        try:
            return self.estimator.measured(seen)[0]
        except LostError as error:
            return lost_measurement(str(error))


def _cameras(rig: StereoRig, moves: Sequence[Array]) -> Cameras:
    return Cameras(
        np.array([camera.intrinsics for camera in rig.cameras]),
        np.array([(camera.width, camera.height) for camera in rig.cameras], dtype=float),
        np.stack(moves),
    )
