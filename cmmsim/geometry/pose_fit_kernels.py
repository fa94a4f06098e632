"""Compiled kernels that fit a pose to points by Gauss-Newton, with its covariance, and test it.

A point is known in the axes of a body, and measured with a covariance. ``arm`` is the known point
rotated by the transform. ``gap`` is the measured point minus the transformed known point. The
residual of a fitted point has the covariance S - J C J'. S is the covariance of the point's noise,
C the covariance of the small error [dt, dphi] of the transform, which ``solve_step`` computes, and
J the derivative of the point with respect to this error.
"""

from __future__ import annotations

import numpy as np

from cmmsim.compilation import Array, compiled
from cmmsim.geometry.matrix_kernels import (
    factorise,
    from_entries,
    inverse_entries,
    invert_factored,
    solve_factored,
    square_by,
)
from cmmsim.geometry.transform_kernels import move_by, transform_point


@compiled
def lie_on_a_line(used: Array, places: Array, width: float) -> bool:
    """Tell whether the places (n, 3) in the mask ``used`` (n,) lie nearly on one line.

    They do if the middle eigenvalue of their scatter matrix, a sum of squares, is below the square
    of ``width``, m. A lower bound of the eigenvalue is compared first, because it is faster to
    compute. At least one place must be used.
    """
    first = np.argmax(used)
    count = 0
    x = y = z = xx = xy = xz = yy = yz = zz = 0.0
    for n in range(len(used)):
        if used[n]:
            count += 1
            a = places[n, 0] - places[first, 0]
            b = places[n, 1] - places[first, 1]
            c = places[n, 2] - places[first, 2]
            x += a
            y += b
            z += c
            xx += a * a
            xy += a * b
            xz += a * c
            yy += b * b
            yz += b * c
            zz += c * c
    # Change from sums of squares about the first used place to sums about the middle.
    xx -= x * x / count
    xy -= x * y / count
    xz -= x * z / count
    yy -= y * y / count
    yz -= y * z / count
    zz -= z * z / count
    # With eigenvalues a >= b >= c, the sum of the principal 2x2 minors is at most 2 b (a + b + c).
    minors = xx * yy + xx * zz + yy * zz - xy * xy - xz * xz - yz * yz
    if minors >= 2.0 * (xx + yy + zz) * width * width:
        return False
    scatter = np.empty((3, 3))
    from_entries(np.array([xx, xy, xz, yy, yz, zz]), scatter)
    return np.linalg.eigvalsh(scatter)[1] < width * width


@compiled
def add_point(arm: Array, info: Array, gap: Array, normal: Array, change: Array) -> float:
    """Add a point to the normal equations of a pose; return gap' W gap.

    ``info`` (3, 3) is W, the inverse covariance of the point's noise. J' W J is added to the lower
    triangle of ``normal`` (6, 6), and J' W gap to the right-hand side ``change`` (6,).
    """
    x = arm[0]
    y = arm[1]
    z = arm[2]
    squared = 0.0
    for i in range(3):
        weighted = info[i, 0] * gap[0] + info[i, 1] * gap[1] + info[i, 2] * gap[2]
        squared += gap[i] * weighted
        change[i] += weighted
        # row i of W J, where J = [I, -skew(arm)]
        by_x = info[i, 2] * y - info[i, 1] * z
        by_y = info[i, 0] * z - info[i, 2] * x
        by_z = info[i, 1] * x - info[i, 0] * y
        normal[3, i] += by_x
        normal[4, i] += by_y
        normal[5, i] += by_z
        for j in range(i + 1):
            normal[i, j] += info[i, j]
        # column i of J' multiplied by that row
        if i == 0:
            normal[4, 3] += z * by_x
            normal[5, 3] -= y * by_x
            normal[4, 4] += z * by_y
            normal[5, 4] -= y * by_y
            normal[5, 5] -= y * by_z
            change[4] += z * weighted
            change[5] -= y * weighted
        elif i == 1:
            normal[3, 3] -= z * by_x
            normal[5, 3] += x * by_x
            normal[5, 4] += x * by_y
            normal[5, 5] += x * by_z
            change[3] -= z * weighted
            change[5] += x * weighted
        else:
            normal[3, 3] += y * by_x
            normal[4, 3] -= x * by_x
            normal[4, 4] -= x * by_y
            change[3] += y * weighted
            change[4] -= x * weighted
    return squared


@compiled
def solve_step(normal: Array, change: Array, covariance: Array) -> float:
    """Solve the normal equations of a pose in place; return the decrease of the sum of squares.

    The decrease is that of the linearised residuals. The right-hand side ``change`` (6,) is
    replaced by the step [dt, dphi], and ``covariance`` (6, 6) is filled. ``normal`` is overwritten.
    """
    right_hand_side = (change[0], change[1], change[2], change[3], change[4], change[5])
    factorise(normal)
    invert_factored(normal, covariance)
    solve_factored(normal, change)
    decrease = 0.0
    for a in range(6):
        decrease += right_hand_side[a] * change[a]
    return decrease


