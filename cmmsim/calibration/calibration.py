"""The result of a calibration."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from cmmsim.calibration.board import Board
from cmmsim.calibration.intrinsics import INTRINSIC_NAMES
from cmmsim.calibration.joint_adjustment import Adjustment
from cmmsim.calibration.sightings import Sightings
from cmmsim.geometry.pose import Array, skew
from cmmsim.geometry.stereo_rig import StereoRig

PLACE_NAMES = ("tx_m", "ty_m", "tz_m", "rx_rad", "ry_rad", "rz_rad")
PARAMETER_NAMES = (
    *(f"{side}.{name}" for side in ("left", "right") for name in INTRINSIC_NAMES),
    *(f"right_from_left.{name}" for name in PLACE_NAMES),
)


@dataclass(frozen=True)
class UsedView:
    """name of the pair; its place in left_from_boards; root mean square residual in px of each image that was used."""

    name: str
    view: int
    rms_px: dict[str, float]


@dataclass(frozen=True)
class Calibration:
    """Both cameras with their covariance, and all that it rests on.

    rig; board; distortion and fix_aspect as chosen; adjustment; sightings as adjusted (dots without eccentricity); used
    pairs; rejected: pair name -> reason, also for pairs of which one image is used; warnings, one line each.
    """

    rig: StereoRig
    board: Board
    distortion: str
    fix_aspect: bool
    adjustment: Adjustment
    sightings: tuple[Sightings, Sightings]
    used: list[UsedView]
    rejected: dict[str, str]
    warnings: list[str]

    @property
    def rotation_vector(self) -> Array:
        """Rotation vector (3,) of right_from_left, rad."""
        return np.asarray(cv2.Rodrigues(self.rig.right_from_left[:3, :3])[0], dtype=float).ravel()

    @property
    def values(self) -> Array:
        """Estimates (24,) in the order of PARAMETER_NAMES."""
        shift = self.rig.right_from_left[:3, 3]
        return np.concatenate([*self.adjustment.state.intrinsics, shift, self.rotation_vector])

    @property
    def covariance(self) -> Array:
        """Covariance (24,24) in the order of PARAMETER_NAMES; rows of what was not free are zero."""
        spread = np.eye(len(PARAMETER_NAMES))
        spread[-3:, -3:] = _inverse_left_jacobian(self.rotation_vector)
        return np.asarray(spread @ self.adjustment.covariance @ spread.T)

    @property
    def std(self) -> Array:
        """Standard deviations (24,)."""
        return np.sqrt(np.diag(self.covariance))


def _inverse_left_jacobian(vector: Array) -> Array:
    """Change (3,3) of a rotation vector (3,) by a small turn applied on the left (Sola et al. 2018, eq. 146)."""
    angle = float(np.linalg.norm(vector))
    k = skew(vector)
    if angle < 1e-4:
        return np.eye(3) - 0.5 * k + k @ k / 12.0
    return np.eye(3) - 0.5 * k + (1.0 / angle**2 - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle))) * k @ k
