"""Compiled functions that compute the pose of a body from its stickers in one frame.

This solver is used with and without images, and for one or many frames. Taught places are fitted to
the triangulated stickers. Stickers that differ too much are rejected one by one, the worst one
first. A sticker can differ from the place that the other stickers predict, or from the ellipse of
an unhidden sticker. ``frame_solver`` explains the method.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cmmsim.compilation import Array, compiled
from cmmsim.geometry.camera_kernels import Cameras, project
from cmmsim.geometry.disc_kernels import disc_ellipse, distorted_root
from cmmsim.geometry.matrix_kernels import from_entries, square_by
from cmmsim.geometry.rigid_kernels import (
    add_point,
    residual_covariance,
    residual_misfit,
    solve_step,
    turn_arm,
)
from cmmsim.geometry.transform_kernels import make_rigid, move_by, transform_point

MOST_STEPS = 8

# States of a frame.
MEASURED = 0
TOO_FEW = 1
ON_A_LINE = 2

# Columns of a verdict, which is a row of numbers per frame:
# STATE    state of the frame
# SEEN     number of stickers seen
# LEFT     number of stickers that were not rejected
# FIRST    sticker that was rejected first, or -1
# PLACE    squared misfit of the place of this sticker
# OUTLINE  squared misfit of the worse ellipse of this sticker
# EXCESS   factor on the covariances
STATE, SEEN, LEFT, FIRST, PLACE, OUTLINE, EXCESS = range(7)
COLUMNS = 7


class ObservedStickers(NamedTuple):
    """Stickers of one frame or of several frames.

    used          (n,), False for rejected stickers
    points        (n, 3), in the camera frame, m
    informations  (n, 3, 3), inverse covariances of the points
    covariances   (n, 3, 3), covariances of the points
    arms, gaps    (n, 3), overwritten; ``rigid_kernels`` explains them
    """

    used: Array
    points: Array
    informations: Array
    covariances: Array
    arms: Array
    gaps: Array


class Outlines(NamedTuple):
    """Ellipses of stickers in both images. All arrays are empty if no ellipses are known.

    ``shapes`` (n, 2, 3) are the entries xx, xy, yy of the ellipses' matrices, px. ``informations``
    (n, 2, 6) are the entries of the inverse covariances of these entries. ``normals`` (n, 3) are
    the stickers' normals in body axes, and ``radius`` is the stickers' radius, m.
    """

    shapes: Array
    informations: Array
    normals: Array
    radius: float
    cameras: Cameras


class SolverLimits(NamedTuple):
    """Limits for the stickers of a frame.

    largest_misfit  squared misfit of one sticker
    largest_excess  mean square of all residuals
    fewest          smallest number of stickers
    smallest_share  smallest share of a sticker's noise that must appear in its residual
    smallest_width  smallest extent of the stickers across a line through them, m
    step_tolerance  rotation below which a step ends a fit, rad
    totals          (d,), largest sums of squared residuals that noise explains, by the number of
                    degrees of freedom
    """

    largest_misfit: float
    largest_excess: float
    fewest: int
    smallest_share: float
    smallest_width: float
    step_tolerance: float
    totals: Array


@compiled
def lie_on_a_line(used: Array, places: Array, width: float) -> bool:
    """Tell whether the used places (n,3) lie within ``width`` m of one line.

    The middle eigenvalue of their scatter matrix is compared with ``width`` squared. A lower bound
    of the eigenvalue is compared first, because the bound is faster to compute.
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
    # Change from sums of squares about the first place to sums about the middle.
    xx -= x * x / count
    xy -= x * y / count
    xz -= x * z / count
    yy -= y * y / count
    yz -= y * z / count
    zz -= z * z / count
    # With eigenvalues a >= b >= c, the sum of the principal minors is at most 2 b (a + b + c).
    minors = xx * yy + xx * zz + yy * zz - xy * xy - xz * xz - yz * yz
    if minors >= 2.0 * (xx + yy + zz) * width * width:
        return False
    scatter = np.empty((3, 3))
    from_entries(np.array([xx, xy, xz, yy, yz, zz]), scatter)
    return np.linalg.eigvalsh(scatter)[1] < width * width