@compiled
def turn_arm(transform: Array, place: Array, point: Array, arm: Array, gap: Array) -> None:
    """Fill the arm (3,) and the gap (3,) of a measured ``point`` (3,) that is known at ``place``.

    ``place`` (3,) is in the axes of the body.
    """
    transform_point(transform, place, 0.0, arm)
    for i in range(3):
        gap[i] = point[i] - transform[i, 3] - arm[i]


@compiled
def rigid_fits(
    places: Array, points: Array, informations: Array, starts: Array, steps: int,
    transforms: Array, covariances: Array, misfits: Array,
) -> None:  # fmt: skip
    """Fit transforms (f, 4, 4) that move known ``places`` (k, 3) to measured ``points`` (k, 3).

    ``transforms`` contain start values and are replaced after ``steps`` Gauss-Newton steps. Fit j
    has the points ``starts[j]:starts[j + 1]``. The points have inverse covariances ``informations``
    (k, 3, 3). Fills covariances (f, 6, 6), and misfits (k,), which are squared residuals in units
    of the noise. For a fit without points, neither transform nor covariance changes.
    """
    arm = np.empty(3)
    gap = np.empty(3)
    change = np.empty(6)
    normal = np.empty((6, 6))
    for f in range(len(transforms)):
        first = starts[f]
        last = starts[f + 1]
        for _ in range(steps if last > first else 0):
            normal[:] = 0.0
            change[:] = 0.0
            for n in range(first, last):
                turn_arm(transforms[f], places[n], points[n], arm, gap)
                add_point(arm, informations[n], gap, normal, change)
            solve_step(normal, change, covariances[f])
            move_by(transforms[f], change)
        for n in range(first, last):
            turn_arm(transforms[f], places[n], points[n], arm, gap)
            misfits[n] = 0.0
            for i in range(3):
                for j in range(3):
                    misfits[n] += gap[i] * informations[n, i, j] * gap[j]


@compiled
def residual_covariance(
    arm: Array, noise: Array, covariance: Array, half: Array, entries: Array
) -> None:
    """Fill the entries (6,) of S - J C J', the covariance of a fitted point's residual.

    ``noise`` (3, 3) is S, and ``covariance`` (6, 6) is C. The entries are 00, 01, 02, 11, 12 and
    22. ``half`` (3, 6) is overwritten.
    """
    x = arm[0]
    y = arm[1]
    z = arm[2]
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
def residual_misfit(
    gap: Array, noise: Array, residual_entries: Array, smallest: float, inverse: Array
) -> float:
    """Return the squared Mahalanobis norm of the residual ``gap`` (3,) for its own covariance.

    ``residual_entries`` (6,) has the entries of that covariance, see ``residual_covariance``. A
    direction does not count if the variance of the residual is below ``smallest`` times the
    variance of the point's ``noise`` (3, 3). In such a direction, the point alone determines the
    pose. ``inverse`` (6,) is overwritten.
    """
    xx = residual_entries[0] - smallest * noise[0, 0]
    xy = residual_entries[1] - smallest * noise[0, 1]
    xz = residual_entries[2] - smallest * noise[0, 2]
    yy = residual_entries[3] - smallest * noise[1, 1]
    yz = residual_entries[4] - smallest * noise[1, 2]
    zz = residual_entries[5] - smallest * noise[2, 2]
    minor = xx * yy - xy * xy
    determinant = zz * minor - yz * (xx * yz - xy * xz) + xz * (xy * yz - yy * xz)
    if xx > 0.0 and minor > 0.0 and determinant > 0.0:
        inverse_entries(residual_entries, inverse)
        return square_by(inverse, gap[0], gap[1], gap[2])
    return checkable_misfit(gap, noise, residual_entries, smallest)


@compiled
def checkable_misfit(gap: Array, noise: Array, residual_entries: Array, smallest: float) -> float:
    """Return ``residual_misfit`` from only the directions with enough variance."""
    lower = noise.copy()
    factorise(lower)
    root = np.zeros((3, 3))  # inverse of the Cholesky factor, which whitens the noise
    for k in range(3):
        for i in range(k, 3):
            rest = 1.0 if i == k else 0.0
            for j in range(k, i):
                rest -= lower[i, j] * root[j, k]
            root[i, k] = rest / lower[i, i]
    matrix = np.empty((3, 3))
    from_entries(residual_entries, matrix)
    ratios, axes = np.linalg.eigh(root @ matrix @ root.T)
    whitened = axes.T @ (root @ gap)
    total = 0.0
    for i in range(3):
        if ratios[i] > smallest:
            total += whitened[i] ** 2 / ratios[i]
    return total
