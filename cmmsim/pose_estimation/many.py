"""Poses from many exposures at once.

Windows are read, ellipses fitted and stickers triangulated as those of one exposure with all the stickers; poses are
laid onto them together. An exposure in which the stickers do not agree at once is looked at by itself, as the estimator
looks at any.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmmsim.errors import LostError
from cmmsim.geometry.pose import Array, compose_covariance, pose_covariance, poses_of
from cmmsim.pose_estimation.consistency import all_consistent
from cmmsim.pose_estimation.estimator import Measurement, PoseEstimator, lost_measurement
from cmmsim.pose_estimation.observation import ManyExposures, StickerObservation


@dataclass(frozen=True)
class MeasuredPoses:
    """N frames: poses (N,6) m, rad and covariances (N,6,6), NaN where lost; stickers (N,) used, 0 where lost."""

    poses: Array
    covariances: Array
    stickers: NDArray[np.int_]

    @classmethod
    def of(cls, parts: Sequence[MeasuredPoses]) -> MeasuredPoses:
        """All frames of several parts."""
        none = MeasuredPoses(np.zeros((0, 6)), np.zeros((0, 6, 6)), np.zeros(0, dtype=int))
        every = [vars(part).values() for part in (none, *parts)]
        return cls(*(np.concatenate(values) for values in zip(*every, strict=True)))

    @classmethod
    def of_each(cls, found: Sequence[Measurement]) -> MeasuredPoses:
        """Those of single frames."""
        return cls(
            np.array([one.pose for one in found]).reshape(-1, 6),
            np.array([one.covariance for one in found]).reshape(-1, 6, 6),
            np.array([len(one.target_ids) for one in found], dtype=int),
        )

    def without(self, dropped: NDArray[np.bool_]) -> MeasuredPoses:
        """The same frames, of which those that are ``dropped`` (N,) are lost."""
        gone = dropped[:, None]
        return MeasuredPoses(
            np.where(gone, np.nan, self.poses),
            np.where(gone[:, None], np.nan, self.covariances),
            np.where(dropped, 0, self.stickers),
        )


@dataclass(frozen=True)
class ManySeen:
    """N exposures: poses, covariances and numbers of stickers as of ``MeasuredPoses``; observation: the stickers of all
    of them; excess (N,): by which the covariances of stickers grow, NaN where they do not agree at once; others: the
    measurements of these, by their numbers."""

    estimator: PoseEstimator
    found: MeasuredPoses
    observation: StickerObservation
    excess: Array
    others: dict[int, Measurement]

    def measurements(self) -> list[Measurement]:
        """Each exposure's for itself."""
        count = len(self.excess)
        of, sticker = np.divmod(self.observation.index, len(self.estimator.taught.platform_places))
        starts, ids = np.searchsorted(of, np.arange(count + 1)), self.estimator.platform.sticker_ids[sticker]
        return [self.others.get(k) or self._one(k, slice(starts[k], starts[k + 1]), ids) for k in range(count)]

    def _one(self, k: int, own: slice, ids: NDArray[np.str_]) -> Measurement:
        seen, pose = self.observation, self.found.poses[k]
        return Measurement(
            pose,
            self.found.covariances[k],
            seen.points[own],
            self.excess[k] * seen.covariances[own],
            seen.left_pixels[own],
            seen.right_pixels[own],
            ids[own],
            True,
            common_at=self.estimator.common_at,
            pixel_variances=seen.pixel_variances[own],
        )


def measure_exposures(
    estimator: PoseEstimator, images: ManyExposures, expected: Array, swept: tuple[Array, Array]
) -> ManySeen:
    """Measure the platform in each of N exposures near expected camera_from_platform (N,4,4), which go from and to
    those of ``swept`` (N,4,4), as ``PoseEstimator.measure`` does in one."""
    count, stickers = len(expected), len(estimator.taught.platform_places)
    places, normals = estimator.taught.platform_places, estimator.platform.sticker_normals
    seen = estimator.read(images, expected, places, normals).observed(swept)
    if estimator.method == "registration" and len(seen.index):
        result, excess = all_consistent(seen, estimator, estimator.platform, places, count)
        base_from_platform = estimator.taught.base_from_camera @ result.transform
        spread = compose_covariance(estimator.taught.base_from_camera, excess[:, None, None] * result.covariance)
        poses, covariances = poses_of(base_from_platform), pose_covariance(base_from_platform, spread)
    else:
        excess = np.full(count, np.nan)
        poses, covariances = np.full((count, 6), np.nan), np.full((count, 6, 6), np.nan)
    of = seen.index // stickers
    used, others = np.bincount(of, minlength=count), {}
    for k in np.flatnonzero(np.isnan(excess)):
        own = seen.selected(of == k)
        try:
            one = estimator.measured(replace(own, index=own.index % stickers))[0]
        except LostError as error:
            one = lost_measurement(str(error))
        others[int(k)] = one
        poses[k], covariances[k], used[k] = one.pose, one.covariance, len(one.target_ids)
    return ManySeen(estimator, MeasuredPoses(poses, covariances, used), seen, excess, others)
