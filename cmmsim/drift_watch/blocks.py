"""What a few frames say of the rig: residuals of the stickers' pixels, and what each error of the rig does to them.

A body's stickers are expected where their taught places and its measured pose put them. The pose itself is not known
otherwise, so what six numbers explain is taken out: what is left is the pattern's misfit and the gaps of the rays.
With n stickers, 4 n - 6 numbers of unit variance. The base stands still, and its pose was taught: of that nothing is
taken out, and it shows how the whole rig stands against it as well.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cmmsim.common_errors import MeasuringGeometry
from cmmsim.geometry.pose import Array, apply, skew
from cmmsim.geometry.stereo_rig import PARAMETER_NAMES, PLACE_NAMES

PLACES_OF_RIG = tuple(f"camera_from_base.{name}" for name in PLACE_NAMES)
"""A movement of both cameras together: by so much points of the base move in the camera frame, about its origin."""

SMALLEST_STD_PX = 5e-4  # of a centre: no detector is better, whatever it states
RIG = len(PARAMETER_NAMES)


@dataclass(frozen=True)
class Rows:
    """residuals (m,) of unit variance, and their derivatives: by a drift since teaching (m, 30) of the rig's parameters
    and its place, by errors (m, 24) that the rig had at teaching already, by the time (m, 1) [s] by which the right
    camera exposes later, and by offsets (m, o) [px] of single centres."""

    residuals: Array
    by_drift: Array
    by_start: Array
    by_delay: Array
    by_offsets: Array


NOT_OFFSETS = ("residuals", "by_drift", "by_start", "by_delay")


@dataclass
class Sightings:
    """The same stickers of a body in some frames: index (k,); camera_from_body (4,4) and time s of each frame; weights
    (k,) px^-2, and weighted residuals (2, k, 2), of all of them."""

    index: NDArray[np.int_]
    places: list[Array] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    weights: Array = field(default_factory=lambda: np.zeros(()))
    weighted: Array = field(default_factory=lambda: np.zeros(()))

    def add(self, time: float, camera_from_body: Array, residuals: Array, variances: Array) -> None:
        """One more frame: residuals (2, k, 2) px with variances (k,) px²."""
        weights = 1.0 / (variances + SMALLEST_STD_PX**2)
        self.places.append(camera_from_body)
        self.times.append(time)
        self.weights = self.weights + weights
        self.weighted = self.weighted + weights[:, None] * residuals

    @property
    def middle(self) -> Array:
        """camera_from_body (4,4) half way."""
        return self.places[len(self.places) // 2]

    @property
    def whitened(self) -> Array:
        """Mean residuals (4k,) in units of their standard deviations."""
        return np.asarray((self.weighted / np.sqrt(self.weights)[:, None]).ravel())

    def whiten(self, slopes: Array) -> Array:
        """Derivatives (4k, p) of the same from those of pixels (2, k, 2, p)."""
        return np.asarray((np.sqrt(self.weights)[:, None, None] * slopes).reshape(4 * len(self.index), -1))

    def velocities(self, points: Array) -> Array:
        """Of points (k, 3) in body axes, in the camera frame, m/s; zero where only one frame was seen."""
        span = self.times[-1] - self.times[0]
        if span == 0.0:
            return np.zeros(points.shape)
        return (apply(self.places[-1], points) - apply(self.places[0], points)) / span


def platform_rows(geometry: MeasuringGeometry, seen: Sightings) -> Rows:
    """What frames say in which the platform was measured."""
    places = geometry.taught.platform_places[seen.index]
    move = seen.middle
    arms = places @ move[:3, :3].T
    slopes, by_rig = geometry.rig.derivatives(arms + move[:3, 3])
    taught = np.einsum("ij,pkj->kip", move[:3, :3], geometry.taught_by_rig[1][:, seen.index])
    by_pose = seen.whiten(slopes @ _small_movement(arms))
    told = np.linalg.qr(by_pose, mode="complete")[0][:, by_pose.shape[1] :].T  # what no pose explains
    by_delay = np.zeros((*by_rig.shape[:3], 1))
    by_delay[1, ..., 0] = np.einsum("kij,kj->ki", slopes[1], seen.velocities(places))

    def rows(derivatives: Array) -> Array:
        return np.asarray(told @ seen.whiten(derivatives))

    count = len(geometry.taught.platform_places)
    by_drift = np.pad(rows(by_rig), ((0, 0), (0, len(PLACES_OF_RIG))))
    offsets = _offsets(rows, seen.index, count)
    return Rows(told @ seen.whitened, by_drift, rows(by_rig - slopes @ taught), rows(by_delay), offsets)


def base_rows(geometry: MeasuringGeometry, seen: Sightings) -> Rows:
    """What frames say in which the base was looked at."""
    move, count = geometry.camera_from_base, len(geometry.taught.base_places)
    arms = geometry.taught.base_places[seen.index] @ move[:3, :3].T
    slopes, by_rig = geometry.rig.derivatives(arms + move[:3, 3])
    across = slopes.transpose(1, 0, 2, 3).reshape(len(arms), 4, 3)
    rig_first = by_rig.transpose(1, 0, 2, 3).reshape(len(arms), 4, RIG)
    taught = np.linalg.solve(across.swapaxes(1, 2) @ across, across.swapaxes(1, 2) @ rig_first)  # where they were seen
    return Rows(
        seen.whitened,
        seen.whiten(np.concatenate([by_rig, slopes @ _small_movement(arms)], axis=-1)),
        seen.whiten(by_rig - slopes @ taught),
        np.zeros((4 * len(arms), 1)),
        _offsets(seen.whiten, seen.index, count),
    )


def stacked(rows: list[Rows], centres: tuple[int, ...]) -> Rows:
    """Rows of several bodies as one; the stickers of all bodies, so many each, have offsets of their own."""
    every, first, before = np.zeros((sum(len(one.residuals) for one in rows), 4 * sum(centres))), 0, 0
    for one, count in zip(rows, centres, strict=False):
        every[first : first + len(one.residuals), 4 * before : 4 * (before + count)] = one.by_offsets
        first, before = first + len(one.residuals), before + count
    parts = {name: np.concatenate([getattr(one, name) for one in rows]) for name in NOT_OFFSETS}
    return Rows(**parts, by_offsets=every)


def _small_movement(arms: Array) -> Array:
    """Derivatives (k, 3, 6) of points by a small movement [dt, dphi] of their body, arms (k, 3) about its origin."""
    return np.concatenate([np.broadcast_to(np.eye(3), (len(arms), 3, 3)), -skew(arms)], axis=2)


def _offsets(rows: Callable[[Array], Array], index: NDArray[np.int_], count: int) -> Array:
    """Derivatives (m, 4 count) by the offsets of all centres of a body, of which those of an index (k,) are seen."""
    seen = rows(np.eye(4 * len(index)).reshape(2, len(index), 2, -1)).reshape(-1, 2, len(index), 2)
    every = np.zeros((len(seen), 2, count, 2))
    every[:, :, index] = seen
    return every.reshape(len(seen), -1)
