"""Residuals of the stickers' pixels in a few frames, and their changes by each error of the rig.

A body's stickers are expected where their taught places and its measured pose put them. The pose is
estimated from the same pixels, so the part of the residuals that six numbers explain is removed.
The misfit of the pattern and the gaps of the rays remain. With n stickers these are 4 n numbers, of
unit variance in the 4 n - 6 directions that no pose explains, and zero in the others. The base
stands still, and its pose was taught, so nothing is removed from its residuals. They also show
movements of the whole rig relative to the base.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.pose import Array, apply, apply_each, skew, transforms_of
from cmmsim.geometry.stereo_rig import PARAMETER_NAMES, PLACE_NAMES, StereoRig
from cmmsim.uncertainty.common_errors import MeasuringGeometry

PLACES_OF_RIG = tuple(f"camera_from_base.{name}" for name in PLACE_NAMES)
"""Names of a movement of both cameras together. Points of the base move by as much in the camera
frame, about its origin.
"""

# px of a centre: no detector is better, whatever it states.
SMALLEST_STD_PX = 5e-4
RIG = len(PARAMETER_NAMES)


@dataclass(frozen=True)
class Rows:
    """Rows of b blocks of frames.

    ``residuals`` (b, m) have unit variance, or zero, in any direction. Their derivatives are
    ``by_drift`` (b, m, 30) of the rig's parameters and its place since teaching, ``by_start`` (b,
    m, 24) of errors that the rig had at teaching already, ``by_delay`` (b, m, 1) of the time [s] by
    which the right camera exposes later, and ``by_offsets`` (b, m, o) [px] of single centres.
    """

    residuals: Array
    by_drift: Array
    by_start: Array
    by_delay: Array
    by_offsets: Array


@dataclass
class Sightings:
    """Block of frames that show the same stickers of a body.

    The stickers have an ``index`` (k,) and places (k, 3) in body axes. Each frame has its time in
    s, base_from_body as a pose (6,), pixels (2, k, 2) and their variances (k,) px².
    """

    index: NDArray[np.int_]
    places: Array
    camera_from_base: Array
    times: list[float] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    pixels: list[Array] = field(default_factory=list)
    variances: list[Array] = field(default_factory=list)

    def add(self, time: float, pose: Array, pixels: tuple[Array, Array], variances: Array) -> None:
        """Add one more frame."""
        self.times.append(time)
        self.poses.append(pose)
        self.pixels.append(np.array(pixels))
        self.variances.append(variances)

    @cached_property
    def moves(self) -> Array:
        """Transforms camera_from_body (f, 4, 4) of all frames, once there are no more."""
        return np.asarray(self.camera_from_base @ transforms_of(np.array(self.poses)))

    @property
    def middle(self) -> Array:
        """Transform camera_from_body (4, 4) half way."""
        return np.asarray(self.moves[len(self.moves) // 2])

    @property
    def velocities(self) -> Array:
        """Velocities of the stickers (k, 3) in the camera frame, m/s; zero if only one frame was
        seen.
        """
        span = self.times[-1] - self.times[0]
        if span == 0.0:
            return np.zeros(self.places.shape)
        return (apply(self.moves[-1], self.places) - apply(self.moves[0], self.places)) / span


def platform_rows(geometry: MeasuringGeometry, blocks: Sequence[Sightings]) -> Rows:
    """Return the rows of blocks of frames with the same stickers, in which the platform was
    measured.
    """
    index = blocks[0].index
    moves = np.array([seen.middle for seen in blocks])
    arms = blocks[0].places @ moves[:, :3, :3].swapaxes(1, 2)
    slopes, by_rig = _derivatives(geometry.rig, arms + moves[:, None, :3, 3])
    taught = np.einsum("bij,pkj->bkip", moves[:, :3, :3], geometry.taught_by_rig[1][:, index])
    by_delay = np.zeros((*by_rig.shape[:-1], 1))
    by_delay[1, ..., 0] = np.einsum(
        "bkij,bkj->bki", slopes[1], np.array([seen.velocities for seen in blocks])
    )
    residuals, roots = _whitened(geometry.rig, blocks)
    # Orthonormal columns span the residuals that six numbers of a pose explain.
    by_pose = np.linalg.qr(_whiten(roots, slopes @ _small_movement(arms)))[0]

    def left(values: Array) -> Array:
        """Remove from values (b, 4k, ...) what a pose explains."""
        return np.asarray(values - by_pose @ (by_pose.swapaxes(1, 2) @ values))

    drift = left(_whiten(roots, by_rig))
    return Rows(
        left(residuals[..., None])[..., 0],
        np.pad(drift, ((0, 0), (0, 0), (0, len(PLACES_OF_RIG)))),
        drift - left(_whiten(roots, slopes @ taught)),
        left(_whiten(roots, by_delay)),
        _offsets(left, roots, index, len(geometry.taught.platform_places)),
    )


def base_rows(geometry: MeasuringGeometry, blocks: Sequence[Sightings]) -> Rows:
    """Return the rows of blocks of frames with the same stickers of the base, which stands
    still.
    """
    index = blocks[0].index
    move = geometry.camera_from_base
    arms = blocks[0].places @ move[:3, :3].T
    slopes, by_rig = geometry.rig.derivatives(arms + move[:3, 3])
    across = slopes.transpose(1, 0, 2, 3).reshape(len(arms), 4, 3)
    rig_first = by_rig.transpose(1, 0, 2, 3).reshape(len(arms), 4, RIG)
    # Changes of the places at which the stickers were taught.
    taught = np.linalg.solve(across.swapaxes(1, 2) @ across, across.swapaxes(1, 2) @ rig_first)
    by_drift = np.concatenate([by_rig, slopes @ _small_movement(arms)], axis=-1)
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

    Each body has its own offsets, for as many stickers as ``centres`` states.
    """
    sizes = [one.residuals.shape for one in rows]
    first = 0
    before = 0
    every = np.zeros((sizes[0][0], sum(size for _, size in sizes), 4 * sum(centres)))
    for one, (_, size), count in zip(rows, sizes, centres, strict=False):
        every[:, first : first + size, 4 * before : 4 * (before + count)] = one.by_offsets
        first = first + size
        before = before + count
    parts = {
        name: np.concatenate([getattr(one, name) for one in rows], axis=1) for name in NOT_OFFSETS
    }
    return Rows(**parts, by_offsets=every)


