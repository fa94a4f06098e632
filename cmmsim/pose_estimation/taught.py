"""What teaching found: the place of the base in the camera frame, and the stickers' places on the platform."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cmmsim.errors import ShapeError
from cmmsim.geometry.pose import Array, compose_covariance, pose_covariance, pose_to_transform, skew


@dataclass(frozen=True)
class Taught:
    """Result of teaching one sensor; plain arrays, so that it can be sent to another process.

    sensor_name; base_from_camera (4,4) and base_covariance (6,6) of its small error [dt, dphi]; platform_places (n,3)
    sticker coordinates in platform axes, m, and place_covariances (n,3,3); platform_covariance (6,6): error of the
    platform frame itself, in platform axes; base_places (k,3) sticker coordinates in base axes, m. setup: what of the
    sensor file this holds for, see :mod:`cmmsim.taught_setup`; empty for one put together by hand.
    """

    sensor_name: str
    base_from_camera: Array
    base_covariance: Array
    platform_places: Array
    place_covariances: Array
    platform_covariance: Array
    base_places: Array
    setup: str = ""

    def __post_init__(self) -> None:
        stickers, base_stickers = len(self.platform_places), len(self.base_places)
        shapes = {
            "base_from_camera": (4, 4),
            "base_covariance": (6, 6),
            "platform_places": (stickers, 3),
            "place_covariances": (stickers, 3, 3),
            "platform_covariance": (6, 6),
            "base_places": (base_stickers, 3),
        }
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ShapeError(f"taught {name} must have the shape {shape}, got {getattr(self, name).shape}")
        for name in self.__dataclass_fields__:
            if isinstance(value := getattr(self, name), np.ndarray):
                value.setflags(write=False)

    def calibration_covariance(self, pose: Array) -> Array:
        """Covariance (6,6) of the part of the pose error that teaching left; the same in every frame."""
        base_from_platform = pose_to_transform(pose)
        lever = np.eye(6)
        lever[:3, 3:] = -skew(base_from_platform[:3, 3])
        total = lever @ self.base_covariance @ lever.T
        total += compose_covariance(base_from_platform, self.platform_covariance)
        return pose_covariance(base_from_platform, total)
