"""What the adjustment estimates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cmmsim.geometry.pose import Array, rotation_exp


@dataclass(frozen=True)
class RigState:
    """intrinsics (2,9) of the left and right camera, right_from_left (4,4), left_from_boards (v,4,4) of the views."""

    intrinsics: Array
    right_from_left: Array
    left_from_boards: Array

    @property
    def largest_tilt(self) -> float:
        """Largest angle between the normals of any two boards, rad."""
        normals = self.left_from_boards[:, :3, 2]
        return float(np.arccos(np.clip((normals @ normals.T).min(), -1.0, 1.0)))

    def moved(self, intrinsics: Array, right: Array, boards: Array) -> RigState:
        """The state after changes of the intrinsics (2,9), and small errors [dt, dphi] of right_from_left (6,) and of
        the boards (v,6)."""
        return RigState(
            self.intrinsics + intrinsics,
            _moved(self.right_from_left, right),
            np.stack([_moved(b, change) for b, change in zip(self.left_from_boards, boards, strict=True)]),
        )


def _moved(transform: Array, change: Array) -> Array:
    moved = transform.copy()
    moved[:3, 3] += change[:3]
    moved[:3, :3] = rotation_exp(change[3:]) @ transform[:3, :3]
    return moved
