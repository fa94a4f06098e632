"""Compiled: the pose of a body from the stickers that are seen in one frame.

Images and drawn centres feed this solver alike, one frame or many. Taught places are laid onto the
triangulated stickers. While a sticker differs too much, the worst sticker is left out. It differs
from the place that the other stickers predict, or from the ellipse of a whole sticker.
``frame_solver`` gives the reasons.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cmmsim.compilation import Array, compiled
from cmmsim.geometry.camera_kernels import Cameras, project
from cmmsim.geometry.disc_kernels import bent_root, disc_ellipse
from cmmsim.geometry.matrix_kernels import from_entries, square_by
from cmmsim.geometry.rigid_kernels import (
    add_point,
    left_noise,
    residual_misfit,
    solve_step,
    turn_arm,
)
from cmmsim.geometry.transform_kernels import carry, make_rigid, move_by

MOST_STEPS = 8

# States of a frame.
MEASURED = 0
TOO_FEW = 1
ON_A_LINE = 2

# Columns of a verdict, a row of numbers for each frame: its state, its stickers to begin with and
# in the end, the one that was left out first (-1: none) with the squared misfits of its place and
# of its worse ellipse, and the factor by which covariances have grown.
STATE, SEEN, LEFT, FIRST, PLACE, OUTLINE, EXCESS = range(7)
COLUMNS = 7


class Seen(NamedTuple):
    """Stickers of one frame or of several: whether ``used`` (n,), and where they are.

    points (n,3) in the camera frame, m, with their informations and covariances (n,3,3). Arms and
    gaps (n,3) are those of ``rigid_kernels``, and are overwritten.
    """

    used: Array
    points: Array
    informations: Array
    covariances: Array
    arms: Array
    gaps: Array


class Outlines(NamedTuple):
    """Entries xx, xy, yy of the ellipses' shapes (n, 2, 3) in both images, px.

    ``informations`` (n, 2, 6) are the entries of their inverse covariances. Without rows, no
    ellipses are known. The cameras see stickers with normals (n, 3) in the body's axes, and a
    radius, m.
    """

    shapes: Array
    informations: Array
    normals: Array
    radius: float
    cameras: Cameras


class Belief(NamedTuple):
    """Limits for the stickers of a frame.

    ``largest_misfit`` limits the squared difference of one sticker from the others, and
    ``largest_excess`` the mean square of all residuals. ``fewest`` is a number of stickers.
    ``smallest_share`` is the share of a sticker's noise that must show in its residual.
    ``smallest_width`` is the distance of the stickers from one line, m. ``settled`` is the turn of
    the last step of a fit, rad. ``totals`` (f,) are sums of squared residuals, by their freedom,
    beyond which they are larger than noise.
    """

    largest_misfit: float
    largest_excess: float
    fewest: int
    smallest_share: float
    smallest_width: float
    settled: float
    totals: Array


@compiled
def lie_on_a_line(used: Array, places: Array, width: float) -> bool:
    """Tell whether the places (n,3) that are used lie within ``width`` m of one line.

    The middle eigenvalue of their scatter matrix is compared, or a lower bound of it first.
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
    # From squares about the first place to those about the middle.
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
    seen: Seen, places: Array, settled: float, place: Array, covariance: Array, normal: Array
) -> float:
    """Move ``place`` (4,4) to where the used stickers fit best; return their squared residuals.

    Fills the covariance (6,6) of the place, and the arms and gaps of the stickers, which must hold
    on entry as well. ``normal`` (6,6) is overwritten.
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
        if max(abs(change[3]), abs(change[4]), abs(change[5])) < settled:
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
    """Return the mean square of residuals where it is larger than noise makes it, else 1."""
    if freedom < 1:
        return 1.0
    return total / freedom if total > totals[freedom] else 1.0


@compiled
def outline_misfit(outlines: Outlines, n: int, side: int, place: Array, taught: Array) -> float:
    """Return the squared difference of an ellipse from that of a whole sticker ``taught`` (3,)."""
    camera = outlines.cameras.figures[side]
    move = outlines.cameras.moves[side]
    point = np.empty(3)
    centre = np.empty(3)
    turned = np.empty(3)
    normal = np.empty(3)
    carry(place, taught, 1.0, point)
    carry(move, point, 1.0, centre)
    carry(place, outlines.normals[n], 0.0, turned)
    carry(move, turned, 0.0, normal)
    x, y, xx, xy, yy = disc_ellipse(centre, normal, outlines.radius, camera)
    _, _, a, b, c, d = project(camera, x, y, 1.0)
    xx, xy, yy = bent_root(xx, xy, yy, a, b, c, d)
    shape = outlines.shapes[n, side]
    return square_by(outlines.informations[n, side], shape[0] - xx, shape[1] - xy, shape[2] - yy)


@compiled
def worst_sticker(
    seen: Seen, places: Array, outlines: Outlines, belief: Belief, place: Array,
    covariance: Array, total: float, freedom: int, misfits: Array,
) -> int:  # fmt: skip
    """Return the used sticker that differs most, and fill its ``misfits`` (2,) of both kinds.

    The misfit of its place is that against its noise, or against the residuals of the others where
    these are larger than noise.
    """
    worst = -1
    largest = -1.0
    half = np.empty((3, 6))
    left = np.empty(6)
    inverse = np.empty(6)
    for n in range(len(seen.used)):
        if not seen.used[n]:
            continue
        left_noise(seen.arms[n], seen.covariances[n], covariance, half, left)
        misfit = residual_misfit(
            seen.gaps[n], seen.covariances[n], left, belief.smallest_share, inverse
        )
        # Judged by the others: their squares are the total less this sticker's, with three fewer
        # numbers.
        misfit /= excess_of(total - misfit, freedom - 3, belief.totals)
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
    seen: Seen, places: Array, outlines: Outlines, belief: Belief, place: Array,
    covariance: Array, verdict: Array,
) -> None:  # fmt: skip
    """Solve one frame: move ``place`` (4,4) from near to camera_from_body, fill its covariance.

    Stickers that contradict the others cease to be used; ``places`` (n,3) are where they were
    taught. Covariances of the used ones grow with the residuals. The ``verdict`` of the frame, a
    row of columns, is filled. Arms and gaps must hold on entry.
    """
    normal = np.empty((6, 6))
    misfits = np.zeros(2)
    excess = 1.0
    left_out = 0
    verdict[FIRST] = -1
    verdict[SEEN] = np.sum(seen.used)
    # One sticker at a time is left out, because a wrong one makes good ones look wrong.
    while True:
        count = np.sum(seen.used)
        verdict[LEFT] = count
        if count < belief.fewest or count <= left_out:
            verdict[STATE] = TOO_FEW
            return
        if lie_on_a_line(seen.used, places, belief.smallest_width):
            verdict[STATE] = ON_A_LINE
            return
        freedom = 3 * count - 6
        total = fit(seen, places, belief.settled, place, covariance, normal)
        excess = excess_of(total, freedom, belief.totals)
        worst = worst_sticker(
            seen, places, outlines, belief, place, covariance, total, freedom, misfits
        )
        # NaN differs from nothing: residuals that are no numbers single out no sticker.
        if worst < 0:
            verdict[STATE] = TOO_FEW
            return
        if max(misfits[0], misfits[1]) <= belief.largest_misfit and excess <= belief.largest_excess:
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
    seen: Seen, places: Array, outlines: Outlines, belief: Belief, starts: Array,
    moves: Array, covariances: Array, verdicts: Array,
) -> None:  # fmt: skip
    """``solve`` f frames, whose stickers are ``starts[f]`` to ``starts[f + 1]`` of all.

    Moves (f,4,4) are camera_from_body, from near to result; fills covariances (f,6,6).
    """
    for f in range(len(moves)):
        first = starts[f]
        last = starts[f + 1]
        own = Seen(
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
        # A tracker extrapolates a pose from those that were found before, which adds up rounding.
        make_rigid(moves[f])
        for n in range(last - first):
            turn_arm(moves[f], taught[n], own.points[n], own.arms[n], own.gaps[n])
        solve(own, taught, shown, belief, moves[f], covariances[f], verdicts[f])
