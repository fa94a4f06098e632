"""Measurement of many frames at once, in blocks and on all cores.

For all exposures of a block together, windows are read, ellipses fitted and stickers triangulated.
The pose of each exposure is then solved separately.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from cmmsim.checks import finite_array
from cmmsim.errors import LostError
from cmmsim.geometry.pose import Array, invert, transforms_of
from cmmsim.imaging.analytic import ANALYTIC
from cmmsim.imaging.renderer import Renderer
from cmmsim.imaging.stereo_camera import VirtualStereoCamera
from cmmsim.measuring.frame_solver import SolvedFrames, solve_frames
from cmmsim.measuring.measurement import MeasuredPoses, Measurement, lost_measurement
from cmmsim.measuring.pose_estimator import PoseEstimator
from cmmsim.radiometry.stereo_images import ManyExposures
from cmmsim.without_images.drawn_stickers import StatisticalStereoCamera

T = TypeVar("T")
R = TypeVar("R")
# Number of frames that are drawn and measured together.
BLOCK = 32


@dataclass(frozen=True)
class Frames:
    """N frames of a platform at ``poses`` (N, 6), which change at ``rates`` (N, 6).

    Units are m, rad and s. Each frame has its own generator of noise in ``rngs``. Stickers are
    searched near the poses ``near`` (N, 6). ``obstacles`` maps names of bodies that stand still to
    their base_from_body (4, 4). ``period`` is the time between two frames.
    """

    estimator: PoseEstimator
    poses: Array
    rates: Array
    near: Array
    rngs: Sequence[np.random.Generator]
    obstacles: Mapping[str, Array]
    period: float

    @property
    def expected(self) -> Array:
        """Expected camera_from_platform (N, 4, 4)."""
        camera_from_base = invert(self.estimator.taught.base_from_camera)
        return np.asarray(camera_from_base @ transforms_of(self.near))


def measure_frames(camera: VirtualStereoCamera, frames: Frames) -> Iterator[MeasuredExposures]:
    """Yield the measurements of frames block by block.

    The estimator is given the true movement during each exposure. The result does not depend on the
    number of threads.
    """
    estimator = frames.estimator
    poses = frames.poses
    rates = frames.rates
    rngs = frames.rngs
    expected = frames.expected
    half_movement = 0.5 * camera.exposure * rates
    # In mid-exposure, the platform is assumed at its expected pose. Its movement is the true one.
    to_expected = expected @ invert(transforms_of(poses))
    at_start = to_expected @ transforms_of(poses - half_movement)
    at_end = to_expected @ transforms_of(poses + half_movement)
    half_period_movement = 0.5 * frames.period * rates
    before = to_expected @ transforms_of(poses - half_period_movement)
    after = to_expected @ transforms_of(poses + half_period_movement)
    parts = [slice(start, start + BLOCK) for start in range(0, len(poses), BLOCK)]

    def block(part: slice) -> MeasuredExposures:
        images = camera.look_many(poses[part], rngs[part], frames.obstacles, rates[part])
        ends = (at_start[part], at_end[part]), (before[part], after[part])
        return measure_exposures(estimator, images, expected[part], *ends)

    return on_all_cores(block, parts, camera.formation.renderer)


def measure_without_images(camera: StatisticalStereoCamera, frames: Frames) -> list[Measurement]:
    """Measure frames one by one with cameras that give the detected stickers without images."""
    measured = []
    rows = zip(frames.poses, frames.rates, frames.expected, frames.rngs, strict=True)
    for pose, rate, expected, rng in rows:
        try:
            seen = camera.look(pose, rng, frames.obstacles, pose_rate=rate)
            measured.append(frames.estimator.measure(seen, expected)[0])
        except LostError as error:
            measured.append(lost_measurement(str(error)))
    return measured


@dataclass(frozen=True)
class MeasuredExposures:
    """Result of N exposures that were measured together.

    ``found`` contains the poses, and ``solved`` the stickers. ``others`` maps indices of exposures
    to measurements. It contains the lost exposures, and all exposures if the method is not
    registration.
    """

    estimator: PoseEstimator
    found: MeasuredPoses
    solved: SolvedFrames
    others: dict[int, Measurement]

    def measurements(self) -> list[Measurement]:
        """Return the measurement of each exposure."""
        return [
            self.others.get(k) or self._by_registration(k) for k in range(len(self.found.poses))
        ]

    def _by_registration(self, k: int) -> Measurement:
        """Return the measurement of an exposure that is not among ``others``."""
        pose = self.found.poses[k]
        return self.estimator.measurement(pose, self.found.covariances[k], self.solved.used_in(k))


def measure_exposures(
    estimator: PoseEstimator,
    images: ManyExposures,
    expected: Array,
    exposure_ends: tuple[Array, Array],
    frame_ends: tuple[Array, Array] | None = None,
) -> MeasuredExposures:
    """Measure the platform in each of N exposures.

    ``expected`` (N, 4, 4) are first guesses of camera_from_platform. ``exposure_ends`` are the
    expected camera_from_platform (N, 4, 4) at the beginning and at the end of the exposures.
    ``frame_ends`` are those half a frame period before and after the middles of the exposures. The
    results equal those of ``PoseEstimator.measure`` for each exposure.
    """
    places = estimator.taught.platform_places
    normals = estimator.platform.sticker_normals
    seen = estimator.read(images, expected, places, normals).observed(exposure_ends, frame_ends)
    solved = solve_frames(seen, expected, estimator, estimator.platform, places)
    poses, covariances = estimator.in_base(solved.camera_from_body, solved.covariances)
    exposure_of = seen.index // len(places)
    used = np.bincount(exposure_of[solved.used], minlength=len(expected))
    others = {}
    for k in np.flatnonzero(solved.lost | (estimator.method != "registration")):
        measured = estimator.measurement_of(solved, int(k))
        others[int(k)] = measured
        poses[k] = measured.pose
        covariances[k] = measured.covariance
        used[k] = len(measured.target_ids)
    return MeasuredExposures(estimator, MeasuredPoses(poses, covariances, used), solved, others)


def on_all_cores(work: Callable[[T], R], parts: Sequence[T], renderer: Renderer) -> Iterator[R]:
    """Yield the results of ``work`` on independent parts, in the order of the parts.

    Several threads are used with the analytic renderer only, because OpenGL must be called from one
    thread.
    """
    threads = threads_at_most() if renderer is ANALYTIC else 1
    if threads == 1 or len(parts) < 2:
        yield from map(work, parts)
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(work, parts)


def threads_at_most() -> int:
    """Return the largest number of threads: NUMBA_NUM_THREADS, but at most the number of cores."""
    # Imported late, because importing numba takes time.
    from numba.core.config import NUMBA_NUM_THREADS  # type: ignore[attr-defined]  # set at run time

    return min(int(NUMBA_NUM_THREADS), os.cpu_count() or 1)


def pose_rows(poses: ArrayLike) -> Array:
    """Return poses as an array (N, 6); N is 0 for an empty list.

    Raises ShapeError if a pose is not six finite numbers.
    """
    if isinstance(poses, list) and not poses:
        return np.zeros((0, 6))
    try:
        count = len(poses)  # type: ignore[arg-type]  # a number has no length
    except TypeError:
        count = 1
    return finite_array(poses, (count, 6), "each pose is a row of six finite numbers, m and rad")
