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
from cmmsim.geometry.pose_fit_kernels import (
    add_point,
    lie_on_a_line,
    residual_covariance,
    residual_misfit,
    solve_step,
    turn_arm,
)
from cmmsim.geometry.transform_kernels import make_rigid, move_by
from cmmsim.measuring.outline_kernels import Outlines, outline_misfit
from cmmsim.measuring.shared_error_kernels import Images, shared_errors
from cmmsim.measuring.slip_kernels import largest_slip
from cmmsim.measuring.warp_kernels import SHAPES, warp

MOST_STEPS = 8  # largest number of steps of a fit

# States of a frame. All but MEASURED mean that the frame is lost.
MEASURED = 0
TOO_FEW = 1
ON_A_LINE = 2
CONTRADICTED = 3

# Columns of a verdict, which is a row of numbers per frame:
# STATE    state of the frame
# SEEN     number of stickers seen
# LEFT     number of stickers that were not rejected
# FIRST    index in the frame of the sticker that was rejected first, or -1
# PLACE    squared misfit of the place of this sticker
# OUTLINE  squared misfit of the worse ellipse of this sticker
# EXCESS   factor on the covariances
# RIVALS   number of rejected stickers that agree with each other
STATE, SEEN, LEFT, FIRST, PLACE, OUTLINE, EXCESS, RIVALS = range(8)
COLUMNS = 8


class ObservedStickers(NamedTuple):
    """Stickers of one frame or of several frames.

    used          (n,), False for rejected stickers
    points        (n, 3), in the camera frame, m
    informations  (n, 3, 3), inverse covariances of the points
    covariances   (n, 3, 3), covariances of the points
    arms, gaps    (n, 3), m, overwritten; ``pose_fit_kernels`` explains them
    rays          (n,), signed distance between the two rays of a sticker, in standard deviations
    planes        (n,), planes of the body on which the stickers lie, numbered from 0
    """

    used: Array
    points: Array
    informations: Array
    covariances: Array
    arms: Array
    gaps: Array
    rays: Array
    planes: Array


class SolverLimits(NamedTuple):
    """Limits and factors of the solver.

    largest_misfit  largest accepted squared misfit of one sticker
    largest_excess  largest accepted mean square of all residuals, in units of their noise
    fewest          smallest number of stickers
    smallest_share  smallest ratio of a residual's variance to the noise in a tested direction
    smallest_width  smallest extent of the stickers across a line through them, m
    step_tolerance  rotation below which a step ends a fit, rad
    totals          (d,), largest sums of squared residuals that noise explains, by the number of
                    degrees of freedom
    excess_share    factor on the mean square of residuals that are larger than noise
    tails           (d,), factor on the covariance of a pose from few stickers, by the number of
                    degrees of freedom
    largest_warp    largest squared warp that noise explains
    warp_share      factor on the excess of the mean square of the warp's shapes over its limit
    largest_slip    largest squared slip of a plane that noise explains
    fewest_rivals   smallest number of rejected stickers that contradict the others
    exact           True if the rig has no stated errors. Such errors leave residuals like those of
                    delays, so warps, slips and delays are then not tested.
    """

    largest_misfit: float
    largest_excess: float
    fewest: int
    smallest_share: float
    smallest_width: float
    step_tolerance: float
    totals: Array
    excess_share: float
    tails: Array
    largest_warp: float
    warp_share: float
    largest_slip: float
    fewest_rivals: int
    exact: bool


