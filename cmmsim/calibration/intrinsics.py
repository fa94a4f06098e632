"""The numbers that describe one camera, and which of them a calibration sets free.

Order: focal lengths fx, fy and principal point cx, cy in px, then k1, k2, p1, p2, k3 of Brown and Conrady as OpenCV
orders them.
"""

from __future__ import annotations

import cv2
import numpy as np

from cmmsim.errors import UnknownOptionError
from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.distortion import Distortion
from cmmsim.geometry.pose import Array

INTRINSIC_NAMES = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3")
DISTORTIONS = {"none": (), "radial2": ("k1", "k2"), "brown5": ("k1", "k2", "p1", "p2", "k3")}
DEFAULT_DISTORTION = "brown5"


def free_directions(distortion: str, fix_aspect: bool) -> Array:
    """Matrix (9, k) from the k free numbers of a camera to all nine.

    distortion: which terms are free, a key of DISTORTIONS; fix_aspect: fx = fy. Raises UnknownOptionError.
    """
    if distortion not in DISTORTIONS:
        raise UnknownOptionError("distortion", distortion, DISTORTIONS)
    free = np.eye(len(INTRINSIC_NAMES))[
        :, [k for k, name in enumerate(INTRINSIC_NAMES) if name.endswith("_px") or name in DISTORTIONS[distortion]]
    ]
    if fix_aspect:
        free[:, 0] += free[:, 1]
        free = np.delete(free, 1, axis=1)
    return free


def camera_from(values: Array, width: int, height: int) -> PinholeCamera:
    """The camera of nine intrinsics (9,)."""
    fx, fy, cx, cy, *terms = (float(value) for value in values)
    return PinholeCamera(fx, cx, cy, width, height, aspect=fy / fx, distortion=Distortion(*terms))


def project(values: Array, points: Array) -> tuple[Array, Array, Array]:
    """Pixels (n, 2) of points (n, 3) in camera axes, and their derivatives by the intrinsics (n, 2, 9) and by the
    points (n, 2, 3), px/m. The points must lie before the camera."""
    matrix = np.array([[values[0], 0.0, values[2]], [0.0, values[1], values[3]], [0.0, 0.0, 1.0]])
    pixels, jacobian = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, values[4:])
    by_all = np.asarray(jacobian, dtype=float).reshape(len(points), 2, -1)  # turn 3, shift 3, f 2, c 2, distortion 5
    return np.asarray(pixels, dtype=float).reshape(-1, 2), by_all[:, :, 6:15], by_all[:, :, 3:6]
