"""Which observed stickers contradict the others, and whether what is left can be trusted.

The taught places are laid onto the observed stickers. A sticker is left out, the worst one first, when

- its place differs from where all others put it (data snooping: the residual r against its own covariance
  S - J C J', which a sticker's pull on the pose makes smaller than its noise S), or
- its ellipse in one image differs from the one a whole sticker would show there: a partly hidden sticker, or a bright
  spot that touches it, moves the centre and the rim alike.

Undetected errors of both kinds are then of the size of the noise. At least four stickers must be left, since with three
a wrong one cannot be told, and more than were left out.

All residuals may be larger than noise: a camera has drifted since its calibration, or several stickers are a little
wrong. Places are then judged against the residuals of the others, and the covariances grow by the same factor (Birge
ratio), up to a limit.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from cmmsim.errors import LostError
from cmmsim.files.setup import MarkedBody
from cmmsim.geometry.disc_image import sticker_outlines
from cmmsim.geometry.pose import Array, skew
from cmmsim.geometry.registration import (
    SMALLEST_SPREAD,
    Registration,
    register,
    register_each,
    rigid_starts,
    spreads,
)
from cmmsim.pose_estimation.observation import Observer, StickerObservation

CHANCE = 1e-4  # of a good sticker to be left out, for its place and for each of its two ellipses
EXCESS_CHANCE = 1e-4  # of a good frame's residuals to be taken for larger than noise
LARGEST_EXCESS = 6.0  # of the residuals' mean square over that of noise
LARGEST_MISFIT = float(chi2.isf(CHANCE, 3))
FEWEST = 4
SMALLEST_REDUNDANCY = 0.01  # share of a sticker's noise that shows in its residual, below which nothing can be checked


@dataclass(frozen=True)
class StickerChecks:
    """Squared differences (n,), three degrees of freedom each: of a sticker's place from where the others put it, in
    units of its noise or of the others' larger residuals, and of its worse ellipse from that of a whole sticker."""

    place: Array
    outline: Array

    @property
    def worst(self) -> int:
        """The sticker that differs most."""
        return int(np.maximum(self.place, self.outline).argmax())

    def passed(self, k: int) -> bool:
        """Whether sticker k agrees."""
        return max(float(self.place[k]), float(self.outline[k])) <= LARGEST_MISFIT

    def reason(self, k: int) -> str:
        """What is wrong with sticker k, with value and limit."""
        name, value = ("place", self.place[k]) if self.place[k] >= self.outline[k] else ("outline", self.outline[k])
        return f"squared misfit {value:.0f} of its {name}, at most {LARGEST_MISFIT:.1f}"


def consistent(
    observation: StickerObservation, observer: Observer, body: MarkedBody, places: Array
) -> tuple[StickerObservation, Registration]:
    """The stickers of a body, taught at ``places`` (n,3), that agree with each other, and their registration.

    Raises LostError when too few agree.
    """
    seen = len(observation.index)
    left_out: list[str] = []
    while True:
        if len(observation.index) < FEWEST or len(observation.index) <= len(left_out):
            raise LostError(_too_few(len(observation.index), seen, left_out))
        result = register(places[observation.index], observation.points, observation.covariances)
        checks = _checks(observation, result, observer, body, places)
        excess = residual_excess(float(result.misfit.sum()), 3 * len(result.misfit) - 6)
        worst = checks.worst
        if checks.passed(worst) and excess <= LARGEST_EXCESS:
            return (
                replace(observation, covariances=excess * observation.covariances),
                replace(result, covariance=excess * result.covariance),
            )
        left_out.append(f"{body.sticker_ids[observation.index[worst]]}: {checks.reason(worst)}")
        observation = observation.selected(np.arange(len(observation.index)) != worst)


def place_misfits(
    result: Registration, points: Array, places: Array, covariances: Array, of: NDArray[np.int_] | None = None
) -> Array:
    """Squared residuals (n,) of a registration, each in units of its own covariance.

    Parameters: points (n,3) measured with covariances (n,3,3), and places (n,3) known; of (n,): to which of several
    registrations each belongs. Directions in which a sticker alone determines the pose are left out.
    """
    from cmmsim.geometry.point_kernels import residual_misfits  # compiles, so it is loaded where it is first needed

    own = np.zeros(len(points), dtype=int) if of is None else of
    transforms, spread = result.transform.reshape(-1, 4, 4), result.covariance.reshape(-1, 6, 6)
    misfits = np.empty(len(points))
    places, points, covariances = (np.ascontiguousarray(v, dtype=float) for v in (places, points, covariances))
    residual_misfits(transforms, spread, own, places, points, covariances, SMALLEST_REDUNDANCY, misfits)
    few = np.isnan(misfits)
    if few.any():
        each = transforms[own[few]], spread[own[few]]
        misfits[few] = _shown_misfits(*each, points[few], places[few], covariances[few])
    return misfits


