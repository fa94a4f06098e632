"""The result of measuring one stereo frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmmsim.errors import ShapeError
from cmmsim.geometry.pose import Array


@dataclass(frozen=True)
class Measurement:
    """Pose of the platform in the base frame, and what it was made from.

    pose (6,) m, rad and covariance (6,6): observation noise only, the error of teaching is the same in every frame
    and stands in ``Taught.calibration_covariance``. points (n,3) and point_covariances (n,3,3) in the camera frame, m;
    left_pixels and right_pixels (n,2) sticker centres in the images as they are, distorted; target_ids (n,) such as
    "A1". When nothing could be measured ok is False, reason says why, and pose and covariance are NaN.
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

    def __post_init__(self) -> None:
        if self.pose.shape != (6,) or self.covariance.shape != (6, 6):
            raise ShapeError(f"pose (6,) and covariance (6,6) expected, got {self.pose.shape}, {self.covariance.shape}")
        finite = bool(np.isfinite(self.pose).all() and np.isfinite(self.covariance).all())
        if self.ok != finite or self.ok == bool(self.reason):
            raise ShapeError(
                f"a measurement is either ok and finite or lost for a reason, got ok={self.ok}, "
                f"finite={finite}, reason={self.reason!r}"
            )


def lost_measurement(reason: str) -> Measurement:
    """A measurement that holds no pose, and says why."""
    return Measurement(
        np.full(6, np.nan),
        np.full((6, 6), np.nan),
        np.zeros((0, 3)),
        np.zeros((0, 3, 3)),
        np.zeros((0, 2)),
        np.zeros((0, 2)),
        np.array([], dtype=str),
        False,
        reason,
    )