@compiled
def fit(
    seen: ObservedStickers,
    places: Array,
    step_tolerance: float,
    place: Array,
    covariance: Array,
    normal: Array,
) -> float:
    """Fit ``place`` (4,4) to the used stickers and return the sum of their squared residuals.

    ``place`` is changed, and its ``covariance`` (6,6) is filled. On entry, the arms and gaps of the
    stickers must belong to ``place``. At the end, they belong to the new ``place``. ``normal``
    (6,6) is working memory.
    """
    change = np.empty(6)
    total = 0.0
    for _ in range(MOST_STEPS):
        normal[:] = 0.0
        change[:] = 0.0
        total = 0.0
        for n in range(len(seen.used)):
            if seen.used[n]:
                total += add_point(seen.arms[n], seen.informations[n], seen.gaps[n], normal, change)
        total -= solve_step(normal, change, covariance)
        move_by(place, change)
        if max(abs(change[3]), abs(change[4]), abs(change[5])) < step_tolerance:
            for n in range(len(seen.used)):
                arm = seen.arms[n]
                gap = seen.gaps[n]
                # The last step is so small that its effect on arms and gaps is linear.
                gap[0] -= change[0] + change[4] * arm[2] - change[5] * arm[1]
                gap[1] -= change[1] + change[5] * arm[0] - change[3] * arm[2]
                gap[2] -= change[2] + change[3] * arm[1] - change[4] * arm[0]
            break
        for n in range(len(seen.used)):
            turn_arm(place, places[n], seen.points[n], seen.arms[n], seen.gaps[n])
    return total


@compiled
def excess_of(total: float, freedom: int, totals: Array) -> float:
    """Return the mean square of residuals if noise does not explain it, else 1."""
    if freedom < 1:
        return 1.0
    return total / freedom if total > totals[freedom] else 1.0


@compiled
def outline_misfit(outlines: Outlines, n: int, side: int, place: Array, taught: Array) -> float:
    """Return the squared misfit of the ellipse of sticker ``n`` in image ``side``.

    The misfit is the difference from the ellipse of an unhidden sticker at ``taught`` (3,).
    """
    camera = outlines.cameras.intrinsics[side]
    move = outlines.cameras.extrinsics[side]
    point = np.empty(3)
    centre = np.empty(3)
    turned = np.empty(3)
    normal = np.empty(3)
    transform_point(place, taught, 1.0, point)
    transform_point(move, point, 1.0, centre)
    transform_point(place, outlines.normals[n], 0.0, turned)
    transform_point(move, turned, 0.0, normal)
    x, y, xx, xy, yy = disc_ellipse(centre, normal, outlines.radius, camera)
    _, _, a, b, c, d = project(camera, x, y, 1.0)
    xx, xy, yy = distorted_root(xx, xy, yy, a, b, c, d)
    shape = outlines.shapes[n, side]
    return square_by(outlines.informations[n, side], shape[0] - xx, shape[1] - xy, shape[2] - yy)


@compiled
def worst_sticker(
    seen: ObservedStickers, places: Array, outlines: Outlines, limits: SolverLimits, place: Array,
    covariance: Array, total: float, freedom: int, misfits: Array,
) -> int:  # fmt: skip
    """Return the used sticker with the largest misfit, and fill ``misfits`` (2,).

    ``misfits`` are the squared misfits of this sticker's place and of its worse ellipse. The misfit
    of the place is in units of noise, or of the other stickers' residuals if those are larger than
    noise.
    """
    worst = -1
    largest = -1.0
    half = np.empty((3, 6))
    left = np.empty(6)
    inverse = np.empty(6)
    for n in range(len(seen.used)):
        if not seen.used[n]:
            continue
        residual_covariance(seen.arms[n], seen.covariances[n], covariance, half, left)
        misfit = residual_misfit(
            seen.gaps[n], seen.covariances[n], left, limits.smallest_share, inverse
        )
        # The squared residuals of the other stickers are the total minus this sticker's part, with
        # three degrees of freedom less.
        misfit /= excess_of(total - misfit, freedom - 3, limits.totals)
        outline = 0.0
        if len(outlines.shapes):
            for side in range(2):
                outline = max(outline, outline_misfit(outlines, n, side, place, places[n]))
        if max(misfit, outline) > largest:
            worst = n
            largest = max(misfit, outline)
            misfits[0] = misfit
            misfits[1] = outline
    return worst