@compiled
def fit(
    seen: ObservedStickers,
    places: Array,
    step_tolerance: float,
    transform: Array,
    covariance: Array,
    normal: Array,
) -> float:
    """Fit a transform (4, 4) to the used stickers; return the sum of their squared residuals.

    ``transform`` is camera_from_body. It is changed, and its ``covariance`` (6, 6) is filled.
    ``places`` (n, 3) are the taught places. On entry, the arms and gaps of all stickers must belong
    to ``transform``. At the end, they belong to the new one. ``normal`` (6, 6) is overwritten.
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
        move_by(transform, change)
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
            turn_arm(transform, places[n], seen.points[n], seen.arms[n], seen.gaps[n])
    return total


@compiled
def excess_of(total: float, freedom: int, totals: Array) -> float:
    """Return the mean square of residuals if noise does not explain it, otherwise 1."""
    if freedom < 1:
        return 1.0
    return total / freedom if total > totals[freedom] else 1.0


@compiled
def worst_sticker(
    seen: ObservedStickers, places: Array, outlines: Outlines, limits: SolverLimits,
    transform: Array, covariance: Array, total: float, freedom: int, misfits: Array,
) -> int:  # fmt: skip
    """Return the used sticker with the largest misfit, or -1 if all misfits are NaN.

    ``misfits`` (3,) is filled with the squared misfits of this sticker's place, of its worse
    ellipse, and of the worst ellipse of all stickers. The misfit of the place is in units of noise,
    or of the other stickers' residuals if those are larger than noise. All squared residuals
    together are ``total``.
    """
    worst = -1
    largest = -1.0
    misfits[2] = 0.0
    half = np.empty((3, 6))
    entries = np.empty(6)
    inverse = np.empty(6)
    for n in range(len(seen.used)):
        if not seen.used[n]:
            continue
        residual_covariance(seen.arms[n], seen.covariances[n], covariance, half, entries)
        misfit = residual_misfit(
            seen.gaps[n], seen.covariances[n], entries, limits.smallest_share, inverse
        )
        # The squared residuals of the other stickers are the total minus this sticker's part, with
        # three degrees of freedom less.
        misfit /= excess_of(total - misfit, freedom - 3, limits.totals)
        outline = 0.0
        if len(outlines.shapes):
            for side in range(2):
                outline = max(outline, outline_misfit(outlines, n, side, transform, places[n]))
        misfits[2] = max(misfits[2], outline)
        if max(misfit, outline) > largest:
            worst = n
            largest = max(misfit, outline)
            misfits[0] = misfit
            misfits[1] = outline
    return worst


@compiled
def agree(
    seen: ObservedStickers, places: Array, outlines: Outlines, limits: SolverLimits,
    transform: Array, covariance: Array, fewest: int, verdict: Array,
) -> None:  # fmt: skip
    """Reject stickers one by one until the others agree; see ``solve`` for the parameters.

    At least ``fewest`` stickers must be left. A sticker is kept if the slip of a plane explains
    more of the residuals than an error of this sticker. Writes to all columns of ``verdict`` but
    RIVALS.
    """
    normal = np.empty((6, 6))
    misfits = np.zeros(3)
    rejected = 0
    verdict[FIRST] = -1
    verdict[SEEN] = np.sum(seen.used)
    # Only one sticker is rejected at a time, because a wrong sticker makes good stickers look
    # wrong.
    while True:
        count = np.sum(seen.used)
        verdict[LEFT] = count
        if count < fewest or count <= rejected:
            verdict[STATE] = TOO_FEW
            return
        if lie_on_a_line(seen.used, places, limits.smallest_width):
            verdict[STATE] = ON_A_LINE
            return
        freedom = 3 * count - 6
        total = fit(seen, places, limits.step_tolerance, transform, covariance, normal)
        verdict[EXCESS] = excess_of(total, freedom, limits.totals)
        worst = worst_sticker(
            seen, places, outlines, limits, transform, covariance, total, freedom, misfits
        )
        if worst < 0:
            verdict[STATE] = TOO_FEW
            return
        agreed = max(misfits[0], misfits[1]) <= limits.largest_misfit
        if limits.exact and not agreed and misfits[2] <= limits.largest_misfit:
            slip = largest_slip(
                seen.used, seen.planes, seen.arms, seen.gaps, seen.informations, covariance, normal
            )
            # Both are chi-square numbers with three degrees of freedom.
            agreed = slip > verdict[EXCESS] * misfits[0]
        if agreed and verdict[EXCESS] <= limits.largest_excess:
            verdict[STATE] = MEASURED
            return
        if rejected == 0:
            verdict[FIRST] = worst
            verdict[PLACE] = misfits[0]
            verdict[OUTLINE] = misfits[1]
        seen.used[worst] = False
        rejected += 1


@compiled
def rivals(
    seen: ObservedStickers, places: Array, outlines: Outlines, limits: SolverLimits,
    transform: Array, rejected: Array,
) -> int:  # fmt: skip
    """Return the number of ``rejected`` (n,) stickers that agree on another pose, or 0."""
    if np.sum(rejected) < limits.fewest_rivals:
        return 0
    others = ObservedStickers(
        rejected.copy(), seen.points, seen.informations, seen.covariances, seen.arms.copy(),
        seen.gaps.copy(), seen.rays, seen.planes,
    )  # fmt: skip
    other = transform.copy()
    verdict = np.zeros(COLUMNS)
    for n in range(len(rejected)):
        turn_arm(other, places[n], seen.points[n], others.arms[n], others.gaps[n])
    agree(others, places, outlines, limits, other, np.empty((6, 6)), limits.fewest_rivals, verdict)
    return int(verdict[LEFT]) if verdict[STATE] == MEASURED else 0


@compiled
def few_excess(
    seen: ObservedStickers, rejected: Array, limits: SolverLimits, covariance: Array
) -> float:
    """Return the factor on the covariance of a pose from few stickers.

    It is the mean square of the residuals of all stickers that were seen, at least 1, times the
    entry of ``limits.tails``, because the pose has a wider distribution than a normal one. The
    squared residuals of ``rejected`` (n,) stickers count up to the limit for one sticker.
    """
    half = np.empty((3, 6))
    entries = np.empty(6)
    inverse = np.empty(6)
    total = 0.0
    used = 0
    gone = 0
    for n in range(len(seen.used)):
        if seen.used[n]:
            used += 1
            for i in range(3):
                for j in range(3):
                    total += seen.gaps[n, i] * seen.informations[n, i, j] * seen.gaps[n, j]
        elif rejected[n]:
            gone += 1
            # The pose is independent of a rejected sticker, so their covariances are added.
            residual_covariance(seen.arms[n], seen.covariances[n], -covariance, half, entries)
            misfit = residual_misfit(seen.gaps[n], seen.covariances[n], entries, 0.0, inverse)
            total += min(misfit, limits.largest_misfit)
    mean = max(total / (3 * (used + gone) - 6), 1.0)
    return mean * limits.tails[3 * used - 6]


@compiled
def solve(
    seen: ObservedStickers, places: Array, outlines: Outlines, limits: SolverLimits,
    transform: Array, covariance: Array, searched: int, images: Images, frame: int, shared: Array,
    verdict: Array,
) -> None:  # fmt: skip
    """Compute the pose of a body in one frame.

    ``transform`` (4, 4) is a first guess of camera_from_body on entry, and the result at the end.
    Its ``covariance`` (6, 6) and the ``verdict`` (COLUMNS,) are filled. ``places`` (n, 3) are the
    taught places, and ``searched`` is the number of stickers that were searched. Stickers that
    contradict the others are marked as not used. Covariances of the others are enlarged if
    residuals are larger than noise. ``shared`` (6, 6) is filled with the part of the covariance due
    to a slip and ``shared_errors``. Arms and gaps must belong to ``transform`` on entry.
    """
    shared[:] = 0.0
    rejected = seen.used.copy()
    verdict[RIVALS] = 0
    agree(seen, places, outlines, limits, transform, covariance, limits.fewest, verdict)
    if verdict[STATE] != MEASURED:
        return
    for n in range(len(rejected)):
        rejected[n] = rejected[n] and not seen.used[n]
    verdict[RIVALS] = rivals(seen, places, outlines, limits, transform, rejected)
    if verdict[RIVALS] > 0:
        verdict[STATE] = CONTRADICTED
        return
    exact = limits.exact
    shared_errors(seen.used, places, seen.arms, images, frame, transform, covariance, exact, shared)
    excess = verdict[EXCESS]
    warped = excess
    if exact:
        scene = seen.arms, seen.gaps, seen.informations
        beyond = warp(seen.used, *scene, seen.rays, covariance) - excess * limits.largest_warp
        # Only the excess over the limit counts, so good frames that just exceed it lose little.
        warped += limits.warp_share * max(beyond, 0.0) / SHAPES
        spread = np.empty((6, 6))
        slip = largest_slip(seen.used, seen.planes, *scene, covariance, spread)
        if slip > excess * limits.largest_slip:
            shared += spread
    if excess > 1.0:
        excess *= limits.excess_share
    if 2 * verdict[LEFT] <= searched:
        excess = max(excess, few_excess(seen, rejected, limits, covariance))
    excess = max(excess, warped)
    verdict[EXCESS] = excess
    for i in range(6):
        for j in range(6):
            covariance[i, j] = excess * covariance[i, j] + shared[i, j]
    for n in range(len(seen.used)):
        for i in range(3 if seen.used[n] else 0):
            for j in range(3):
                seen.covariances[n, i, j] *= excess


@compiled
def solve_frames(
    seen: ObservedStickers, places: Array, outlines: Outlines, limits: SolverLimits, starts: Array,
    searched: Array, images: Images, camera_from_body: Array, covariances: Array, shared: Array,
    verdicts: Array,
) -> None:  # fmt: skip
    """Call ``solve`` for several frames.

    Frame j has the stickers ``starts[j]:starts[j + 1]``, and ``searched`` (f,) is the number of
    stickers that were searched in each. ``places`` (k, 3) has one row per observed sticker.
    ``camera_from_body`` (f, 4, 4) contains first guesses on entry, and the results at the end. The
    ``covariances`` and ``shared`` (f, 6, 6) and ``verdicts`` (f, COLUMNS) are filled.
    """
    for f in range(len(camera_from_body)):
        first = starts[f]
        last = starts[f + 1]
        own = ObservedStickers(
            seen.used[first:last], seen.points[first:last], seen.informations[first:last],
            seen.covariances[first:last], seen.arms[first:last], seen.gaps[first:last],
            seen.rays[first:last], seen.planes[first:last],
        )  # fmt: skip
        own_outlines = Outlines(
            outlines.shapes[first:last], outlines.informations[first:last],
            outlines.normals[first:last], outlines.radius, outlines.cameras,
        )  # fmt: skip
        taught = places[first:last]
        own_images = Images(
            images.pixels[first:last], images.spreads[first:last], images.shifts, images.ends,
            images.cameras,
        )  # fmt: skip
        # A tracker extrapolates poses from earlier results, so rounding errors accumulate.
        make_rigid(camera_from_body[f])
        for n in range(last - first):
            turn_arm(camera_from_body[f], taught[n], own.points[n], own.arms[n], own.gaps[n])
        solve(
            own, taught, own_outlines, limits, camera_from_body[f], covariances[f], searched[f],
            own_images, f, shared[f], verdicts[f],
        )  # fmt: skip
