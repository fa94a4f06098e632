"""Teaching from photographs: frames of base and platform from pairs of images of any source.

The stickers are matched over all pairs without labels, and adjusted together with the poses of the
platform. The planes of the sensor file define the frames, as in the simulated teaching.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cmmsim.errors import LostError, TeachingError
from cmmsim.files.rig_and_bodies import MarkedBody
from cmmsim.geometry.pose import Array
from cmmsim.geometry.registration import register
from cmmsim.measuring.observation import Observer
from cmmsim.measuring.taught import Taught
from cmmsim.photographs.bundle import RIG, Bundle, BundleState, Observations
from cmmsim.photographs.causes import cause_of, light_doubt
from cmmsim.photographs.matching import (
    NONE,
    Candidates,
    FoundBody,
    Spots,
    candidates,
    match,
    spots_in,
)
from cmmsim.photographs.pairs import Photograph
from cmmsim.photographs.planes import TaughtFrames, require_planes, taught_frames
from cmmsim.photographs.rejection import Judged, adjust_robustly
from cmmsim.photographs.taught_file import taught_as_dict
from cmmsim.uncertainty.known_rig import KnownRig

# Teaching fails with fewer pairs.
FEWEST_PAIRS = 3
# Largest number of pairs that are used. If there are more, this many are selected evenly.
MOST_PAIRS = 500
# A warning is given if squared residuals exceed those of the stated noise by this factor.
LARGEST_FACTOR = 1.5
# A warning is given if the radius of stickers differs from the stated one by more than this
# fraction.
LARGEST_GROWTH = 0.02
# A warning is given if the platform moves by less than this in the images.
SHORTEST_WAY_PX = 3.0
UNFOUND = "hidden, or its images do not belong together"


@dataclass(frozen=True)
class PhotographedTeaching:
    """Result of teaching from photographs.

    Attributes
    ----------
    taught : Taught
        Frames and sticker positions, in the form that `load_sensor` takes.
    frames : TaughtFrames
        Frames and sticker positions with their joint covariance.
    observations : Observations
        Centres of stickers that were used.
    bundle : Bundle
        Adjustment of these centres.
    pairs : tuple of str
        Names of all pairs.
    rejected_pairs, rejected_stickers : dict of str to str
        Reasons, by the name of each pair or sticker that was not used.
    warnings : tuple of str
        Lines about doubtful results.

    Examples
    --------
    >>> from cmmsim.photographs.pairs import numbered
    >>> images = [sensor.look(sensor.home + 0.01 * np.sin(np.arange(6) + k)) for k in range(6)]
    >>> found = sensor.teach_from(numbered(images, 60.0))
    >>> found.taught, len(found.pairs)
    (Taught('ctrack780', 18 stickers of the platform, 18 of the base), 6)
    """

    taught: Taught
    frames: TaughtFrames
    observations: Observations
    bundle: Bundle
    pairs: tuple[str, ...]
    rejected_pairs: dict[str, str]
    rejected_stickers: dict[str, str]
    warnings: tuple[str, ...]

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals of all coordinates of centres, px."""
        return float(np.sqrt(np.mean(self.bundle.residuals**2)))

    def as_dict(self) -> dict[str, Any]:
        """Return the content of ``taught.json``.

        Returns
        -------
        dict
        """
        return taught_as_dict(self.taught) | {
            "base_stickers": self.frames.base_ids.tolist(),
            "residual_rms_px": self.rms_px,
            "variance_factor": self.bundle.factor,
            "pairs": list(self.pairs),
            "rejected_pairs": self.rejected_pairs,
            "rejected_stickers": self.rejected_stickers,
            "warnings": list(self.warnings),
        }

    def save(self, path: str | Path) -> None:
        """Write the result into a file, which `read_taught` reads.

        Parameters
        ----------
        path : str or Path
            File that is written, completely or not at all.
        """
        whole = Path(path)
        part = whole.with_name(f"{whole.name}.part")
        part.write_text(json.dumps(self.as_dict(), indent=1) + "\n", encoding="utf-8")
        part.replace(whole)


def teach_from(
    photographs: Iterable[Photograph],
    observer: Observer,
    platform: MarkedBody,
    base: MarkedBody,
    name: str,
    known: KnownRig | None = None,
    advance: Callable[[], None] = lambda: None,
) -> PhotographedTeaching:
    """Teach base and platform from photographs.

    ``known`` states how well the rig of the observer is known; None means exactly. ``advance`` is
    called after each pair is read. Raises TeachingError, with the probable cause, for fewer than
    FEWEST_PAIRS pairs, and if base or platform cannot be taught.
    """
    names = []
    spots = []
    doubt = ""
    for photograph in photographs:
        spots.append(spots_in(photograph.images, observer))
        doubt = doubt or light_doubt(photograph, spots[-1], observer)
        names.append(photograph.name)
        advance()
    if len(spots) < FEWEST_PAIRS:
        raise TeachingError(
            f"teaching failed: {len(spots)} pairs, but at least {FEWEST_PAIRS} needed"
        )
    left_out = max(len(spots) - MOST_PAIRS, 0)
    if left_out:
        chosen = np.linspace(0, len(spots) - 1, MOST_PAIRS).astype(int).tolist()
        spots = [spots[k] for k in chosen]
        names = [names[k] for k in chosen]
    try:
        teaching = _taught(spots, names, observer, (base, platform), name, known)
    except LostError as error:
        cause = cause_of(error, spots, names, observer, base, platform)
        raise TeachingError(f"teaching failed: {cause}") from error
    warnings = [doubt] if doubt else []
    if left_out:
        warnings.append(
            f"{left_out} pairs are not used: {MOST_PAIRS} pairs, spread over all, are enough"
        )
    return replace(teaching, warnings=(*warnings, *teaching.warnings))


