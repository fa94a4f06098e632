"""Many frames at once: drawn, read and measured in blocks, on all cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from cmmsim.checks import finite_array
from cmmsim.errors import LostError
from cmmsim.geometry.pose import Array, invert, transforms_of
from cmmsim.imaging.analytic import ANALYTIC
from cmmsim.imaging.renderer import Renderer
from cmmsim.imaging.stereo_camera import VirtualStereoCamera
from cmmsim.measuring.measured_poses import ManySeen, measure_exposures
from cmmsim.measuring.measurement import Measurement, lost_measurement
from cmmsim.measuring.pose_estimator import PoseEstimator
from cmmsim.without_images.drawn_stickers import StatisticalStereoCamera

T = TypeVar("T")
R = TypeVar("R")
BLOCK = 32  # frames that are drawn and measured together

Frames = tuple[
    PoseEstimator, Array, Array, Array, Sequence[np.random.Generator], Mapping[str, Array]
]
"""What ``measure_frames`` takes beside the camera."""


def measure_frames(
    camera: VirtualStereoCamera,
    estimator: PoseEstimator,
    poses: Array,
    rates: Array,
    near: Array,
    rngs: Sequence[np.random.Generator],
    obstacles: Mapping[str, Array],
) -> Iterator[ManySeen]:
    """Exposures of the platform at poses (N,6) in motion at rates (N,6), each with the noise of its
    own stream, measured by stickers that are looked for near poses (N,6), by a movement that is
    known: block after block of frames.

    How many threads share the blocks changes nothing in the result.
    """
    expected = expected_at(estimator, near)
    half = 0.5 * camera.exposure * rates
    back = expected @ invert(transforms_of(poses))
    first = back @ transforms_of(poses - half)
    last = back @ transforms_of(poses + half)
    parts = [slice(start, start + BLOCK) for start in range(0, len(poses), BLOCK)]

    def block(part: slice) -> ManySeen:
        images = camera.look_many(poses[part], rngs[part], obstacles, rates[part])
        return measure_exposures(estimator, images, expected[part], (first[part], last[part]))

    return on_all_cores(block, parts, camera.formation.renderer)


def measure_without_images(
    camera: StatisticalStereoCamera,
    estimator: PoseEstimator,
    poses: Array,
    rates: Array,
    near: Array,
    rngs: Sequence[np.random.Generator],
    obstacles: Mapping[str, Array],
) -> list[Measurement]:
    """As ``measure_frames`` of cameras that draw nothing, one by one."""
    found = []
    for pose, rate, expected, rng in zip(
        poses, rates, expected_at(estimator, near), rngs, strict=True
    ):
        try:
            found.append(
                estimator.measure(camera.look(pose, rng, obstacles, pose_rate=rate), expected)[0]
            )
        except LostError as error:
            found.append(lost_measurement(str(error)))
    return found


def on_all_cores(work: Callable[[T], R], parts: Sequence[T], renderer: Renderer) -> Iterator[R]:
    """Results of work on parts that know nothing of each other, in their order; in one thread with
    a renderer that may need it, as OpenGL does."""
    threads = threads_at_most() if renderer is ANALYTIC else 1
    if threads == 1 or len(parts) < 2:
        yield from map(work, parts)
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(work, parts)


def expected_at(estimator: PoseEstimator, poses: Array) -> Array:
    """Expected camera_from_platform (N,4,4) at poses (N,6)."""
    camera_from_base = invert(estimator.taught.base_from_camera)
    return np.asarray(camera_from_base @ transforms_of(poses))


def threads_at_most() -> int:
    """One a core, or as many as NUMBA_NUM_THREADS says."""
    from numba.core.config import NUMBA_NUM_THREADS  # type: ignore[attr-defined]  # set when it loads, which is slow

    return min(int(NUMBA_NUM_THREADS), os.cpu_count() or 1)


def pose_rows(poses: ArrayLike) -> Array:
    """Poses (N,6), checked; an empty list holds none."""
    if isinstance(poses, list) and not poses:
        return np.zeros((0, 6))
    try:
        count = len(poses)  # type: ignore[arg-type]  # a number has no length
    except TypeError:
        count = 1
    return finite_array(poses, (count, 6), "poses are rows of six finite numbers, m and rad")
