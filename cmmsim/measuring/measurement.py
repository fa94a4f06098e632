"""Measurement of one stereo frame: a pose with its covariance, or the reason why it was lost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cmmsim.errors import ShapeError
from cmmsim.geometry.pose import Array


def _nothing_in_common(pose: Array) -> Array:
    """Covariance (6,6) that a pose (6,) has in common with others: none, or not known where it is
    lost.
    """
    return np.full((6, 6), 0.0 if np.isfinite(pose).all() else np.nan)


@dataclass(frozen=True)
class Measurement:
    """Pose of the platform in the base frame, and what it was made from.

    Its error has two parts. covariance (6,6) of pose (6,), m and rad, is that of the noise, new in
    every frame. common_covariance (6,6) is that of what is not known of rig and taught frames: one
    draw, the same in every frame, so that no mean over frames makes it smaller; NaN where it is not
    known (poses by planes with a rig that is not exact). They are never added in silence: the mean
    of N frames errs by covariance / N + common_covariance, a single one by ``single_covariance``.
    ``Sensor.common_errors`` says how the common part of one pose goes with that of another.

    points (n,3) and point_covariances (n,3,3) in the camera frame, m; left_pixels and right_pixels
    (n,2) sticker centres in the images as they are, distorted, and pixel_variances (n,) of a
    coordinate, px²; target_ids (n,) such as "A1"; common_at: what gives the common part at a pose
    (6,). When nothing could be measured ok is False, reason says why, and pose and covariances are
    NaN.
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
        """Covariance (6,6) of the common part; found when it is asked for, which takes longer than
        to measure.
        """
        return self.common_at(self.pose)

    @property
    def single_covariance(self) -> Array:
        """Covariance (6,6) of this pose alone against the true one: noise and common part
        together."""
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
    """Standard deviations of place and turn in words."""
    shift, turn = (np.sqrt(np.trace(covariance[k : k + 3, k : k + 3])) for k in (0, 3))
    return f"{1e6 * shift:.2g} um and {1e6 * turn:.2g} urad"


def lost_measurement(reason: str) -> Measurement:
    """A measurement that holds no pose, and says why."""
    return measurement_without_stickers(np.full(6, np.nan), np.full((6, 6), np.nan), reason)


def measurement_without_stickers(pose: Array, covariance: Array, reason: str = "") -> Measurement:
    """A pose (6,) and its covariance (6,6) that no sticker stands behind; the reason why there is
    none where NaN.
    """
    points = np.zeros((0, 3))
    covariances = np.zeros((0, 3, 3))
    pixels = np.zeros((0, 2))
    names = np.array([], dtype=str)
    return Measurement(
        pose, covariance, points, covariances, pixels, pixels, names, not reason, reason
    )
