"""Poses of a body from its observed stickers, without stickers that contradict the others.

The taught places are fitted to the observed stickers. Stickers are rejected one by one, the worst
one first, in two cases:

- The place of a sticker differs from the place that the other stickers predict. This test is data
  snooping. The residual is compared with its own covariance S - J C J'. S is the covariance of the
  sticker's noise, C the covariance of the pose, and J the derivative of the sticker's place by the
  pose. S - J C J' is smaller than S, because each sticker pulls the pose towards itself.
- The ellipse of a sticker in one image differs from the ellipse of an unhidden sticker. If a
  sticker is partly hidden or touches another bright spot, its centre and its rim both move.

Undetected errors of both kinds are then of the size of the noise. At least four stickers must
remain, because a wrong sticker among three cannot be identified. More stickers must remain than
were rejected.

All residuals can be larger than noise, for example if a camera has drifted since its calibration,
or several stickers are slightly misplaced. Each place is then compared with the size of the other
stickers' residuals. All covariances are multiplied by the mean square of the residuals in units of
their noise (squared Birge ratio), up to a limit.

The computation is compiled, in ``solver_kernels``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from cmmsim.errors import LostError
from cmmsim.files.rig_and_bodies import MarkedBody
from cmmsim.geometry.pose import Array
from cmmsim.geometry.registration import SMALLEST_SPREAD, require_spread
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.measuring.observation import Observer, StickerObservation

if TYPE_CHECKING:
    from cmmsim.measuring.solver_kernels import Outlines, SolverLimits

# Probability that a good sticker is rejected, for its place and for each of its two ellipses.
CHANCE = 1e-4
# Probability that the residuals of a good frame count as larger than noise.
EXCESS_CHANCE = 1e-4
# Largest mean square of the residuals in units of their noise.
LARGEST_EXCESS = 6.0
LARGEST_MISFIT = float(chdtri(3, CHANCE))
# Smallest number of stickers that must remain.
FEWEST = 4
# Smallest share of a sticker's noise that must appear in its residual; below, it is not tested.
SMALLEST_SHARE = 0.01
# rad: a fit ends after a step with a smaller rotation.
STEP_TOLERANCE = 1e-8


@dataclass(frozen=True)
class SolvedFrames:
    """Poses of a body in f frames, and the stickers from which they were computed.

    camera_from_body  (f, 4, 4)
    covariances       (f, 6, 6), of the small errors [dt, dphi] of camera_from_body
    stickers          the k stickers of all frames, with enlarged covariances if residuals are
                      larger than noise
    used              (k,), False for rejected stickers
    starts            (f + 1,); frame j has the stickers ``starts[j]`` to ``starts[j + 1]``
    verdicts          (f, COLUMNS), reasons why frames are lost
    places            (n, 3), taught places on ``body``
    """

    camera_from_body: Array
    covariances: Array
    stickers: StickerObservation
    used: NDArray[np.bool_]
    starts: NDArray[np.int_]
    verdicts: Array
    body: MarkedBody
    places: Array

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Frames (f,) without a pose."""
        return self.verdicts[:, 0] != 0

    def of(self, frame: int) -> StickerObservation:
        """Return the stickers from which the pose of a frame was computed.

        The ``index`` of the result refers to the body's stickers.
        """
        own = np.zeros(len(self.used), dtype=bool)
        own[self.starts[frame] : self.starts[frame + 1]] = True
        seen = self.stickers.selected(own & self.used)
        return replace(seen, index=seen.index % len(self.places))

    def reason(self, frame: int) -> str:
        """Return the reason why a frame is lost."""
        # Imported late, because importing numba takes time.
        from cmmsim.measuring.solver_kernels import FIRST

        verdict = self.verdicts[frame]
        first = ""
        if verdict[FIRST] >= 0:
            row = self.starts[frame] + int(verdict[FIRST])
            first = str(self.body.sticker_ids[self.stickers.index[row] % len(self.places)])
        return lost_reason(verdict, first, self.places[self.of(frame).index])


