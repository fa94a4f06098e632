"""A calibration as text: the tables of a sensor file (TOML), and everything as one JSON object."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from cmmsim.calibration.calibration import PARAMETER_NAMES, Calibration
from cmmsim.calibration.sightings import SIDES
from cmmsim.geometry.pose import transform_to_pose


def rig_tables(found: Calibration) -> str:
    """Tables [rig.left], [rig.right] and [rig.right_from_left] of a sensor file."""
    state, lines = found.adjustment.state, []
    for side, values in zip(SIDES, state.intrinsics, strict=True):
        lines += [
            f"[rig.{side}]",
            f"focal_px = {_row(values[:2])}",
            f"centre_px = {_row(values[2:4])}",
            f"distortion = {_row(values[4:])}  # k1, k2, p1, p2, k3",
            "",
        ]
    lines += [
        "[rig.right_from_left]",
        f"translation = {_row(found.rig.right_from_left[:3, 3])}  # m",
        f"rotation_vector = {_row(found.rotation_vector)}  # rad",
    ]
    return "\n".join(lines) + "\n"


def as_dict(found: Calibration) -> dict[str, Any]:
    """Everything of a calibration, ready for JSON: estimates, covariance, residuals, images, board, versions."""
    solved = found.adjustment
    return {
        "opencv": cv2.__version__,
        "board": found.board.model_dump(),
        "image_size_px": [found.rig.left.width, found.rig.left.height],
        "options": {"distortion": found.distortion, "fix_aspect": found.fix_aspect},
        "rms_px": {side: float(np.sqrt(np.mean(r**2))) for side, r in zip(SIDES, solved.residuals, strict=True)},
        "sigma_px": solved.sigma_px,
        "degrees_of_freedom": solved.freedom,
        "condition": solved.condition,
        "shared_errors": {"ratio": solved.shared.ratio, "limit": solved.shared.limit, "factor": solved.shared.factor},
        "parameters": {
            name: {"estimate": float(value), "std": float(std), "free": bool(std > 0.0)}
            for name, value, std in zip(PARAMETER_NAMES, found.values, found.std, strict=True)
        },
        "covariance": {"names": list(PARAMETER_NAMES), "matrix": found.covariance.tolist()},
        "used": [
            {
                "name": view.name,
                "rms_px": view.rms_px,
                "left_from_board_pose": transform_to_pose(solved.state.left_from_boards[view.view]).tolist(),
            }
            for view in found.used
        ],
        "rejected": found.rejected,
        "warnings": found.warnings,
    }


def _row(values: Sequence[float] | np.ndarray) -> str:
    return "[" + ", ".join(repr(float(value)) for value in values) + "]"