@compiled
def solve(
    seen: ObservedStickers, places: Array, outlines: Outlines, limits: SolverLimits, place: Array,
    covariance: Array, verdict: Array,
) -> None:  # fmt: skip
    """Solve one frame.

    ``place`` (4,4) is a first guess of camera_from_body on entry, and the result at the end. Its
    ``covariance`` (6,6) and the ``verdict`` (COLUMNS,) of the frame are filled. ``places`` (n,3)
    are the taught places. Stickers that contradict the others are marked as not used. The
    covariances of the used stickers are enlarged if residuals are larger than noise. Arms and gaps
    must belong to ``place`` on entry.
    """
    normal = np.empty((6, 6))
    misfits = np.zeros(2)
    excess = 1.0
    left_out = 0
    verdict[FIRST] = -1
    verdict[SEEN] = np.sum(seen.used)
    # Only one sticker is rejected at a time, because a wrong sticker makes good stickers look
    # wrong.
    while True:
        count = np.sum(seen.used)
        verdict[LEFT] = count
        if count < limits.fewest or count <= left_out:
            verdict[STATE] = TOO_FEW
            return
        if lie_on_a_line(seen.used, places, limits.smallest_width):
            verdict[STATE] = ON_A_LINE
            return
        freedom = 3 * count - 6
        total = fit(seen, places, limits.step_tolerance, place, covariance, normal)
        excess = excess_of(total, freedom, limits.totals)
        worst = worst_sticker(
            seen, places, outlines, limits, place, covariance, total, freedom, misfits
        )
        # Without a worst sticker, all misfits are NaN.
        if worst < 0:
            verdict[STATE] = TOO_FEW
            return
        if max(misfits[0], misfits[1]) <= limits.largest_misfit and excess <= limits.largest_excess:
            break
        if left_out == 0:
            verdict[FIRST] = worst
            verdict[PLACE] = misfits[0]
            verdict[OUTLINE] = misfits[1]
        seen.used[worst] = False
        left_out += 1
    verdict[STATE] = MEASURED
    verdict[EXCESS] = excess
    for i in range(6):
        for j in range(6):
            covariance[i, j] *= excess
    for n in range(len(seen.used)):
        for i in range(3 if seen.used[n] else 0):
            for j in range(3):
                seen.covariances[n, i, j] *= excess


@compiled
def solve_frames(
    seen: ObservedStickers, places: Array, outlines: Outlines, limits: SolverLimits, starts: Array,
    camera_from_body: Array, covariances: Array, verdicts: Array,
) -> None:  # fmt: skip
    """Call ``solve`` for several frames. Frame j has the stickers ``starts[j]`` to ``starts[j +
    1]``.

    ``camera_from_body`` (f,4,4) contains first guesses on entry, and the results at the end.
    Their ``covariances`` (f,6,6) and ``verdicts`` (f, COLUMNS) are filled.
    """
    for f in range(len(camera_from_body)):
        first = starts[f]
        last = starts[f + 1]
        own = ObservedStickers(
            seen.used[first:last],
            seen.points[first:last],
            seen.informations[first:last],
            seen.covariances[first:last],
            seen.arms[first:last],
            seen.gaps[first:last],
        )
        shown = Outlines(
            outlines.shapes[first:last],
            outlines.informations[first:last],
            outlines.normals[first:last],
            outlines.radius,
            outlines.cameras,
        )
        taught = places[first:last]
        # A tracker extrapolates poses from earlier results, so rounding errors accumulate.
        make_rigid(camera_from_body[f])
        for n in range(last - first):
            turn_arm(camera_from_body[f], taught[n], own.points[n], own.arms[n], own.gaps[n])
        solve(own, taught, shown, limits, camera_from_body[f], covariances[f], verdicts[f])
