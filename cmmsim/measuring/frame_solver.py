"""Poses of a body and their covariances, from those observed stickers that agree with each other.

The taught places are fitted to the observed stickers. Stickers are rejected one by one, the worst
one first, in two cases:

- The place of a sticker differs from the place that the other stickers predict. This test is data
  snooping. The residual is compared with its own covariance S - J C J'. S is the covariance of the
  sticker's noise, C the covariance of the pose, and J the derivative of the sticker's place with
  respect to the pose. S - J C J' is smaller than S, because each sticker pulls the pose towards
  itself.
- The ellipse of a sticker in one image differs from the ellipse of an unhidden sticker. If a
  sticker is partly hidden or touches another bright spot, its centre and its rim both move.

A sticker is kept if the slip of a whole plane explains more of the residuals than an error of this
sticker, as ``slip_kernels`` tells. Both have three degrees of freedom.

Undetected errors of places and of ellipses are of the size of the noise. At least five stickers
must remain, and more than were rejected. If three or more of the rejected stickers agree with each
other on another pose, a group of stickers has moved. The images do not show which group it was, so
the frame is lost.

All residuals can be larger than noise, for example if a camera has drifted since its calibration,
or several stickers are slightly misplaced. The squared residual of each sticker is then divided by
the mean square of the other stickers' residuals, in units of their noise. All covariances are
multiplied by the mean square of all residuals (squared Birge ratio), and by a factor, because such
errors are not independent. If the mean square exceeds a limit, more stickers are rejected. The
covariances are also enlarged for a warp of the whole pattern (``warp_kernels``), for a plane of
stickers that has slipped (``slip_kernels``), for errors that stickers share
(``shared_error_kernels``), and for a pose from at most half of the stickers that were searched.

The computation is compiled, in ``solver_kernels``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, fdtri

from cmmsim.errors import DividedError, LostError
from cmmsim.files.rig_and_bodies import MarkedBody
from cmmsim.geometry.pose import Array
from cmmsim.geometry.registration import SMALLEST_SPREAD, require_spread
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.measuring.observation import DetectionSettings, Observer
from cmmsim.measuring.sticker_windows import StickerObservation

if TYPE_CHECKING:
    from cmmsim.measuring.outline_kernels import Outlines
    from cmmsim.measuring.shared_error_kernels import Images
    from cmmsim.measuring.solver_kernels import SolverLimits

# Probability that a good sticker is rejected, for its place and for each of its two ellipses.
CHANCE = 1e-4
# Probability that the residuals of a good frame count as larger than noise.
EXCESS_CHANCE = 1e-4
# Largest mean square of the residuals in units of their noise.
LARGEST_EXCESS = 6.0
# Largest squared misfit of a good sticker, of its place or of an ellipse.
LARGEST_MISFIT = float(chdtri(3, CHANCE))
FEWEST = 5  # smallest number of stickers that must remain
# Smallest ratio of the variance of a residual to that of the sticker's noise. Directions with a
# smaller ratio are not tested, because the sticker alone determines the pose along them.
SMALLEST_SHARE = 0.01
# Probability that a good frame counts as warped. It is larger than that of other tests, because
# a warp that is just not noticed moves the pose by up to ten deviations.
WARP_CHANCE = 1e-3
# Largest squared size of a warp that noise explains, in units of the noise.
LARGEST_WARP = float(chdtri(10, WARP_CHANCE))
# Probability that a plane of a good frame counts as slipped. It is larger for the same reason.
SLIP_CHANCE = 1e-3
# Largest squared slip of one of three planes that noise explains, in units of the noise.
LARGEST_SLIP = float(chdtri(3, SLIP_CHANCE / 3))
# Errors that are larger than noise are not independent: a pose errs as if this number of stickers
# had the same error.
EXCESS_SHARE = 4.0
# Probability of the quantile of a pose's squared error for which ``_tails`` is exact.
TAIL = 0.999
# The excess of the mean square of the warp's shapes over its limit, times this number, is added to
# the factor on the covariance. A pose errs in six shapes that are as smooth as those of a warp.
WARP_SHARE = 8.0
# Fewest rejected stickers that make a frame lost if they agree with each other on another pose.
FEWEST_RIVALS = 3
# A fit ends after a step with a rotation smaller than this, rad.
STEP_TOLERANCE = 1e-8


@dataclass(frozen=True)
class SolvedFrames:
    """Poses of a body in f frames, and the stickers from which they were computed.

    camera_from_body  (f, 4, 4)
    covariances       (f, 6, 6), of the small errors [dt, dphi] of camera_from_body
    stickers          the k stickers of all frames; covariances of the used ones are enlarged if
                      residuals are larger than noise
    used              (k,), False for rejected stickers
    starts            (f + 1,); frame j has the stickers ``starts[j]`` to ``starts[j + 1]``
    shared            (f, 6, 6), part of the covariances due to slips and to errors that stickers
                      share
    verdicts          (f, COLUMNS), states of the frames, with the columns of ``solver_kernels``
    places            (n, 3), taught places of the stickers on ``body``, m

    Poses and covariances of lost frames are meaningless.
    """

    camera_from_body: Array
    covariances: Array
    stickers: StickerObservation
    used: NDArray[np.bool_]
    starts: NDArray[np.int_]
    shared: Array
    verdicts: Array
    body: MarkedBody
    places: Array

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Mask (f,) of the frames without a pose."""
        return self.verdicts[:, 0] != 0

    def used_in(self, frame: int) -> StickerObservation:
        """Return the stickers from which the pose of a frame was computed.

        The ``index`` of the result refers to the body's stickers.
        """
        in_frame = np.zeros(len(self.used), dtype=bool)
        in_frame[self.starts[frame] : self.starts[frame + 1]] = True
        seen = self.stickers.selected(in_frame & self.used)
        return replace(seen, index=seen.index % len(self.places))

    def error(self, frame: int) -> LostError:
        """Return the error that states why a frame is lost."""
        # Imported late, because importing numba takes time.
        from cmmsim.measuring.solver_kernels import RIVALS

        kind = DividedError if self.verdicts[frame, RIVALS] > 0 else LostError
        return kind(self.reason(frame))

    def reason(self, frame: int) -> str:
        """Return the reason why a frame is lost."""
        # Imported late, because importing numba takes time.
        from cmmsim.measuring.solver_kernels import FIRST

        verdict = self.verdicts[frame]
        first = ""
        if verdict[FIRST] >= 0:
            row = self.starts[frame] + int(verdict[FIRST])
            first = str(self.body.sticker_ids[self.stickers.index[row] % len(self.places)])
        reason = lost_reason(verdict, first, self.places[self.used_in(frame).index])
        seen = int(self.starts[frame + 1] - self.starts[frame])
        searched = 0 if self.stickers.searched is None else self.stickers.searched[frame]
        if seen >= FEWEST or searched == 0 or self.stickers.detected is None:
            return reason
        detected = int(self.stickers.detected[frame])
        apart = ""
        if detected > seen:
            apart = (
                f"; the rays of {detected - seen} of these miss each other by more than is stated"
            )
        return (
            f"{reason}: of {searched} that were searched, the detector found {detected} in both "
            f"images{apart}"
        )


