"""Compiled test for a slip: one plane of stickers has moved relative to the others.

The stickers of a plane are fixed to one part of the body. If this part slips, all its stickers move
by the same vector. The fitted pose follows them in part, so most of a small slip is an error of the
pose, and single stickers hardly contradict the others. The vector is therefore fitted together with
the pose, for one plane after another.

The images do not show which has slipped, the plane or the rest of the body. Both are equally
likely. The vector gives the pose for each case.
"""

from __future__ import annotations

import numpy as np

from cmmsim.compilation import Array, compiled
from cmmsim.geometry.matrix_kernels import factorise, invert_factored

PLANES = 3  # number of planes of a body's stickers
# Inverse square of the largest slip, m^-2. It keeps the matrices regular if the stickers do not
# determine the slip of a plane. A larger slip is seen in single stickers.
KNOWN_SLIP = 1e6


@compiled
def largest_slip(
    used: Array, planes: Array, arms: Array, gaps: Array, informations: Array, covariance: Array,
    spread: Array,
) -> float:  # fmt: skip
    """Return the largest squared slip of a plane, in units of its noise.

    The used stickers lie on ``planes`` (n,), numbered from 0. Their arms and gaps (n, 3) and
    inverse covariances ``informations`` (n, 3, 3) are those of ``ObservedStickers``. ``covariance``
    (6, 6) is that of the fitted pose. Noise alone gives a chi-square number with three degrees of
    freedom for each plane. ``spread`` (6, 6) is filled with the mean square of the pose error that
    this slip causes, as a mean over both cases.
    """
    largest = -1.0
    inverse = np.empty((3, 3))
    for plane in range(PLANES):
        information = KNOWN_SLIP * np.eye(3)
        cross_information = np.zeros((6, 3))
        right = np.zeros(3)
        for n in range(len(used)):
            if not used[n] or planes[n] != plane:
                continue
            x, y, z = arms[n]
            for j in range(3):
                by_x, by_y, by_z = informations[n, j]
                information[j] += informations[n, j]
                right[j] += by_x * gaps[n, 0] + by_y * gaps[n, 1] + by_z * gaps[n, 2]
                cross_information[0, j] += by_x
                cross_information[1, j] += by_y
                cross_information[2, j] += by_z
                cross_information[3, j] += y * by_z - z * by_y
                cross_information[4, j] += z * by_x - x * by_z
                cross_information[5, j] += x * by_y - y * by_x
        # The fitted pose absorbs a part of the slip.
        pose_by_slip = covariance @ cross_information
        information -= cross_information.T @ pose_by_slip
        factorise(information)
        invert_factored(information, inverse)
        slip = inverse @ right
        size = float(right @ slip)
        if size > largest:
            largest = size
            mean_square = inverse + np.outer(slip, slip)
            spread[:] = 0.5 * (pose_by_slip @ mean_square @ pose_by_slip.T)
            # If the rest has slipped, the pose that belongs to the plane is right.
            for i in range(3):
                pose_by_slip[i, i] -= 1.0
            spread += 0.5 * (pose_by_slip @ mean_square @ pose_by_slip.T)
    return largest
