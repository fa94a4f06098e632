"""Poses measured without images, one by one or many together.

The stickers found are those of ``DrawnStickers``, but for a covariance from a table, and nothing is
searched: each sticker is looked for where it is.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from cmmsim.errors import CmmError
from cmmsim.geometry.camera_kernels import Cameras
from cmmsim.geometry.pose import Array, invert
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.measuring.frame_solver import (
    CHANCE,
    belief_for,
    lost_reason,
)
from cmmsim.measuring.measured_poses import MeasuredPoses
from cmmsim.measuring.measurement import Measurement, lost_measurement
from cmmsim.measuring.observation import GRAZING
from cmmsim.measuring.pose_estimator import PoseEstimator
from cmmsim.measuring.solver_kernels import COLUMNS, FIRST, LEFT, MEASURED, STATE, Seen
from cmmsim.radiometry.stereo_images import StereoImages
from cmmsim.without_images.centre_noise import centre_noise
from cmmsim.without_images.conditions import require_short
from cmmsim.without_images.drawn_frame_kernels import (
    Eyes,
    Frame,
    Limits,
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

OUTLINE_CHANCE = 2 * CHANCE  # of a good sticker to be left out for an outline in either image
SETTLED = 1e-4  # rad: turn of the last step of a fit, which begins at the true pose
BLOCK = 512  # frames that share a stream of noise and a thread's turn


class StatisticalTracker:
    """Measures frame after frame as a `Tracker` does. Nothing is predicted: what is lost is found
    again at once.
    """

    def __init__(self, estimator: PoseEstimator) -> None:
        if estimator.method != "registration":
            raise CmmError(
                f"poses are measured without images by registration only, not by {estimator.method}"
            )
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
            raise CmmError(
                "a sensor without images measures what its own look() returns; images go to "
                "measure_frame"
            )
        frame = self._one
        found = np.empty(6)
        spread = np.empty((6, 6))
        noise, kept = self._draws(exposure.rng, 1)
        eyes = self._eyes_of(exposure.camera)
        drawn = exposure.exposed, exposure.bodies, noise[0], kept[0]
        verdict = np.empty(COLUMNS)
        measure_frame(eyes, *drawn, frame, found, spread, verdict)
        require_short(frame.longest[0])
        estimator = self._estimator
        used = frame.stickers.used
        ids = estimator.platform.sticker_ids
        if verdict[STATE] != MEASURED:
            places = estimator.taught.platform_places[used]
            first = str(ids[int(verdict[FIRST])])
            return lost_measurement(lost_reason(verdict, first, places))
        return Measurement(
            found,
            spread,
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
        """Frames (N,6,6), as of ``StatisticalStereoCamera.exposed``, among bodies (b,4,4) that
        stand still.
        """
        count = len(exposed)
        eyes = self._eyes_of(camera)
        found = np.empty((count, 6))
        spreads = np.empty((count, 6, 6))
        stickers = np.empty(count, dtype=int)
        starts = range(0, count, BLOCK)

        def block(start: int, own: np.random.Generator) -> None:
            part = slice(start, start + BLOCK)
            poses = exposed[part]
            noise, kept = self._draws(own, len(poses))
            verdicts = np.empty((len(poses), COLUMNS))
            filled = found[part], spreads[part], verdicts
            require_short(measure_frames(eyes, poses, bodies, noise, kept, self._frame(), *filled))
            stickers[part] = np.where(verdicts[:, STATE] == MEASURED, verdicts[:, LEFT], 0)

        with ThreadPoolExecutor(min(len(starts) or 1, os.cpu_count() or 1)) as pool:
            list(pool.map(block, starts, rng.spawn(len(starts))))
        return MeasuredPoses(found, spreads, stickers)

    def _eyes_of(self, camera: StatisticalStereoCamera) -> Eyes:
        """Cameras and all that they look at.

        Where a camera has only moved since the last frame, the rest stays.
        """
        if camera is not self._camera:
            if self._camera is None or camera.scene is not self._camera.scene:
                self._eyes = _eyes(camera, self._estimator)
            else:
                self._eyes = self._eyes._replace(looking=_cameras(camera.rig, camera.from_base))
            self._camera = camera
        return self._eyes

    def _frame(self) -> Frame:
        n = len(self._estimator.platform.sticker_ids)
        rows = (n, 3), (n, 3, 3), (n, 3, 3), (n, 3), (n, 3)
        stickers = Seen(np.empty(n, dtype=bool), *(np.empty(shape) for shape in rows))
        pixels = np.empty((n, 2, 2))
        return Frame(stickers, pixels, np.empty((n, 2, 2, 2)), np.empty(n), np.empty(1))

    def _draws(self, rng: np.random.Generator, frames: int) -> tuple[Array, NDArray[np.bool_]]:
        """Unit normal noise (N,2,n,3) of centres and of how thin ellipses may be, and which
        stickers (N,n) are not left out for their outlines."""
        n = len(self._estimator.platform.sticker_ids)
        return rng.standard_normal((frames, 2, n, 3)), rng.random((frames, n)) >= OUTLINE_CHANCE


def _eyes(camera: StatisticalStereoCamera, estimator: PoseEstimator) -> Eyes:
    """Cameras and all that they look at, as the kernels take them."""
    settings = estimator.settings
    taught = estimator.taught
    own = camera.scene.owners == 0
    count = int(own.sum())
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
    places = camera.scene.places[own]
    normals = camera.scene.normals[own]
    taught_places = np.ascontiguousarray(taught.platform_places)
    return Eyes(
        _cameras(camera.rig, camera.from_base),
        estimator.rig.figures,
        Stickers(places, taught_places, normals, camera.scene.radius),
        np.zeros(count, dtype=int),
        camera.scene.hiding,
        centre_noise(
            estimator.noise, light.optics.psf_px, settings.fit_size, light.sticker, light.ring
        ),
        limits,
        belief_for(count, SETTLED),
        np.ascontiguousarray(taught.base_from_camera),
        invert(taught.base_from_camera),
    )


def _cameras(rig: StereoRig, moves: Sequence[Array]) -> Cameras:
    return rig.figures._replace(moves=np.stack(moves))
