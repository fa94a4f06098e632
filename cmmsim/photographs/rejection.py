"""Adjustment that leaves out single centres, pairs and stickers that contradict the rest.

The worst centres are left out if their squared residuals are larger than chance allows, and the
adjustment is repeated. A pair or a sticker is left out as a whole if most of its centres are left
out. A sticker is also left out if its centres show that it moved. The result names the reasons.

All residuals can be larger than the noise that the fits of ellipses state. The noise is then
enlarged such that it explains the residuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from cmmsim.errors import LostError
from cmmsim.geometry.pose import Array, apply, invert
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.geometry.triangulation import triangulate
from cmmsim.photographs.bundle import Bundle, BundleState, Observations, adjust

# Probability that a good observation counts as an outlier.
CHANCE = 1e-5
# Limit and median of the squares of good observations. Their distribution is chi-square with four
# degrees of freedom.
LARGEST_SQUARE = float(chdtri(4, CHANCE))
MEDIAN_SQUARE = float(chdtri(4, 0.5))
# A centre counts as nearly the worst of its sticker if its squared residual exceeds this fraction
# of the sticker's largest one.
NEARLY = 0.5
# Probability that residuals count as larger than noise although they are not.
EXCESS_CHANCE = 1e-4
# Largest number of rounds in which centres are left out.
ROUNDS = 40
# A pair is left out if fewer stickers of the platform remain in it.
FEWEST = 4
# A pair or a sticker is left out if less than this fraction of its centres remains.
LARGEST_SHARE = 0.5
# A sticker has moved if its position jumps by more than this multiple of the scatter about both
# positions.
CLEAR_JUMP = 4.0


@dataclass(frozen=True)
class Judged:
    """Adjustment with what it left out.

    seen      observations in use
    bundle    their adjustment
    pairs     reasons by the index of a pair whose platform is left out
    stickers  reasons by the index of a sticker that is left out
    singles   number of observations that are left out although their pair and sticker are in use
    """

    seen: Observations
    bundle: Bundle
    pairs: dict[int, str]
    stickers: dict[int, str]
    singles: int


def adjust_robustly(
    seen: Observations,
    start: BundleState,
    known: StereoRig,
    prior: Array,
    names: Sequence[str],
) -> Judged:
    """Adjust a state to the observations that agree; ``names`` (K,) are those of the pairs.

    The ``factor`` of the result is that before the noise is enlarged. Raises LostError if fewer
    than two pairs remain, or if an adjustment does not converge.
    """
    kept = np.ones(len(seen.pair), dtype=bool)
    left_out: tuple[dict[int, str], dict[int, str]] = ({}, {})
    state = start
    # the last adjustment follows the last rejection, so that it uses no centre that is left out
    for rejections in range(ROUNDS + 1):
        used = seen.selected(kept)
        bundle = adjust(used, state, known, prior)
        state = bundle.state
        scale = max(1.0, float(np.median(bundle.squares)) / MEDIAN_SQUARE)
        worst = _worst(used, bundle.squares / scale)
        if not len(worst) or rejections == ROUNDS:
            break
        kept[np.flatnonzero(kept)[worst]] = False
        left_out = _left_out(seen, state, kept, names)
        if len(np.unique(seen.pair[kept & seen.moves])) < 2:
            raise LostError(
                "fewer than two pairs agree with each other: do the images of each pair belong "
                "together?"
            )
    pairs, stickers = left_out
    whole = np.isin(seen.sticker, list(stickers)) | (np.isin(seen.pair, list(pairs)) & seen.moves)
    if bundle.factor > chdtri(bundle.freedom, EXCESS_CHANCE) / bundle.freedom:
        used = replace(used, covariances=used.covariances * bundle.factor)
        enlarged = adjust(used, state, known, prior)
        bundle = replace(enlarged, factor=bundle.factor)
    return Judged(used, bundle, pairs, stickers, int(np.sum(~kept & ~whole)))


def _worst(seen: Observations, squares: Array) -> NDArray[np.int_]:
    """Return the indices of the observations that are left out next.

    A wrong centre pulls the position of its sticker and the pose of its pair, so that right centres
    seem wrong as well. A centre is therefore left out only if it is nearly the worst of its sticker
    and, on the platform, the worst of its pair.
    """
    of_sticker = np.zeros(seen.sticker.max() + 1)
    np.maximum.at(of_sticker, seen.sticker, squares)
    of_pair = np.zeros(seen.pair.max() + 1)
    np.maximum.at(of_pair, seen.pair[seen.moves], squares[seen.moves])
    worst = (squares > LARGEST_SQUARE) & (squares > NEARLY * of_sticker[seen.sticker])
    return np.flatnonzero(worst & (~seen.moves | (squares == of_pair[seen.pair])))


def _left_out(
    seen: Observations, state: BundleState, kept: NDArray[np.bool_], names: Sequence[str]
) -> tuple[dict[int, str], dict[int, str]]:
    """Leave out stickers that moved, and pairs and stickers that have lost too many centres.

    Return the reasons, first for pairs, then for stickers. The mask ``kept`` (m,) of observations
    in use is changed in place.
    """
    pairs: dict[int, str] = {}
    stickers: dict[int, str] = {}
    for sticker in np.unique(seen.sticker).tolist():
        own = seen.sticker == sticker
        if np.sum(~kept[own]) < 2:
            continue
        if moved := _movement(seen.selected(own), state, names):
            stickers[sticker] = moved
        elif kept[own].mean() < LARGEST_SHARE:
            stickers[sticker] = (
                "does not agree with the others: is it hidden, damaged or not round?"
            )
    kept[np.isin(seen.sticker, list(stickers))] = False
    judged = seen.moves & ~np.isin(seen.sticker, list(stickers))
    for pair in np.unique(seen.pair[judged]).tolist():
        own = judged & (seen.pair == pair)
        count = int(kept[own].sum())
        if count < max(FEWEST, LARGEST_SHARE * own.sum()):
            kept[own] = False
            pairs[pair] = (
                f"{count} of {own.sum()} stickers of the platform agree with the other pairs: do "
                "its images belong together?"
            )
    return pairs, stickers


def _movement(mine: Observations, state: BundleState, names: Sequence[str]) -> str:
    """Return a text that states when and how far a sticker has moved, or an empty text."""
    points = triangulate(state.rig, *mine.pixels, *mine.covariances).points
    poses = state.poses[mine.pair]
    positions = np.array(
        [
            apply(invert(pose), point) if moves else point
            for pose, point, moves in zip(poses, points, mine.moves, strict=True)
        ]
    )
    order = np.argsort(mine.pair)
    positions = positions[order]
    # The best split in time leaves the least scatter about the mean positions before and after.
    splits = [(positions[:k], positions[k:]) for k in range(1, len(positions))]
    scatter = [
        sum(float(np.sum((part - part.mean(axis=0)) ** 2)) for part in parts) for parts in splits
    ]
    if scatter:
        k = int(np.argmin(scatter))
        jump = float(np.linalg.norm(np.subtract(*(part.mean(axis=0) for part in splits[k]))))
        if jump > CLEAR_JUMP * np.sqrt(scatter[k] / len(positions)):
            before, after = (names[mine.pair[order][j]] for j in (k, k + 1))
            return f"moved by {1e3 * jump:.2f} mm between {before} and {after}"
    return ""
