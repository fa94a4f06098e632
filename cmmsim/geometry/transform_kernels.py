"""Compiled kernels for rigid transforms, their poses, and the covariances of both."""

from __future__ import annotations

import math

import numpy as np

from cmmsim.compilation import Array, compiled


@compiled
def pose_transform(pose: Array, transform: Array) -> None:
    """Fill the transform (4,4) of a pose (6,)."""
    ca = math.cos(pose[3])
    sa = math.sin(pose[3])
    cb = math.cos(pose[4])
    sb = math.sin(pose[4])
    cg = math.cos(pose[5])
    sg = math.sin(pose[5])
    transform[0, 0] = cb * cg
    transform[0, 1] = -cb * sg
    transform[0, 2] = sb
    transform[1, 0] = ca * sg + sa * sb * cg
    transform[1, 1] = ca * cg - sa * sb * sg
    transform[1, 2] = -sa * cb
    transform[2, 0] = sa * sg - ca * sb * cg
    transform[2, 1] = sa * cg + ca * sb * sg
    transform[2, 2] = ca * cb
    for i in range(3):
        transform[i, 3] = pose[i]
        transform[3, i] = 0.0
    transform[3, 3] = 1.0


@compiled
def pose_transforms(poses: Array, transforms: Array) -> None:
    """Fill the transforms (n,4,4) of poses (n,6)."""
    for k in range(len(poses)):
        pose_transform(poses[k], transforms[k])


@compiled
def transform_pose(transform: Array, pose: Array) -> None:
    """Fill the pose (6,) of a rigid transform (4,4)."""
    for i in range(3):
        pose[i] = transform[i, 3]
    # The angles follow from the first row and the last column of R = Rx Ry Rz.
    pose[3] = math.atan2(-transform[1, 2], transform[2, 2])
    pose[4] = math.atan2(transform[0, 2], math.hypot(transform[1, 2], transform[2, 2]))
    pose[5] = math.atan2(-transform[0, 1], transform[0, 0])


@compiled
def transform_poses(transforms: Array, poses: Array) -> None:
    """Fill the poses (n,6) of rigid transforms (n,4,4)."""
    for k in range(len(poses)):
        transform_pose(transforms[k], poses[k])


@compiled
def multiply(first: Array, second: Array, product: Array) -> None:
    """Fill the product of two transforms (4,4)."""
    for i in range(4):
        a = first[i, 0]
        b = first[i, 1]
        c = first[i, 2]
        d = first[i, 3]
        for j in range(4):
            product[i, j] = (
                a * second[0, j] + b * second[1, j] + c * second[2, j] + d * second[3, j]
            )


@compiled
def transform_point(move: Array, point: Array, shift: float, transformed: Array) -> None:
    """Fill ``transformed`` (3,) with a point (3,) transformed by a transform (4, 4).

    ``shift`` is 1 for a point, and 0 for a direction, which is only rotated.
    """
    x = point[0]
    y = point[1]
    z = point[2]
    for i in range(3):
        transformed[i] = shift * move[i, 3] + move[i, 0] * x + move[i, 1] * y + move[i, 2] * z


@compiled
def move_by(transform: Array, change: Array) -> None:
    """Change a transform (4, 4) in place by ``change`` (6,), a small error [dt, dphi]."""
    turn = change[3:]
    angle = math.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    # Rodrigues' formula, with its limits for small angles.
    first = math.sin(angle) / angle if angle > 1e-9 else 1.0
    second = 0.5 * (math.sin(0.5 * angle) / (0.5 * angle)) ** 2 if angle > 1e-9 else 0.5
    for j in range(3):
        x = turn[1] * transform[2, j] - turn[2] * transform[1, j]
        y = turn[2] * transform[0, j] - turn[0] * transform[2, j]
        z = turn[0] * transform[1, j] - turn[1] * transform[0, j]
        transform[0, j] += first * x + second * (turn[1] * z - turn[2] * y)
        transform[1, j] += first * y + second * (turn[2] * x - turn[0] * z)
        transform[2, j] += first * z + second * (turn[0] * y - turn[1] * x)
    for i in range(3):
        transform[i, 3] += change[i]