def _taught(
    spots: list[Spots],
    names: list[str],
    observer: Observer,
    whole: tuple[MarkedBody, MarkedBody],
    name: str,
    known: KnownRig | None,
) -> PhotographedTeaching:
    """Match and adjust the stickers of ``whole`` (base, platform), and fit the frames' planes.

    Raises LostError if a body is not found, if a plane has too few stickers, if fewer than two
    pairs agree, or if an adjustment does not converge.
    """
    base, platform = whole
    pairs = [candidates(one, observer) for one in spots]
    bodies = match(pairs, platform, base, names)
    prior = np.zeros((RIG, RIG)) if known is None else known.covariance
    while True:
        marked = [own.selected(body.sticker) for own, body in zip(whole, bodies, strict=True)]
        lost = {
            f"{own.sticker_ids[k]} of the {own.name}": reason
            for own, body in zip(whole, bodies, strict=True)
            for k, reason in sorted(body.missing.items())
        }
        try:
            for own in marked:
                require_planes(own)
        except LostError as error:
            reasons = "; ".join(f"{sticker} {reason}" for sticker, reason in lost.items())
            raise LostError(f"{error}: {reasons}") from error
        seen, start = observations(pairs, bodies, marked, observer)
        judged = adjust_robustly(seen, start, observer.rig, prior, names)
        # The images give a better radius than the file, and the centres of ellipses depend on it.
        seen = replace(seen, radius=judged.bundle.state.radius(judged.seen))
        judged = adjust_robustly(seen, judged.bundle.state, observer.rig, prior, names)
        if not judged.stickers:
            break
        # A sticker that is left out is removed from the unknowns, too.
        bodies = [
            body.without({k - first: why for k, why in judged.stickers.items()})
            for body, first in zip(bodies, (0, seen.base), strict=True)
        ]
    frames = taught_frames(judged.bundle, judged.seen, marked[0], marked[1])
    rig = None
    if known is not None:
        covariance = judged.bundle.covariance[-RIG:, -RIG:]
        rig = KnownRig(judged.bundle.state.rig, covariance, known.exposure_std)
    unseen = np.flatnonzero(~bodies[1].seen).tolist()
    missing = {names[k]: "the platform was not found: " + UNFOUND for k in unseen}
    missing |= {names[k]: reason for k, reason in judged.pairs.items()}
    return PhotographedTeaching(
        replace(frames.taught(name, rig), radius=judged.seen.radius),
        frames,
        judged.seen,
        judged.bundle,
        tuple(names),
        missing,
        lost,
        tuple(doubts(judged, missing, lost, observer)),
    )


def doubts(
    judged: Judged,
    missing: dict[str, str],
    lost: dict[str, str],
    observer: Observer,
) -> list[str]:
    """Return warnings: of pairs ``missing``, of stickers ``lost``, and of doubtful results."""
    lines = [f"not used: {one}: {reason}" for one, reason in (missing | lost).items()]
    if judged.bundle.factor > LARGEST_FACTOR:
        lines.append(
            f"squared residuals are {judged.bundle.factor:.1f} times the stated noise, and the "
            "covariances are enlarged as much: are the cameras calibrated, and the images sharp?"
        )
    radius = observer.settings.radius
    if abs(judged.seen.radius / radius - 1.0) > LARGEST_GROWTH:
        lines.append(
            f"stickers have a radius of {judged.seen.radius:.4g} m in the images, which is used, "
            f"but the sensor file states {radius:g} m"
        )
    if (longest := longest_way(judged.seen)) < SHORTEST_WAY_PX:
        lines.append(
            f"the platform moves by at most {longest:.1f} px in the images: with larger movements, "
            "errors of single pixels average out"
        )
    return lines


def longest_way(seen: Observations) -> float:
    """Return the largest range of a pixel coordinate of any sticker of the platform, px."""
    ways = [
        float(np.ptp(seen.pixels[:, seen.sticker == sticker], axis=1).max())
        for sticker in np.unique(seen.sticker[seen.moves])
    ]
    return max(ways)


def observations(
    pairs: list[Candidates],
    bodies: list[FoundBody],
    marked: list[MarkedBody],
    observer: Observer,
) -> tuple[Observations, BundleState]:
    """Return all observations of the stickers of base and platform, and the initial state."""
    rows = []
    normals = []
    first = 0
    for found, own in zip(bodies, marked, strict=True):
        sticker, pair = np.nonzero(found.members != NONE)
        rows.append(np.stack([pair, first + sticker, found.members[sticker, pair]]))
        first += len(found.sticker)
        even = np.tile(np.eye(3), (len(found.places), 1, 1))
        rotation = register(own.nominal, found.places, even).transform[:3, :3]
        normals.append(own.sticker_normals @ rotation.T)
    pair, sticker, spot = np.concatenate(rows, axis=1)
    pixels = np.stack([pairs[k].pixels[:, j] for k, j in zip(pair, spot, strict=True)], axis=1)
    covariances: Array = np.stack(
        [pairs[k].covariances[:, j] for k, j in zip(pair, spot, strict=True)], axis=1
    )
    shapes = np.stack([pairs[k].shapes[:, j] for k, j in zip(pair, spot, strict=True)], axis=1)
    seen = Observations(
        pair,
        sticker,
        pixels,
        covariances + observer.settings.centre_error_px**2 * np.eye(2),
        shapes,
        len(bodies[0].sticker),
        np.concatenate(normals),
        observer.settings.radius,
    )
    places = np.concatenate([body.places for body in bodies])
    return seen, BundleState(places, bodies[1].moves, observer.rig, np.zeros(RIG))