NOT_OFFSETS = ("residuals", "by_drift", "by_start", "by_delay")


def _derivatives(rig: StereoRig, points: Array) -> tuple[Array, Array]:
    """Return derivatives (2, b, k, 2, 3) of pixels by points (b, k, 3), and (2, b, k, 2, 24) by the
    rig.
    """
    slopes, by_rig = rig.derivatives(points.reshape(-1, 3))
    return slopes.reshape(2, *points.shape[:2], 2, 3), by_rig.reshape(2, *points.shape[:2], 2, RIG)


def _whitened(rig: StereoRig, blocks: Sequence[Sightings]) -> tuple[Array, Array]:
    """Return means (b, 4k) of pixels less those expected, in units of their standard deviations.

    The second result is the roots (b, k) of their weights.
    """
    weights = 1.0 / (
        np.array([each for seen in blocks for each in seen.variances]) + SMALLEST_STD_PX**2
    )
    moves = np.concatenate([seen.moves for seen in blocks])
    pixels = np.array([each for seen in blocks for each in seen.pixels]).swapaxes(0, 1)
    residuals = pixels - rig.project(apply_each(moves, blocks[0].places))[0]
    starts = np.cumsum([0, *(len(seen.times) for seen in blocks)])[:-1]
    roots = np.sqrt(np.add.reduceat(weights, starts))
    summed = np.add.reduceat(weights[..., None] * residuals, starts, axis=1)
    return (summed / roots[..., None]).swapaxes(0, 1).reshape(len(blocks), -1), roots


def _whiten(roots: Array, slopes: Array) -> Array:
    """Return derivatives (b, 4k, p) of whitened residuals from those of pixels (2, b, k, 2, p)."""
    weighted = (roots[..., None, None] * slopes).swapaxes(0, 1)
    return weighted.reshape(len(roots), 4 * roots.shape[1], -1)


def _small_movement(arms: Array) -> Array:
    """Return derivatives (..., 3, 6) of points by the small movement [dt, dphi] of their body.

    The points are arms (..., 3) from the body's origin.
    """
    return np.concatenate([np.broadcast_to(np.eye(3), (*arms.shape, 3)), -skew(arms)], axis=-1)


def _offsets(
    left: Callable[[Array], Array], roots: Array, index: NDArray[np.int_], count: int
) -> Array:
    """Return derivatives (b, 4k, 4 count) by the offsets of all centres of a body.

    An index (k,) of them is seen.
    """
    blocks, k = roots.shape
    every = np.zeros((blocks, 4 * k, 2, count, 2))
    seen = left(np.repeat(np.tile(roots, 2), 2, axis=1)[..., None] * np.eye(4 * k))
    every[:, :, :, index] = seen.reshape(blocks, 4 * k, 2, k, 2)
    return every.reshape(blocks, 4 * k, -1)
