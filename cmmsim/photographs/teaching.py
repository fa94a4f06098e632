"""Teaching from photographs: frames of base and platform from pairs of images of any source.

The stickers are matched over all pairs without labels, and adjusted together with the poses of the
platform. The frames go through the planes of the sensor file, as in the simulated teaching.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
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
from cmmsim.photographs.matching import NONE, Candidates, FoundBody, candidates, match, spots_in
from cmmsim.photographs.pairs import Photograph
from cmmsim.photographs.planes import TaughtFrames, taught_frames
from cmmsim.photographs.rejection import adjust_robustly
from cmmsim.photographs.taught_file import taught_as_dict
from cmmsim.uncertainty.known_rig import KnownRig

FEWEST_PAIRS = 3


@dataclass(frozen=True)
class PhotographedTeaching:
    """Result of teaching from photographs.

    Attributes
    ----------
    taught : Taught
        Frames and places, which `load_sensor` takes.
    frames : TaughtFrames
        Frames and places with their whole covariance.
    observations : Observations
        Centres of stickers that were used.
    bundle : Bundle
        Adjustment of these centres.
    pairs : tuple of str
        Names of all pairs.
    rejected_pairs, rejected_stickers : dict of str to str
        Reasons by the name of a pair or of a sticker that was not used.
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
            File that is written.
        """
        Path(path).write_text(json.dumps(self.as_dict(), indent=1) + "\n", encoding="utf-8")


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

    ``known`` states how well the rig of the observer is known; None means exactly. Raises
    TeachingError.
    """
    names = []
    spots = []
    for one in photographs:
        spots.append(spots_in(one.images, observer))
        names.append(one.name)
        advance()
    if len(spots) < FEWEST_PAIRS:
        raise TeachingError(f"teaching failed: {len(spots)} pairs, at least {FEWEST_PAIRS} needed")
    pairs = [candidates(one, observer) for one in spots]
    whole = base, platform
    try:
        bodies = match(pairs, platform, base)
        marked = [own.selected(body.sticker) for own, body in zip(whole, bodies, strict=True)]
        seen, start = observations(pairs, bodies, marked, observer)
        prior = np.zeros((RIG, RIG)) if known is None else known.covariance
        judged = adjust_robustly(seen, start, observer.rig, prior, names)
        frames = taught_frames(judged.bundle, judged.seen, marked[0], marked[1])
    except LostError as error:
        raise TeachingError(f"teaching failed: {error}") from error
    rig = None
    if known is not None:
        covariance = judged.bundle.covariance[-RIG:, -RIG:]
        rig = KnownRig(judged.bundle.state.rig, covariance, known.exposure_std)
    missing = {names[k]: "the platform was not found" for k in np.flatnonzero(~bodies[1].seen)}
    missing |= {names[k]: reason for k, reason in judged.pairs.items()}
    return PhotographedTeaching(
        frames.taught(name, rig),
        frames,
        judged.seen,
        judged.bundle,
        tuple(names),
        missing,
        {},
        (),
    )


def observations(
    pairs: list[Candidates],
    bodies: list[FoundBody],
    marked: list[MarkedBody],
    observer: Observer,
) -> tuple[Observations, BundleState]:
    """Return all observations of the stickers of base and platform, and start values."""
    rows = []
    normals = []
    first = 0
    for found, own in zip(bodies, marked, strict=True):
        sticker, pair = np.nonzero(found.members != NONE)
        rows.append(np.stack([pair, first + sticker, found.members[sticker, pair]]))
        first += len(found.sticker)
        even = np.tile(np.eye(3), (len(found.places), 1, 1))
        turn = register(own.nominal, found.places, even).transform[:3, :3]
        normals.append(own.sticker_normals @ turn.T)
    pair, sticker, spot = np.concatenate(rows, axis=1)
    pixels = np.stack([pairs[k].pixels[:, j] for k, j in zip(pair, spot, strict=True)], axis=1)
    spread: Array = np.stack(
        [pairs[k].covariances[:, j] for k, j in zip(pair, spot, strict=True)], axis=1
    )
    seen = Observations(
        pair,
        sticker,
        pixels,
        spread + observer.settings.centre_error_px**2 * np.eye(2),
        len(bodies[0].sticker),
        np.concatenate(normals),
        observer.settings.radius,
    )
    places = np.concatenate([body.places for body in bodies])
    return seen, BundleState(places, bodies[1].moves, observer.rig, np.zeros(RIG))
