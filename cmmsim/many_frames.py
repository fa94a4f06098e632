"""Many frames at once: drawn, read and measured in blocks, on all cores."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from cmmsim.geometry.pose import Array, invert, transforms_of
from cmmsim.imaging.analytic import ANALYTIC
from cmmsim.imaging.exposure import VirtualStereoCamera
from cmmsim.pose_estimation.estimator import PoseEstimator
from cmmsim.pose_estimation.many import ManySeen, measure_exposures

BLOCK = 32  # frames that are drawn and measured together


def measure_frames(
    camera: VirtualStereoCamera,
    estimator: PoseEstimator,
    poses: Array,
    rates: Array,
    near: Array,
    rngs: Sequence[np.random.Generator],
    obstacles: Mapping[str, Array],
) -> list[ManySeen]:
    """Exposures of the platform at poses (N,6) in motion at rates (N,6), each with the noise of its own stream,
    measured by stickers that are looked for near poses (N,6), by a movement that is known: block after block of frames.

    How many threads share the blocks changes nothing in the result.
    """
    expected, half = expected_at(estimator, near), 0.5 * camera.exposure * rates
    back = expected @ invert(transforms_of(poses))
    first, last = back @ transforms_of(poses - half), back @ transforms_of(poses + half)
    parts = [slice(start, start + BLOCK) for start in range(0, len(poses), BLOCK)]

    def block(part: slice) -> ManySeen:
        images = camera.look_many(poses[part], rngs[part], obstacles, rates[part])
        return measure_exposures(estimator, images, expected[part], (first[part], last[part]))

    threads = threads_at_most() if camera.formation.renderer is ANALYTIC else 1  # OpenGL draws in one thread only
    if threads == 1 or len(parts) < 2:
        return [block(part) for part in parts]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(block, parts))


def expected_at(estimator: PoseEstimator, poses: Array) -> Array:
    """Expected camera_from_platform (N,4,4) at poses (N,6)."""
    camera_from_base = invert(estimator.taught.base_from_camera)
    return np.asarray(camera_from_base @ transforms_of(poses))


def threads_at_most() -> int:
    """One a core, or as many as NUMBA_NUM_THREADS says."""
    from numba.core.config import NUMBA_NUM_THREADS  # type: ignore[attr-defined]  # set when it loads, which is slow

    return min(int(NUMBA_NUM_THREADS), os.cpu_count() or 1)
