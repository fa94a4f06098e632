"""Many frames at once: drawn, read and measured in blocks, on all cores."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from cmmsim.errors import LostError
from cmmsim.geometry.pose import Array, invert, pose_to_transform, transforms_of
from cmmsim.imaging.analytic import ANALYTIC
from cmmsim.imaging.exposure import VirtualStereoCamera
from cmmsim.pose_estimation.estimator import Measurement, PoseEstimator, lost_measurement
from cmmsim.pose_estimation.many import ManySeen, measure_exposures

BLOCK = 32  # frames that are drawn and measured together


def measure_at_rest(
    camera: VirtualStereoCamera,
    estimator: PoseEstimator,
    poses: Array,
    near: Array,
    rngs: Sequence[np.random.Generator],
    obstacles: Mapping[str, Array],
) -> list[ManySeen]:
    """Exposures of the platform at rest at poses (N,6), each with the noise of its own stream, measured by stickers
    that are looked for near poses (N,6): block after block of frames.

    How many threads share the blocks changes nothing in the result.
    """
    expected = expected_at(estimator, near)
    parts = [slice(start, start + BLOCK) for start in range(0, len(poses), BLOCK)]

    def block(part: slice) -> ManySeen:
        return measure_exposures(estimator, camera.look_many(poses[part], rngs[part], obstacles), expected[part])

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


def measure_moving(
    camera: VirtualStereoCamera,
    estimator: PoseEstimator,
    poses: Array,
    rates: Array,
    rngs: Sequence[np.random.Generator],
    obstacles: Mapping[str, Array],
) -> list[Measurement]:
    """Exposures of the platform at poses (N,6) in motion at rates (N,6), one by one: the movement is known."""
    expected, found = expected_at(estimator, poses), []
    for pose, rate, place, rng in zip(poses, rates, expected, rngs, strict=True):
        half = 0.5 * camera.exposure * rate
        back = place @ invert(pose_to_transform(pose))
        swept = back @ pose_to_transform(pose - half), back @ pose_to_transform(pose + half)
        try:
            found.append(estimator.measure(camera.look(pose, rng, obstacles, pose_rate=rate), place, swept)[0])
        except LostError as error:
            found.append(lost_measurement(str(error)))
    return found