def solve_frames(
    seen: StickerObservation, near: Array, observer: Observer, body: MarkedBody, places: Array
) -> SolvedFrames:
    """Return the poses of a body in f frames.

    ``near`` (f, 4, 4) are first guesses of camera_from_body, and ``places`` (n, 3) the taught
    places of the body's stickers, m. In ``seen``, sticker k of frame j has the index j n + k, as in
    ``Observer.read``.
    """
    # Imported late, because importing numba takes time.
    from cmmsim.measuring import solver_kernels as kernels

    frames = len(near)
    frame_of, sticker = np.divmod(seen.index, len(places))
    starts = np.searchsorted(frame_of, np.arange(frames + 1)).astype(int)
    searched = np.diff(starts) if seen.searched is None else seen.searched
    used = np.ones(len(frame_of), dtype=bool)
    covariances = np.array(seen.covariances)
    stickers = kernels.ObservedStickers(
        used,
        np.ascontiguousarray(seen.points),
        np.linalg.inv(covariances),
        covariances,
        np.empty((len(frame_of), 3)),
        np.empty((len(frame_of), 3)),
        np.ascontiguousarray(seen.rays),
        body.plane_index[sticker],
    )
    camera_from_body = np.array(near, dtype=float)
    pose_covariances = np.zeros((frames, 6, 6))
    shared = np.zeros((frames, 6, 6))
    verdicts = np.zeros((frames, kernels.COLUMNS))
    outlines = _outlines(seen, observer, body.sticker_normals[sticker])
    limits = solver_limits(len(places), observer.settings)
    taught = np.ascontiguousarray(places[sticker])
    kernels.solve_frames(
        *(stickers, taught, outlines, limits, starts, searched),
        *(_images(seen, observer, frames), camera_from_body, pose_covariances, shared, verdicts),
    )
    return SolvedFrames(
        camera_from_body,
        pose_covariances,
        replace(seen, covariances=covariances),
        used,
        starts,
        shared,
        verdicts,
        body,
        places,
    )


def solve_frame(
    seen: StickerObservation, near: Array, observer: Observer, body: MarkedBody, places: Array
) -> SolvedFrames:
    """Return the pose of a body in one frame, as ``solve_frames`` does for several.

    ``near`` (4, 4) is a first guess of camera_from_body. Raises LostError if the frame is lost, for
    example because too few stickers agree.
    """
    solved = solve_frames(seen, near[None], observer, body, places)
    if solved.lost[0]:
        raise solved.error(0)
    return solved


def solver_limits(
    stickers: int, settings: DetectionSettings, step_tolerance: float = STEP_TOLERANCE
) -> SolverLimits:
    """Return the compiled solver's limits for frames with at most this number of stickers.

    ``step_tolerance`` is in rad. If the stated errors of the rig are not zero, they warp every
    frame, and their effect is part of the poses' common errors. Warps, slips and delays are then
    not tested.
    """
    # Imported late, because importing numba takes time.
    from cmmsim.measuring.solver_kernels import SolverLimits

    return SolverLimits(
        LARGEST_MISFIT,
        LARGEST_EXCESS,
        FEWEST,
        SMALLEST_SHARE,
        SMALLEST_SPREAD,
        step_tolerance,
        _largest_totals(3 * stickers),
        EXCESS_SHARE,
        _tails(3 * stickers),
        LARGEST_WARP,
        WARP_SHARE,
        LARGEST_SLIP,
        FEWEST_RIVALS,
        settings.line_error_px == 0.0,
    )