def solve_frames(
    seen: StickerObservation, near: Array, observer: Observer, body: MarkedBody, places: Array
) -> SolvedFrames:
    """Solve f frames near camera_from_body ``near`` (f,4,4), with stickers taught at ``places``.

    In ``seen``, sticker k of frame j has the index j n + k, as in ``Observer.read``. There are n
    places.
    """
    # Imported late, because importing numba takes time.
    from cmmsim.measuring import solver_kernels as kernels

    frames = len(near)
    of, sticker = np.divmod(seen.index, len(places))
    starts = np.searchsorted(of, np.arange(frames + 1)).astype(int)
    used = np.ones(len(of), dtype=bool)
    covariances = np.array(seen.covariances)
    rows = kernels.ObservedStickers(
        used,
        np.ascontiguousarray(seen.points),
        np.linalg.inv(covariances),
        covariances,
        np.empty((len(of), 3)),
        np.empty((len(of), 3)),
    )
    camera_from_body = np.array(near, dtype=float)
    spreads = np.zeros((frames, 6, 6))
    verdicts = np.zeros((frames, kernels.COLUMNS))
    outlines = _outlines(seen, observer, body.sticker_normals[sticker])
    limits = solver_limits(len(places))
    taught = np.ascontiguousarray(places[sticker])
    kernels.solve_frames(
        rows, taught, outlines, limits, starts, camera_from_body, spreads, verdicts
    )
    return SolvedFrames(
        camera_from_body,
        spreads,
        replace(seen, covariances=covariances),
        used,
        starts,
        verdicts,
        body,
        places,
    )


def consistent(
    seen: StickerObservation, near: Array, observer: Observer, body: MarkedBody, places: Array
) -> tuple[StickerObservation, Array, Array]:
    """Return the stickers of one frame that agree with each other, and the pose from them.

    The pose is camera_from_body (4, 4) with its covariance (6, 6). ``near`` (4, 4) is a first guess
    of the pose. Raises LostError if too few stickers agree.
    """
    solved = solve_frames(seen, near[None], observer, body, places)
    if solved.lost[0]:
        raise LostError(solved.reason(0))
    return solved.of(0), solved.camera_from_body[0], solved.covariances[0]


def solver_limits(stickers: int, step_tolerance: float = STEP_TOLERANCE) -> SolverLimits:
    """Return the compiled solver's limits for frames with at most this number of stickers."""
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
    )


def lost_reason(verdict: Array, first: str, left: Array) -> str:
    """Return the reason why a frame is lost.

    ``first`` names the sticker that was rejected first. ``left`` (n, 3) are the taught places of
    the stickers that were not rejected.
    """
    # Imported late, because importing numba takes time.
    from cmmsim.measuring import solver_kernels as kernels

    seen = int(verdict[kernels.SEEN])
    count = int(verdict[kernels.LEFT])
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
    return (
        f"{seen} visible stickers contradict each other, {count} are left after {seen - count} "
        f"were rejected; at least {FEWEST} and more than the rejected ones are needed; the first "
        f"rejected one is {first} with squared misfit {misfit}, at most {LARGEST_MISFIT:.1f}"
    )


@lru_cache(maxsize=16)
def _largest_totals(freedom: int) -> Array:
    """Return the largest sum of squared residuals that noise explains, for 0 to ``freedom`` degrees
    of freedom.
    """
    return np.asarray(chdtri(np.maximum(np.arange(freedom + 1), 1), EXCESS_CHANCE))


def no_outlines(rig: StereoRig) -> Outlines:
    """Return the compiled solver's input for a detector that states no ellipses."""
    # Imported late, because importing numba takes time.
    from cmmsim.measuring.solver_kernels import Outlines

    shapes = np.zeros((0, 2, 3))
    return Outlines(shapes, np.zeros((0, 2, 6)), np.zeros((0, 3)), 0.0, rig.kernel_cameras)


def _outlines(seen: StickerObservation, observer: Observer, normals: Array) -> Outlines:
    """Return the compiled solver's input with the ellipses of stickers with normals (k, 3)."""
    known = no_outlines(observer.rig)
    if seen.outlines is None:
        return known
    rows = [0, 0, 0, 1, 1, 2]
    columns = [0, 1, 2, 1, 2, 2]
    entries = seen.outlines.shapes[..., [0, 0, 1], [0, 1, 1]]
    inverse = np.linalg.inv(seen.outlines.covariances)[..., rows, columns]
    return known._replace(
        shapes=np.ascontiguousarray(entries.swapaxes(0, 1)),
        informations=np.ascontiguousarray(inverse.swapaxes(0, 1)),
        normals=np.ascontiguousarray(normals),
        radius=observer.settings.radius,
    )
