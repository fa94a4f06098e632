"""Causes of a failed or poor teaching from photographs.

The two folders may be exchanged, may be shifted by some images, or may both come from one camera.
The images may be blurred, or noisier than stated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from cmmsim.errors import LostError
from cmmsim.files.rig_and_bodies import MarkedBody
from cmmsim.measuring.observation import Observer, StickerExposure
from cmmsim.photographs.matching import Spots, candidates, match, spots_in
from cmmsim.photographs.pairs import Photograph

# Both images of a pair count as images of one camera if more than this fraction of the left spots
# have a right spot within SAME_PX.
SAME_SHARE = 0.7
SAME_PX = 1.5
# Shifts between the two folders that are tried, in images; positive if the left camera started
# later.
SHIFTS = (1, -1, 2, -2)
# Standard deviations of the point spreads that are tried for images that do not fit, px.
SPREADS = (0.3, 0.45, 0.6, 0.8, 1.0, 1.3)


def cause_of(
    error: LostError,
    spots: Sequence[Spots],
    names: Sequence[str],
    observer: Observer,
    base: MarkedBody,
    platform: MarkedBody,
) -> str:
    """Return the cause of a failed teaching, judged by the ``spots`` of K pairs with ``names``.

    If no cause is found, the result is the text of ``error``. A hint follows if the images show
    enough spots.
    """
    counts = [min(len(one.centres[one.good]) for one in pair) for pair in spots]
    if max(counts) == 0:
        dark = observer.settings.dark
        stated, relation = ("dark", "below") if dark else ("bright", "above")
        return (
            f"no {stated} spots in both images of any of {len(spots)} pairs, such as {names[0]}: "
            f"the sensor file states {stated} discs, because stickers.sticker_level is {relation} "
            "stickers.ring_level; are yours the reverse, and do the images show stickers at all?"
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
                f"the images do not belong together, but do without the first {abs(shift)} of the "
                f"{'right' if shift > 0 else 'left'} folder, from {names[0]} on; did the {side} "
                "camera start later?"
            )
    typical = int(np.median(counts))
    if typical < len(platform.sticker_ids) or works(spots):
        return str(error)
    return (
        f"{error}, although both images of a pair, such as {names[0]}, show about {typical} bright "
        "spots: do the images of a pair belong together, and does the sensor file state these "
        "cameras and stickers?"
    )


def _same(pair: Spots) -> bool:
    """Return True if most spots of both images are at the same pixels."""
    left, right = (one.centres[one.good] for one in pair)
    if not len(left) or not len(right):
        return False
    distances = cKDTree(right).query(left)[0]
    return bool(np.mean(distances < SAME_PX) > SAME_SHARE)


def light_doubt(photograph: Photograph, spots: Spots, observer: Observer) -> str:
    """Return a text about a wrong noise or point spread in the sensor file, or an empty text.

    Measuring rejects stickers whose grey values differ too much from a blurred disc. The text names
    the point spread that fits best. For a simulated exposure without images, the text is empty.
    """
    chi2 = _misfit(spots)
    limit = observer.settings.limits.largest_misfit
    if chi2 <= limit or isinstance(photograph.images, StickerExposure):
        return ""
    tried = {}
    for psf_px in SPREADS:
        optics = replace(observer.settings.optics, psf_px=psf_px)
        blurred = replace(observer, settings=replace(observer.settings, optics=optics))
        tried[psf_px] = _misfit(spots_in(photograph.images, blurred))
    best = min(tried, key=lambda psf_px: tried[psf_px])
    said = (
        f"{photograph.name}: squared residuals of grey values are {chi2:.2g} times the noise that "
        f"the sensor file states, and cmmsim measure refuses stickers above {limit:g}: "
    )
    if tried[best] < limit:
        return f"{said}with lens.psf_px = {best:g} they are {tried[best]:.2g} times"
    dark = observer.noise.dark_noise
    more = dark * np.sqrt(chi2)
    return (
        f"{said}enlarge camera.dark_noise from {dark:g} to about {more:.2g} electrons "
        f"(with lens.psf_px = {best:g} they are still {tried[best]:.2g} times)"
    )


def _misfit(spots: Spots) -> float:
    """Return the median of the reduced chi-squares of good spots, or 0 if there are none."""
    found = np.concatenate([one.misfits[one.good] for one in spots])
    return float(np.median(found)) if len(found) else 0.0