def _shown_misfits(transforms: Array, spreads: Array, points: Array, places: Array, covariances: Array) -> Array:
    """Squared residuals (n,) as of ``place_misfits`` without the directions in which a sticker alone determines the
    pose: each has its transform (n,4,4) and covariance (n,6,6)."""
    turned = np.einsum("nij,nj->ni", transforms[:, :3, :3], places)
    jacobian = np.concatenate([np.broadcast_to(np.eye(3), (len(turned), 3, 3)), -skew(turned)], axis=2)
    # in the axes in which the noise is the unit matrix
    whiten = np.linalg.inv(np.linalg.cholesky(covariances))
    pulled = whiten @ jacobian
    redundancy, axes = np.linalg.eigh(np.eye(3) - pulled @ spreads @ pulled.swapaxes(1, 2))
    residuals = np.einsum("nji,njk,nk->ni", axes, whiten, points - turned - transforms[:, :3, 3])
    shown = redundancy > SMALLEST_REDUNDANCY
    return np.asarray((residuals**2 / np.where(shown, redundancy, np.inf)).sum(axis=1))


def outline_misfits(observation: StickerObservation, shapes: Array) -> Array:
    """Squared difference (2, n) of observed ellipses from expected ones with ``shapes`` (2, n, 2, 2), px."""
    if observation.outlines is None:
        return np.zeros((2, len(observation.index)))
    change = (observation.outlines.shapes - shapes)[..., [0, 0, 1], [0, 1, 1]]
    return np.asarray((change * np.linalg.solve(observation.outlines.covariances, change[..., None])[..., 0]).sum(-1))


def all_consistent(
    observation: StickerObservation, observer: Observer, body: MarkedBody, places: Array, count: int
) -> tuple[Registration, Array]:
    """Registrations of ``count`` exposures in which all stickers agree with each other at once, as ``consistent`` has
    it, and by how much (count,) their covariances grow: NaN in those in which they do not, or too few are seen.

    The observation's index says exposure and sticker, as of ``Observer.read``.
    """
    of, sticker = np.divmod(observation.index, len(places))
    shown, points = np.zeros((count, len(places), 1)), np.zeros((count, len(places), 3))
    shown[of, sticker], points[of, sticker] = 1.0, observation.points
    seen: NDArray[np.int_] = np.bincount(of, minlength=count).astype(int)
    enough = (seen >= FEWEST) & (spreads(places, shown) >= SMALLEST_SPREAD)
    rough = np.tile(np.eye(4), (count, 1, 1))
    rough[enough] = rigid_starts(places, points[enough], shown[enough, :, 0])
    observation = observation.selected(enough[of])
    of, sticker = np.divmod(observation.index, len(places))
    starts = np.searchsorted(of, np.arange(count + 1)).astype(int)
    result = register_each(places[sticker], observation.points, observation.covariances, starts, rough)
    totals = np.bincount(of, result.misfit, count)
    place = place_misfits(result, observation.points, places[sticker], observation.covariances, of)
    place = place / excesses(totals[of] - place, 3 * seen[of] - 9)
    normals, radius = body.sticker_normals[sticker], observer.settings.radius
    shapes = sticker_outlines(observer.rig, result.transform[of], places[sticker], normals, radius)[1]
    wrong = np.maximum(place, outline_misfits(observation, shapes).max(axis=0)) > LARGEST_MISFIT
    excess = excesses(totals, 3 * seen - 6)
    agree = enough & (np.bincount(of, wrong, count) == 0) & (excess <= LARGEST_EXCESS)
    return result, np.where(agree, excess, np.nan)


def _checks(
    observation: StickerObservation, result: Registration, observer: Observer, body: MarkedBody, places: Array
) -> StickerChecks:
    index = observation.index
    place = place_misfits(result, observation.points, places[index], observation.covariances)
    total, freedom = float(result.misfit.sum()), 3 * len(index) - 9  # without a sticker, its place misfit is missing
    place = place / excesses(total - place, np.full(len(place), freedom))
    normals, radius = body.sticker_normals[index], observer.settings.radius
    shapes = sticker_outlines(observer.rig, result.transform, places[index], normals, radius)[1]
    return StickerChecks(place, outline_misfits(observation, shapes).max(axis=0))


def residual_excess(total: float, freedom: int) -> float:
    """Mean square of residuals in units of their noise where it is larger than noise makes it, else 1."""
    return total / freedom if total > _largest_total(freedom) else 1.0


def excesses(totals: NDArray, freedoms: NDArray[np.int_]) -> Array:
    """``residual_excess`` of each of several sums (n,) of squares; 1 without freedom."""
    freedoms = np.maximum(freedoms, 1)
    largest = np.array([_largest_total(freedom) for freedom in range(1, int(freedoms.max(initial=1)) + 1)])
    return np.where(totals > largest[freedoms - 1], totals / freedoms, 1.0)


@lru_cache(maxsize=64)
def _largest_total(freedom: int) -> float:
    return float(chi2.isf(EXCESS_CHANCE, freedom))


def _too_few(left: int, seen: int, left_out: list[str]) -> str:
    """The reason why what is left cannot be trusted."""
    if not left_out:
        return f"{seen} visible stickers, at least {FEWEST} are needed to tell a wrong one"
    return (
        f"{seen} visible stickers contradict each other, {left} are left where at least {FEWEST} and more than the "
        f"{len(left_out)} that were left out are needed; the first was {left_out[0]}"
    )