@compiled
def make_rigid(transform: Array) -> None:
    """Replace the rotation of a transform (4,4) by the nearest orthogonal matrix.

    Four steps R (3 I - R'R) / 2 of Newton's method converge quadratically. The replacement is
    needed in a chain of transforms, each computed from those before by products, because the error
    of the rotation doubles with each.
    """
    square = np.empty((3, 3))
    row = np.empty(3)
    for _ in range(4):
        for i in range(3):
            for j in range(3):
                square[i, j] = 3.0 if i == j else 0.0
                for k in range(3):
                    square[i, j] -= transform[k, i] * transform[k, j]
        for i in range(3):
            for j in range(3):
                row[j] = transform[i, j]
            for j in range(3):
                transform[i, j] = 0.5 * (
                    row[0] * square[0, j] + row[1] * square[1, j] + row[2] * square[2, j]
                )


@compiled
def farthest_from_rigid(transforms: Array) -> float:
    """Return the largest deviation of transforms (k, 4, 4) from rigid transforms.

    The entries of R'R are compared with the unit matrix, and the last rows with [0 0 0 1]. The
    result is infinite if an entry is not finite, or the determinant of a rotation is not positive.
    """
    farthest = 0.0
    for k in range(len(transforms)):
        t = transforms[k]
        for i in range(4):
            for j in range(i + 1):
                expected = 1.0 if i == j else 0.0
                product = t[0, i] * t[0, j] + t[1, i] * t[1, j] + t[2, i] * t[2, j]
                deviation = abs(t[3, j] - expected) if i == 3 else abs(product - expected)
                if not (deviation < np.inf and abs(t[j, 3]) < np.inf):
                    return np.inf
                farthest = max(farthest, deviation)
        determinant = (
            t[0, 0] * (t[1, 1] * t[2, 2] - t[1, 2] * t[2, 1])
            + t[0, 1] * (t[1, 2] * t[2, 0] - t[1, 0] * t[2, 2])
            + t[0, 2] * (t[1, 0] * t[2, 1] - t[1, 1] * t[2, 0])
        )
        if not determinant > 0.0:
            return np.inf
    return farthest


@compiled
def angle_rates(pose: Array, rates: Array) -> None:
    """Fill the derivatives (3, 3) of a pose's angles with respect to a small rotation vector.

    The rotation vector is in the axes of the output frame.
    """
    ca = math.cos(pose[3])
    sa = math.sin(pose[3])
    cb = math.cos(pose[4])
    sb = math.sin(pose[4])
    rates[0, 0] = 1.0
    # inverse of the matrix of eq. 2, which does not exist at beta = pi/2 and -pi/2
    rates[0, 1] = sa * sb / cb
    rates[0, 2] = -ca * sb / cb
    rates[1, 0] = 0.0
    rates[1, 1] = ca
    rates[1, 2] = sa
    rates[2, 0] = 0.0
    rates[2, 1] = -sa / cb
    rates[2, 2] = ca / cb


@compiled
def all_angle_rates(poses: Array, rates: Array) -> None:
    """Fill ``angle_rates`` (n,3,3) of poses (n,6)."""
    for k in range(len(poses)):
        angle_rates(poses[k], rates[k])


@compiled
def pose_covariance(pose: Array, turn: Array, covariance: Array, spread: Array) -> None:
    """Fill ``spread`` (6, 6), the covariance of a pose (6,), from that of a small error [dt, dphi].

    ``covariance`` (6, 6) is that of the small error, which may be in other axes than the pose.
    ``turn`` (3, 3) rotates these axes to those of the pose.
    """
    rates = np.empty((3, 3))
    derivatives = np.empty((6, 3))  # derivatives d(position)/d(dt), then d(angles)/d(dphi)
    half = np.empty((6, 6))
    angle_rates(pose, rates)
    for i in range(3):
        for j in range(3):
            derivatives[i, j] = turn[i, j]
            derivatives[3 + i, j] = (
                rates[i, 0] * turn[0, j] + rates[i, 1] * turn[1, j] + rates[i, 2] * turn[2, j]
            )
    for i in range(6):
        first = 0 if i < 3 else 3
        for j in range(6):
            half[i, j] = (
                derivatives[i, 0] * covariance[first, j]
                + derivatives[i, 1] * covariance[first + 1, j]
                + derivatives[i, 2] * covariance[first + 2, j]
            )
    for i in range(6):
        for j in range(6):
            first = 0 if j < 3 else 3
            spread[i, j] = (
                half[i, first] * derivatives[j, 0]
                + half[i, first + 1] * derivatives[j, 1]
                + half[i, first + 2] * derivatives[j, 2]
            )


@compiled
def pose_covariances(poses: Array, covariances: Array, spreads: Array) -> None:
    """Fill the covariances (n, 6, 6) of poses (n, 6) from those of their transforms' errors."""
    turn = np.eye(3)
    for k in range(len(poses)):
        pose_covariance(poses[k], turn, covariances[k], spreads[k])
