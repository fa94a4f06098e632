"""Causes for which photographs teach nothing: folders exchanged, shifted, or of one camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from cmmsim.errors import LostError
from cmmsim.files.rig_and_bodies import MarkedBody
from cmmsim.measuring.observation import Observer
from cmmsim.photographs.matching import Spots, candidates, match

# Both images of a pair are of one camera if this share of the spots is at the same place, px.
SAME_SHARE = 0.7
SAME_PX = 1.5
# Numbers of pairs by which the images of one folder may be late.
SHIFTS = (1, -1, 2, -2)


def cause_of(
    spots: Sequence[Spots],
    names: Sequence[str],
    observer: Observer,
    base: MarkedBody,
    platform: MarkedBody,
) -> str:
    """Return the cause for which no body was found in the spots of K pairs, or an empty text."""
    counts = [min(len(one.centres[one.good]) for one in pair) for pair in spots]
    if max(counts) == 0:
        return (
            f"no bright spots in both images of any of {len(spots)} pairs, such as {names[0]}: "
            "stickers must be bright discs in dark rings, or the file must say otherwise"
        )

    def works(pairs: Sequence[Spots]) -> bool:
        try:
            match([candidates(one, observer) for one in pairs], platform, base, names)
        except LostError:
            return False
        return True

    if sum(map(_same, spots)) > 0.5 * len(spots):
        return (
            f"both images of a pair, such as {names[0]}, show the stickers at the same pixels: "
            "are both folders of one camera?"
        )
    if works([(right, left) for left, right in spots]):
        return "left and right are exchanged: give the two folders in the other order"
    for shift in SHIFTS:
        count = len(spots) - abs(shift)
        first = [left for left, _ in spots[max(-shift, 0) :][:count]]
        second = [right for _, right in spots[max(shift, 0) :][:count]]
        if count > 2 and works(list(zip(first, second, strict=True))):
            side = "left" if shift > 0 else "right"
            return (
                f"the images do not belong together: they do if the first {abs(shift)} of the "
                f"{'right' if shift > 0 else 'left'} folder, from {names[0]} on, are left out; "
                f"did the {side} camera start later?"
            )
    return ""


def _same(pair: Spots) -> bool:
    """Tell whether the spots of both images are at the same pixels."""
    left, right = (one.centres[one.good] for one in pair)
    if not len(left) or not len(right):
        return False
    gaps = cKDTree(right).query(left)[0]
    return bool(np.mean(gaps < SAME_PX) > SAME_SHARE)
