"""Compiled: Gauss-Newton steps of points seen by two cameras and of rigid fits, on small systems of equations."""

from __future__ import annotations

import math

import numpy as np

from cmmsim.compiled import Array, compiled

SMALLEST_PIVOT = 1e-300


@compiled
def factor(matrix: Array) -> None:
    """Cholesky factor of a symmetric matrix (n,n), in its lower triangle."""
    for j in range(len(matrix)):
        for i in range(j, len(matrix)):
            rest = matrix[i, j]
            for k in range(j):
                rest -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = math.sqrt(max(rest, SMALLEST_PIVOT)) if i == j else rest / matrix[j, j]


@compiled
def solve_factored(lower: Array, right: Array) -> None:
    """Solve L L' x = right (n,) in place."""
    n = len(right)
    for i in range(n):
        for k in range(i):
            right[i] -= lower[i, k] * right[k]
        right[i] /= lower[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            right[i] -= lower[k, i] * right[k]
        right[i] /= lower[i, i]


@compiled
def invert_factored(lower: Array, inverse: Array) -> None:
    """Fill ``inverse``, the leading (m,m) part of the inverse of L L': K' K with the inverse K of L."""
    n, m = len(lower), len(inverse)
    root = np.empty((n, m))
    for k in range(m):
        for i in range(k, n):
            rest = 1.0 if i == k else 0.0
            for j in range(k, i):
                rest -= lower[i, j] * root[j, k]
            root[i, k] = rest / lower[i, i]
        for i in range(k + 1):
            total = 0.0
            for j in range(k, n):
                total += root[j, i] * root[j, k]
            inverse[i, k] = inverse[k, i] = total


@compiled
def project_point(projection: Array, point: Array, pixel: Array, jacobian: Array) -> None:
    """Pixel (2,) of a point (3,) by a projection matrix (3,4), and its derivative (2,3) by the point."""
    depth = projection[2, 3]
    for i in range(3):
        depth += projection[2, i] * point[i]
    for k in range(2):
        pixel[k] = projection[k, 3]
        for i in range(3):
            pixel[k] += projection[k, i] * point[i]
        pixel[k] /= depth
        for i in range(3):
            jacobian[k, i] = (projection[k, i] - pixel[k] * projection[2, i]) / depth


@compiled
def add_weighted(jacobian: Array, weight: Array, residual: Array, normal: Array, right: Array) -> float:
    """Add J' W J to ``normal`` and J' W r to ``right``; returns r' W r."""
    rows, columns = jacobian.shape
    squared = 0.0
    for k in range(rows):
        for m in range(rows):
            squared += residual[k] * weight[k, m] * residual[m]
            for i in range(columns):
                weighted = jacobian[k, i] * weight[k, m]
                right[i] += weighted * residual[m]
                for j in range(columns):
                    normal[i, j] += weighted * jacobian[m, j]
    return squared


@compiled
def refine_points(
    projections: Array, observed: Array, weights: Array, steps: int, points: Array, covariances: Array, gaps: Array
) -> None:
    """Move n points to where they explain their pixels best.

    projections (c,3,4); observed (n,c,2) px; weights (n,c,2,2), inverse covariances; points (n,3) from start to result;
    fills covariances (n,3,3) and gaps (n,): the squared residual in units of its noise.
    """
    pixel, residual, jacobian = np.empty(2), np.empty(2), np.empty((2, 3))
    normal, right = np.empty((3, 3)), np.empty(3)
    for n in range(len(points)):
        for step in range(steps + 1):
            normal[:], right[:], gaps[n] = 0.0, 0.0, 0.0
            for c in range(len(projections)):
                project_point(projections[c], points[n], pixel, jacobian)
                for k in range(2):
                    residual[k] = observed[n, c, k] - pixel[k]
                gaps[n] += add_weighted(jacobian, weights[n, c], residual, normal, right)
            if step < steps:
                factor(normal)
                invert_factored(normal, covariances[n])
                solve_factored(normal, right)
                for i in range(3):
                    points[n, i] += right[i]


@compiled
def rigid_step(
    source: Array, target: Array, weights: Array, transform: Array, covariance: Array, change: Array
) -> None:
    """One step of the rigid fit target = transform(source): ``change`` (6,) is [dt, dphi], ``covariance`` (6,6) its
    covariance.

    source and target (n,3) m; weights (n,3,3), inverse covariances of the target; transform (4,4).
    """
    normal, jacobian, turned, residual = np.zeros((6, 6)), np.zeros((3, 6)), np.empty(3), np.empty(3)
    change[:] = 0.0
    for n in range(len(source)):
        for i in range(3):
            turned[i] = 0.0
            for j in range(3):
                turned[i] += transform[i, j] * source[n, j]
            residual[i] = target[n, i] - turned[i] - transform[i, 3]
            jacobian[i, i] = 1.0
        jacobian[0, 4], jacobian[0, 5], jacobian[1, 5] = turned[2], -turned[1], turned[0]
        jacobian[1, 3], jacobian[2, 3], jacobian[2, 4] = -turned[2], turned[1], -turned[0]
        add_weighted(jacobian, weights[n], residual, normal, change)
    factor(normal)
    invert_factored(normal, covariance)
    solve_factored(normal, change)


@compiled
def move_by(transform: Array, change: Array) -> None:
    """Move a transform (4,4) by ``change`` (6,) [dt, dphi], in the axes of its output."""
    turn = change[3:]
    angle = math.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
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
def farthest_from_rigid(transforms: Array) -> float:
    """How far entries of R'R of the rotations R of transforms (k,4,4), and of their last rows, are from those of rigid
    ones, at most; infinite where one is not finite, or mirrors."""
    farthest = 0.0
    for k in range(len(transforms)):
        t = transforms[k]
        for i in range(4):
            for j in range(i + 1):
                wanted = 1.0 if i == j else 0.0
                product = t[0, i] * t[0, j] + t[1, i] * t[1, j] + t[2, i] * t[2, j]
                off = abs(t[3, j] - wanted) if i == 3 else abs(product - wanted)
                if not (off < np.inf and abs(t[j, 3]) < np.inf):
                    return np.inf
                farthest = max(farthest, off)
        minors = (
            t[1, 1] * t[2, 2] - t[1, 2] * t[2, 1],
            t[1, 2] * t[2, 0] - t[1, 0] * t[2, 2],
            t[1, 0] * t[2, 1] - t[1, 1] * t[2, 0],
        )
        if not t[0, 0] * minors[0] + t[0, 1] * minors[1] + t[0, 2] * minors[2] > 0.0:
            return np.inf
    return farthest


@compiled
def rigid_fits(
    source: Array, target: Array, weights: Array, starts: Array, steps: int, transforms: Array, covariances: Array
) -> None:
    """Rigid fits target = transform(source) by ``steps`` of Gauss-Newton, the points ``starts[f]`` to ``starts[f + 1]``
    belonging to fit f.

    source and target (k,3) m; weights (k,3,3); transforms (f,4,4) from start to result; fills covariances (f,6,6).
    """
    change = np.empty(6)
    for f in range(len(transforms)):
        own = slice(starts[f], starts[f + 1])
        for _ in range(steps if starts[f + 1] > starts[f] else 0):
            rigid_step(source[own], target[own], weights[own], transforms[f], covariances[f], change)
            move_by(transforms[f], change)


@compiled
def inverse_of(n: Array, into: Array) -> None:
    """Fill the inverse (6,) of a symmetric (3,3) matrix ``n`` (6,), both as their entries 00, 01, 02, 11, 12, 22."""
    c_00, c_01, c_02 = n[3] * n[5] - n[4] * n[4], n[2] * n[4] - n[1] * n[5], n[1] * n[4] - n[2] * n[3]
    share = 1.0 / (n[0] * c_00 + n[1] * c_01 + n[2] * c_02)
    into[0], into[1], into[2] = share * c_00, share * c_01, share * c_02
    into[3], into[4] = share * (n[0] * n[5] - n[2] * n[2]), share * (n[1] * n[2] - n[0] * n[4])
    into[5] = share * (n[0] * n[3] - n[1] * n[1])


@compiled
def left_noise(arm: Array, noise: Array, covariance: Array, half: Array, entries: Array) -> None:
    """Fill the entries (6,) of the covariance of a sticker's residual: its noise (3,3) less what it pulls the pose by.

    arm (3,) from the platform's origin; covariance (6,6) of the pose; half (3,6) is overwritten.
    """
    x, y, z = arm[0], arm[1], arm[2]
    for b in range(6):
        half[0, b] = covariance[0, b] + z * covariance[4, b] - y * covariance[5, b]
        half[1, b] = covariance[1, b] - z * covariance[3, b] + x * covariance[5, b]
        half[2, b] = covariance[2, b] + y * covariance[3, b] - x * covariance[4, b]
    entries[0] = noise[0, 0] - (half[0, 0] + z * half[0, 4] - y * half[0, 5])
    entries[1] = noise[0, 1] - (half[0, 1] - z * half[0, 3] + x * half[0, 5])
    entries[2] = noise[0, 2] - (half[0, 2] + y * half[0, 3] - x * half[0, 4])
    entries[3] = noise[1, 1] - (half[1, 1] - z * half[1, 3] + x * half[1, 5])
    entries[4] = noise[1, 2] - (half[1, 2] + y * half[1, 3] - x * half[1, 4])
    entries[5] = noise[2, 2] - (half[2, 2] + y * half[2, 3] - x * half[2, 4])


@compiled
def residual_misfits(
    transforms: Array, spreads: Array, of: Array, places: Array, points: Array, covariances: Array, smallest: float,
    misfits: Array,
) -> None:  # fmt: skip
    """Fill squared residuals (n,) of rigid fits, each in units of its own covariance.

    transforms (f,4,4) with covariances ``spreads`` (f,6,6); of (n,): to which of them each point belongs; places and
    points (n,3) with covariances (n,3,3). NaN where in any direction less than the share ``smallest`` of a point's
    noise is left in its residual.
    """
    arm, gap, half, left, inverse = np.empty(3), np.empty(3), np.empty((3, 6)), np.empty(6), np.empty(6)
    for n in range(len(points)):
        move, noise = transforms[of[n]], covariances[n]
        for i in range(3):
            arm[i] = move[i, 0] * places[n, 0] + move[i, 1] * places[n, 1] + move[i, 2] * places[n, 2]
            gap[i] = points[n, i] - arm[i] - move[i, 3]
        left_noise(arm, noise, spreads[of[n]], half, left)
        xx, xy, xz = (
            left[0] - smallest * noise[0, 0],
            left[1] - smallest * noise[0, 1],
            left[2] - smallest * noise[0, 2],
        )
        yy, yz, zz = (
            left[3] - smallest * noise[1, 1],
            left[4] - smallest * noise[1, 2],
            left[5] - smallest * noise[2, 2],
        )
        minor = xx * yy - xy * xy
        whole = zz * minor - yz * (xx * yz - xy * xz) + xz * (xy * yz - yy * xz)
        misfits[n] = np.nan
        if xx > 0.0 and minor > 0.0 and whole > 0.0:
            inverse_of(left, inverse)
            x, y, z = gap
            misfits[n] = inverse[0] * x * x + inverse[3] * y * y + inverse[5] * z * z
            misfits[n] += 2.0 * (inverse[1] * x * y + inverse[2] * x * z + inverse[4] * y * z)