def lost_reason(verdict: Array, first: str, left: Array) -> str:
    """Return the reason why a frame is lost.

    ``verdict`` has the columns of ``solver_kernels``. ``first`` is the name of the sticker that was
    rejected first. ``left`` (n, 3) are the taught places of the stickers that were not rejected.
    """
    # Imported late, because importing numba takes time.
    from cmmsim.measuring import solver_kernels as kernels

    seen = int(verdict[kernels.SEEN])
    count = int(verdict[kernels.LEFT])
    if verdict[kernels.RIVALS] > 0:
        return (
            f"{count} visible stickers agree on one pose and {verdict[kernels.RIVALS]:.0f} on "
            f"another; the first that contradicts is {first}; a group of stickers has moved"
        )
    if count >= FEWEST and count > seen - count:
        try:
            require_spread(left)
        except LostError as error:
            return str(error)
    if verdict[kernels.FIRST] < 0:
        return f"{seen} visible stickers, at least {FEWEST} are needed to detect a wrong one"
    place = verdict[kernels.PLACE]
    outline = verdict[kernels.OUTLINE]
    misfit = f"{place:.0f} of its place" if place >= outline else f"{outline:.0f} of its outline"
    cause = f"with squared misfit {misfit}, at most {LARGEST_MISFIT:.1f}"
    if max(place, outline) <= LARGEST_MISFIT:
        cause = (
            f"because the mean square of all residuals exceeds {LARGEST_EXCESS:g} times that of "
            "noise"
        )
    return (
        f"{seen} visible stickers contradict each other, {count} are left after {seen - count} "
        f"were rejected; at least {FEWEST} and more than the rejected ones are needed; the first "
        f"rejected one is {first}, {cause}"
    )


@lru_cache(maxsize=16)
def _largest_totals(freedom: int) -> Array:
    """Return the largest sums of squared residuals that noise explains.

    They are for 0 to ``freedom`` degrees of freedom.
    """
    return np.asarray(chdtri(np.maximum(np.arange(freedom + 1), 1), EXCESS_CHANCE))


@lru_cache(maxsize=16)
def _tails(freedom: int) -> Array:
    """Return the factors on a pose's covariance if its scale is estimated from residuals.

    They are for residuals with 0 to ``freedom`` degrees of freedom. The pose then has Student's
    distribution. With the factor, a normal distribution has the same quantile TAIL of the squared
    error.
    """
    freedoms = np.maximum(np.arange(freedom + 1), 1)
    return np.asarray(6.0 * fdtri(6, freedoms, TAIL) / chdtri(6, 1.0 - TAIL))


def no_outlines(rig: StereoRig) -> Outlines:
    """Return the compiled solver's input for a detector that states no ellipses."""
    # Imported late, because importing numba takes time.
    from cmmsim.measuring.outline_kernels import Outlines

    shapes = np.zeros((0, 2, 3))
    return Outlines(shapes, np.zeros((0, 2, 6)), np.zeros((0, 3)), 0.0, rig.kernel_cameras)


def _images(seen: StickerObservation, observer: Observer, frames: int) -> Images:
    """Return the compiled solver's input with the centres of stickers in both images."""
    # Imported late, because importing numba takes time.
    from cmmsim.measuring.shared_error_kernels import Images

    spreads = np.zeros((len(seen.index), 2, 2, 2)) if seen.spreads is None else seen.spreads
    shifts = np.zeros((frames, 2)) if seen.shifts is None else seen.shifts
    ends = np.zeros((frames, 2, 4, 4)) if seen.frame_ends is None else seen.frame_ends
    return Images(
        np.stack([seen.left_pixels, seen.right_pixels], axis=1),
        np.ascontiguousarray(spreads),
        shifts,
        np.ascontiguousarray(ends),
        observer.rig.kernel_cameras,
    )


def _outlines(seen: StickerObservation, observer: Observer, normals: Array) -> Outlines:
    """Return the compiled solver's input with the ellipses of stickers with normals (k, 3)."""
    inputs = no_outlines(observer.rig)
    if seen.outlines is None:
        return inputs
    rows = [0, 0, 0, 1, 1, 2]
    columns = [0, 1, 2, 1, 2, 2]
    entries = seen.outlines.shapes[..., [0, 0, 1], [0, 1, 1]]
    inverse = np.linalg.inv(seen.outlines.covariances)[..., rows, columns]
    return inputs._replace(
        shapes=np.ascontiguousarray(entries.swapaxes(0, 1)),
        informations=np.ascontiguousarray(inverse.swapaxes(0, 1)),
        normals=np.ascontiguousarray(normals),
        radius=observer.settings.radius,
    )
