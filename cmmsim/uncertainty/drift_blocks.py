"""Residuals of the stickers' pixels in blocks of frames, and the effects of errors of the rig.

The residuals of a body are observed minus expected pixels, in units of their noise. Expected pixels
follow from taught positions and the measured pose. The pose of the platform is estimated from the
same pixels, so the part of the residuals that a pose explains is removed. With n stickers, the 4 n
residuals then have unit variance in 4 n - 6 directions and are zero in the other six. The base
stands still, and its pose was taught, so nothing is removed from its residuals. The residuals of
the base also show movements of the whole rig relative to the base.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.pose import Array, apply, apply_each, point_jacobian, transforms_of
from cmmsim.geometry.stereo_rig import PARAMETER_NAMES, PLACE_NAMES, StereoRig
from cmmsim.uncertainty.common_errors import MeasuringGeometry

# Names of the parameters of a common movement of both cameras. The parameters are those of the
# base's movement in camera axes, with rotations about the base's origin.
PLACES_OF_RIG = tuple(f"camera_from_base.{name}" for name in PLACE_NAMES)

# Standard deviation, px, whose square is added to the stated variance of a centre. The stated
# variance can be too small.
SMALLEST_STD_PX = 5e-4
RIG = len(PARAMETER_NAMES)  # number of parameters of a rig


@dataclass(frozen=True)
class Rows:
    """Residuals of b blocks of frames, with their derivatives.

    residuals   (b, m), with variance one or zero in each direction
    by_drift    (b, m, 30), for changes of the rig's parameters and of its pose since teaching
    by_start    (b, m, 24), for errors of the rig's parameters that existed at teaching already
    by_delay    (b, m, 1), for the delay of the right camera's exposure, s
    by_offsets  (b, m, o), for constant errors of single centres, px
    """

    residuals: Array
    by_drift: Array
    by_start: Array
    by_delay: Array
    by_offsets: Array


@dataclass
class FrameBlock:
    """Block of frames that show the same stickers of a body.

    ``index`` (k,) are the indices of the stickers in the body, and ``places`` (k, 3) their
    positions in body axes, m. The lists contain one entry per frame: the time in s, the pose (6,)
    of the body in the base frame, the pixels (2, k, 2), and their variances (k,) px².
    """

    index: NDArray[np.int_]
    places: Array
    camera_from_base: Array
    times: list[float] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    pixels: list[Array] = field(default_factory=list)
    variances: list[Array] = field(default_factory=list)

    def add(self, time: float, pose: Array, pixels: tuple[Array, Array], variances: Array) -> None:
        """Add a frame."""
        self.times.append(time)
        self.poses.append(pose)
        self.pixels.append(np.array(pixels))
        self.variances.append(variances)

    @cached_property
    def camera_from_body(self) -> Array:
        """Transforms camera_from_body (f, 4, 4) of all frames. Frames must not be added later."""
        return np.asarray(self.camera_from_base @ transforms_of(np.array(self.poses)))

    @property
    def middle(self) -> Array:
        """Transform camera_from_body (4, 4) in the middle frame."""
        return np.asarray(self.camera_from_body[len(self.camera_from_body) // 2])

    @property
    def velocities(self) -> Array:
        """Mean velocities (k, 3) of the stickers in the camera frame, m/s; zero for one frame."""
        span = self.times[-1] - self.times[0]
        if span == 0.0:
            return np.zeros(self.places.shape)
        return (
            apply(self.camera_from_body[-1], self.places)
            - apply(self.camera_from_body[0], self.places)
        ) / span


def platform_rows(geometry: MeasuringGeometry, blocks: Sequence[FrameBlock]) -> Rows:
    """Return the rows of blocks of frames in which the same stickers of the platform were seen."""
    index = blocks[0].index
    camera_from_body = np.array([block.middle for block in blocks])
    arms = blocks[0].places @ camera_from_body[:, :3, :3].swapaxes(1, 2)
    slopes, by_rig = _derivatives(geometry.rig, arms + camera_from_body[:, None, :3, 3])
    taught = np.einsum(
        "bij,pkj->bkip", camera_from_body[:, :3, :3], geometry.taught_by_rig[1][:, index]
    )
    by_delay = np.zeros((*by_rig.shape[:-1], 1))
    by_delay[1, ..., 0] = np.einsum(
        "bkij,bkj->bki", slopes[1], np.array([block.velocities for block in blocks])
    )
    residuals, roots = _whitened(geometry.rig, blocks)
    # orthonormal columns that span the residuals which a change of the pose explains
    by_pose = np.linalg.qr(_whiten(roots, slopes @ point_jacobian(arms)))[0]

    def without_pose(values: Array) -> Array:
        """Remove the part of values (b, 4k, ...) that a change of the pose explains."""
        return np.asarray(values - by_pose @ (by_pose.swapaxes(1, 2) @ values))

    drift = without_pose(_whiten(roots, by_rig))
    return Rows(
        without_pose(residuals[..., None])[..., 0],
        np.pad(drift, ((0, 0), (0, 0), (0, len(PLACES_OF_RIG)))),
        drift - without_pose(_whiten(roots, slopes @ taught)),
        without_pose(_whiten(roots, by_delay)),
        _offsets(without_pose, roots, index, len(geometry.taught.platform_places)),
    )


def base_rows(geometry: MeasuringGeometry, blocks: Sequence[FrameBlock]) -> Rows:
    """Return the rows of blocks of frames in which the same stickers of the base were seen."""
    index = blocks[0].index
    camera_from_base = geometry.camera_from_base
    arms = blocks[0].places @ camera_from_base[:3, :3].T
    slopes, by_rig = geometry.rig.derivatives(arms + camera_from_base[:3, 3])
    sticker_slopes = slopes.transpose(1, 0, 2, 3).reshape(len(arms), 4, 3)
    sticker_by_rig = by_rig.transpose(1, 0, 2, 3).reshape(len(arms), 4, RIG)
    # derivatives of the taught positions with respect to the rig
    taught = np.linalg.solve(
        sticker_slopes.swapaxes(1, 2) @ sticker_slopes,
        sticker_slopes.swapaxes(1, 2) @ sticker_by_rig,
    )
    by_drift = np.concatenate([by_rig, slopes @ point_jacobian(arms)], axis=-1)
    residuals, roots = _whitened(geometry.rig, blocks)
    return Rows(
        residuals,
        _whiten(roots, by_drift[:, None]),
        _whiten(roots, (by_rig - slopes @ taught)[:, None]),
        np.zeros((*residuals.shape, 1)),
        _offsets(np.asarray, roots, index, len(geometry.taught.base_places)),
    )


def stacked(rows: list[Rows], centres: tuple[int, ...]) -> Rows:
    """Join the rows of several bodies.

    ``centres`` is the number of stickers of each body. Each body has its own columns of offsets.
    """
    sizes = [body_rows.residuals.shape for body_rows in rows]
    first = 0
    before = 0
    offsets = np.zeros((sizes[0][0], sum(size for _, size in sizes), 4 * sum(centres)))
    for body_rows, (_, size), count in zip(rows, sizes, centres, strict=False):
        offsets[:, first : first + size, 4 * before : 4 * (before + count)] = body_rows.by_offsets
        first = first + size
        before = before + count
    parts = {
        name: np.concatenate([getattr(body_rows, name) for body_rows in rows], axis=1)
        for name in NOT_OFFSETS
    }
    return Rows(**parts, by_offsets=offsets)


# Arrays of Rows whose columns are the same for all bodies.
NOT_OFFSETS = ("residuals", "by_drift", "by_start", "by_delay")


def _derivatives(rig: StereoRig, points: Array) -> tuple[Array, Array]:
    """Return the derivatives of the pixels of points (b, k, 3).

    The first (2, b, k, 2, 3) are with respect to the points, and the second (2, b, k, 2, 24) to the
    rig's parameters.
    """
    slopes, by_rig = rig.derivatives(points.reshape(-1, 3))
    return slopes.reshape(2, *points.shape[:2], 2, 3), by_rig.reshape(2, *points.shape[:2], 2, RIG)


def _whitened(rig: StereoRig, blocks: Sequence[FrameBlock]) -> tuple[Array, Array]:
    """Return the means (b, 4k) of observed minus expected pixels over the frames of each block.

    The means are in units of their standard deviations. The second result, ``roots`` (b, k),
    contains the reciprocals of these standard deviations, 1/px.
    """
    weights = 1.0 / (
        np.array([each for block in blocks for each in block.variances]) + SMALLEST_STD_PX**2
    )
    camera_from_body = np.concatenate([block.camera_from_body for block in blocks])
    pixels = np.array([each for block in blocks for each in block.pixels]).swapaxes(0, 1)
    residuals = pixels - rig.project(apply_each(camera_from_body, blocks[0].places))[0]
    starts = np.cumsum([0, *(len(block.times) for block in blocks)])[:-1]
    roots = np.sqrt(np.add.reduceat(weights, starts))
    summed = np.add.reduceat(weights[..., None] * residuals, starts, axis=1)
    return (summed / roots[..., None]).swapaxes(0, 1).reshape(len(blocks), -1), roots


def _whiten(roots: Array, slopes: Array) -> Array:
    """Return derivatives (b, 4k, p) of whitened residuals from derivatives of pixels.

    ``slopes`` (2, b, k, 2, p) are the derivatives of pixels, and ``roots`` those of ``_whitened``.
    """
    weighted = (roots[..., None, None] * slopes).swapaxes(0, 1)
    return weighted.reshape(len(roots), 4 * roots.shape[1], -1)


def _offsets(
    without_pose: Callable[[Array], Array], roots: Array, index: NDArray[np.int_], count: int
) -> Array:
    """Return derivatives (b, 4k, 4 count) of whitened residuals for the offsets of all centres.

    The body has ``count`` stickers, of which those with ``index`` (k,) are seen. ``without_pose``
    removes the part that a pose explains.
    """
    blocks, k = roots.shape
    offsets = np.zeros((blocks, 4 * k, 2, count, 2))
    seen = without_pose(np.repeat(np.tile(roots, 2), 2, axis=1)[..., None] * np.eye(4 * k))
    offsets[:, :, :, index] = seen.reshape(blocks, 4 * k, 2, k, 2)
    return offsets.reshape(blocks, 4 * k, -1)
