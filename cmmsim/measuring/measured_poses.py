"""Poses from many exposures at once.

Windows are read, ellipses fitted and stickers triangulated as those of one exposure with all the
stickers; each exposure is then solved for itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.pose import Array
from cmmsim.measuring.frame_solver import SolvedFrames, solve_frames
from cmmsim.measuring.measurement import Measurement
from cmmsim.measuring.observation import ManyExposures
from cmmsim.measuring.pose_estimator import PoseEstimator


@dataclass(frozen=True)
class MeasuredPoses:
    """N frames: poses (N,6) m, rad and covariances (N,6,6), NaN where lost; stickers (N,) used, 0
    where lost.
    """

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
        """Collect the poses of single frames."""
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
    """N exposures, measured together: their poses, and the measurement of each.

    ``solved`` holds the stickers of all of them. ``others`` are the measurements, by number, of
    exposures that are lost, or whose poses are made by another method than registration.
    """

    estimator: PoseEstimator
    found: MeasuredPoses
    solved: SolvedFrames
    others: dict[int, Measurement]

    def measurements(self) -> list[Measurement]:
        """The measurement of each exposure."""
        return [self.others.get(k) or self._one(k) for k in range(len(self.found.poses))]

    def _one(self, k: int) -> Measurement:
        pose = self.found.poses[k]
        return self.estimator.measurement(pose, self.found.covariances[k], self.solved.of(k))


def measure_exposures(
    estimator: PoseEstimator, images: ManyExposures, expected: Array, swept: tuple[Array, Array]
) -> ManySeen:
    """Measure the platform in each of N exposures near expected camera_from_platform (N,4,4).

    ``swept`` (N,4,4) are the expected ones at the beginning and at the end of the exposures. Each
    is measured as ``PoseEstimator.measure`` does.
    """
    places = estimator.taught.platform_places
    normals = estimator.platform.sticker_normals
    seen = estimator.read(images, expected, places, normals).observed(swept)
    solved = solve_frames(seen, expected, estimator, estimator.platform, places)
    poses, covariances = estimator.in_base(solved.moves, solved.covariances)
    of = seen.index // len(places)
    used = np.bincount(of[solved.used], minlength=len(expected))
    others = {}
    for k in np.flatnonzero(solved.lost | (estimator.method != "registration")):
        one = estimator.measurement_of(solved, int(k))
        others[int(k)] = one
        poses[k] = one.pose
        covariances[k] = one.covariance
        used[k] = len(one.target_ids)
    return ManySeen(estimator, MeasuredPoses(poses, covariances, used), solved, others)
