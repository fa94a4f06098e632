"""Measurement of a stereo frame: a pose with its covariance, or the reason why the frame is lost.

A second class contains the poses of many frames.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cmmsim.errors import ShapeError
from cmmsim.geometry.pose import Array


def _nothing_in_common(pose: Array) -> Array:
    """Return a zero common covariance (6, 6), or NaN if the pose (6,) is NaN."""
    return np.full((6, 6), 0.0 if np.isfinite(pose).all() else np.nan)


@dataclass(frozen=True)
class Measurement:
    """Pose of the platform in the base frame, with the stickers from which it was computed.

    The error of a pose has two parts, which are stated separately. The noise is new in every frame.
    The common part comes from errors of the known rig and of the taught frames. It is the same in
    every frame, so a mean over frames does not reduce it. The mean of N frames at one pose has the
    covariance covariance / N + common_covariance. ``Sensor.common_errors`` relates the common parts
    of different poses.

    Attributes
    ----------
    pose : ndarray, shape (6,)
        Pose in m and rad; NaN if the frame is lost.
    covariance : ndarray, shape (6, 6)
        Covariance of the noise; NaN if the frame is lost.
    points, point_covariances : ndarray, shapes (n, 3) and (n, 3, 3)
        Places of the stickers in the camera frame, m, and their covariances.
    left_pixels, right_pixels : ndarray, shape (n, 2)
        Sticker centres in the distorted images, px, corrected for eccentricity.
    target_ids : ndarray of str, shape (n,)
        Names of the stickers, such as "A1".
    ok : bool
        False if the frame is lost.
    reason : str
        Reason why the frame is lost; empty otherwise.
    common_at : callable
        Function that returns the common covariance (6, 6) at a pose (6,).
    pixel_variances : ndarray, shape (n,)
        Variance of each sticker's pixel coordinates, px², mean over both images and axes.

    Raises
    ------
    ShapeError
        If pose or covariance has a wrong shape, or if ``ok``, ``reason`` and the finite or NaN pose
        contradict each other.

    Examples
    --------
    >>> lost_measurement("2 visible stickers")
    Measurement(lost: 2 visible stickers)
    """

    pose: Array
    covariance: Array
    points: Array
    point_covariances: Array
    left_pixels: Array
    right_pixels: Array
    target_ids: NDArray[np.str_]
    ok: bool
    reason: str = ""
    common_at: Callable[[Array], Array] = _nothing_in_common
    pixel_variances: Array = field(default_factory=lambda: np.zeros(0))

    @cached_property
    def common_covariance(self) -> Array:
        """Covariance (6, 6) of the common part; NaN if it is not known.

        With the method "planes", it is known only if the rig is known exactly. The covariance is
        computed on first use, because its computation takes longer than a measurement.
        """
        return self.common_at(self.pose)

    @property
    def single_covariance(self) -> Array:
        """Covariance (6, 6) of the whole error of this pose: noise and common part."""
        return self.covariance + self.common_covariance

    def __post_init__(self) -> None:
        if self.pose.shape != (6,) or self.covariance.shape != (6, 6):
            raise ShapeError(
                f"pose (6,) and covariance (6,6) expected, got {self.pose.shape}, "
                f"{self.covariance.shape}"
            )
        finite = bool(np.isfinite(self.pose).all() and np.isfinite(self.covariance).all())
        if self.ok != finite or self.ok == bool(self.reason):
            raise ShapeError(
                f"a measurement is either ok and finite or lost for a reason, got ok={self.ok}, "
                f"finite={finite}, reason={self.reason!r}"
            )

    def __repr__(self) -> str:
        if not self.ok:
            return f"Measurement(lost: {self.reason})"
        place = ", ".join(f"{value:.6f}" for value in self.pose)
        spread = f"{_shown(self.covariance)} by noise"
        if self.common_covariance.any():
            spread += f", {_shown(self.common_covariance)} in common"
        return f"Measurement(pose [{place}] m, rad to {spread}, {len(self.target_ids)} stickers)"


def _shown(covariance: Array) -> str:
    """Show the standard deviations of position and orientation as text."""
    shift, turn = (np.sqrt(np.trace(covariance[k : k + 3, k : k + 3])) for k in (0, 3))
    return f"{1e6 * shift:.2g} um and {1e6 * turn:.2g} urad"


def lost_measurement(reason: str) -> Measurement:
    """Return the measurement of a lost frame, with the reason."""
    return measurement_without_stickers(np.full(6, np.nan), np.full((6, 6), np.nan), reason)


def measurement_without_stickers(pose: Array, covariance: Array, reason: str = "") -> Measurement:
    """Return a measurement with a pose (6,) and its covariance (6, 6), but without stickers.

    If the pose is NaN, ``reason`` states why the frame is lost.
    """
    points = np.zeros((0, 3))
    covariances = np.zeros((0, 3, 3))
    pixels = np.zeros((0, 2))
    names = np.array([], dtype=str)
    return Measurement(
        pose, covariance, points, covariances, pixels, pixels, names, not reason, reason
    )


@dataclass(frozen=True)
class MeasuredPoses:
    """Poses of N frames, m and rad.

    Attributes
    ----------
    poses : ndarray, shape (N, 6)
        Poses; NaN in lost frames.
    covariances : ndarray, shape (N, 6, 6)
        Covariances of the poses; NaN in lost frames.
    stickers : ndarray, shape (N,)
        Number of stickers used; 0 in lost frames.
    """

    poses: Array
    covariances: Array
    stickers: NDArray[np.int_]

    @classmethod
    def of(cls, parts: Sequence[MeasuredPoses]) -> MeasuredPoses:
        """Join the frames of several parts."""
        none = MeasuredPoses(np.zeros((0, 6)), np.zeros((0, 6, 6)), np.zeros(0, dtype=int))
        every = [vars(part).values() for part in (none, *parts)]
        return cls(*(np.concatenate(values) for values in zip(*every, strict=True)))

    @classmethod
    def of_each(cls, measurements: Sequence[Measurement]) -> MeasuredPoses:
        """Collect the poses of single frames."""
        return cls(
            np.array([frame.pose for frame in measurements]).reshape(-1, 6),
            np.array([frame.covariance for frame in measurements]).reshape(-1, 6, 6),
            np.array([len(frame.target_ids) for frame in measurements], dtype=int),
        )

    def without(self, dropped: NDArray[np.bool_]) -> MeasuredPoses:
        """Return the same frames, except that the frames marked in ``dropped`` (N,) are lost."""
        lost = dropped[:, None]
        return MeasuredPoses(
            np.where(lost, np.nan, self.poses),
            np.where(lost[:, None], np.nan, self.covariances),
            np.where(dropped, 0, self.stickers),
        )
