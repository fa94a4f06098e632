"""Matching of the spots in many pairs of photographs to stickers, without labels in the print.

A spot of the left image and a spot of the right image that lie on each other's epipolar lines are a
candidate: a point in space. The stickers of the base stand still, so their candidates have the same
pixels in most pairs. All other candidates are assumed to be points of one rigid body. Those of the
pair with the most candidates are the first model, which is searched in every other pair. The rough
places in the sensor file only serve to identify the stickers that were found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cmmsim.detection.ellipse_fit import EllipseFits
from cmmsim.errors import LostError
from cmmsim.files.rig_and_bodies import MarkedBody
from cmmsim.geometry.pose import Array, apply, invert
from cmmsim.geometry.registration import rigid_starts
from cmmsim.measuring.layout_search import (
    ENOUGH,
    LINE_STDS,
    LINE_TOLERANCE_PX,
    bright_ellipses,
    candidate_pairs,
    find_layout,
)
from cmmsim.measuring.observation import Observer, StickerExposure
from cmmsim.measuring.pose_estimator import FEWEST_NOMINAL, NOMINAL_TOLERANCE, TAUGHT_TOLERANCE
from cmmsim.radiometry.stereo_images import StereoFrame, StereoImages, readable

# Smallest share of pairs in which a base sticker has the same pixels. It may be hidden in others.
SHOWN_SHARE = 0.25
# A point with the same pixels in this share of all pairs does not belong to the platform.
STANDING_SHARE = 0.6
# Largest distance between the pixels of a standing sticker in two pairs, over both images.
STANDING_PX = 0.7
# Fewest candidates of a pair that are recognised as a rigid body.
FEWEST_MOVING = 6
# Tolerances of rough places, m. The second is tried if no body is found with the first. In any
# case, single stickers may be off by the second.
ROUGH = (NOMINAL_TOLERANCE, 3.0 * NOMINAL_TOLERANCE)
NONE = -1
# Number of pairs that are tried as the first model of the platform.
REFERENCES = 4
# m: a sticker that has moved is searched within this distance of its rough place.
NEAR = 0.015


@dataclass(frozen=True)
class Candidates:
    """Possible stickers of one pair of images: m pairs of spots.

    pixels       (2, m, 2), centres of the ellipses in both images
    covariances  (2, m, 2, 2), of the centres, px²
    shapes       (2, m, 2, 2), symmetric matrices of the ellipses, px
    points       (m, 3), in the camera frame, m
    alone        (m,), True if both spots belong to no other candidate
    """

    pixels: Array
    covariances: Array
    shapes: Array
    points: Array
    alone: NDArray[np.bool_]


Spots = tuple[EllipseFits, EllipseFits]  # ellipses of the spots in the left and in the right image


def spots_in(images: StereoFrame | StereoImages | StickerExposure, observer: Observer) -> Spots:
    """Return the ellipses of all bright spots in both images."""
    if not isinstance(images, StickerExposure):
        images = readable(images)
    return bright_ellipses(images, observer)


def candidates(spots: Spots, observer: Observer) -> Candidates:
    """Return the possible stickers of a pair of images; some of them are false."""
    good = []
    ideal = []
    limits = observer.settings.limits
    for camera, fits in zip(observer.rig.cameras, spots, strict=True):
        pixels, found = camera.undistort(fits.centres)
        # In images that are noisier than stated, the limit grows with the usual misfit.
        usual = max(1.0, float(np.median(fits.misfits[fits.good]))) if fits.good.any() else 1.0
        allowed = replace(limits, largest_misfit=usual * limits.largest_misfit)
        found &= fits.within(allowed, observer.upright).good
        good.append(np.flatnonzero(found))
        ideal.append(pixels[good[-1]])
    off_line = LINE_TOLERANCE_PX + LINE_STDS * observer.settings.line_error_px
    pairs, points = candidate_pairs(observer.rig.ideal, ideal[0], ideal[1], off_line)
    chosen = [(fits, own[at]) for fits, own, at in zip(spots, good, pairs.T, strict=True)]
    return Candidates(
        np.stack([fits.centres[own] for fits, own in chosen]),
        np.stack([fits.covariances[own] for fits, own in chosen]),
        np.stack([fits.shapes[own] for fits, own in chosen]),
        points,
        np.all([np.bincount(side, minlength=1)[side] == 1 for side in pairs.T], axis=0),
    )


@dataclass(frozen=True)
class FoundBody:
    """Stickers of one body that were found in K pairs.

    sticker   (n,), indices of the stickers among those of the body
    members   (n, K), indices of their candidates, or NONE
    places    (n, 3), in the camera frame at the reference pair, m
    moves     (K, 4, 4), place of the body in each pair, relative to the reference pair
    seen      (K,), pairs in which the body was found
    missing   reasons by the index of each sticker that is not used
    """

    sticker: NDArray[np.int_]
    members: NDArray[np.int_]
    places: Array
    moves: Array
    seen: NDArray[np.bool_]
    missing: dict[int, str]

    def without(self, positions: dict[int, str]) -> FoundBody:
        """Return the body without the stickers at ``positions``, whose values are reasons."""
        count = len(self.sticker)
        gone = {int(self.sticker[k]): why for k, why in positions.items() if 0 <= k < count}
        return self.with_missing(gone)

    def with_missing(self, gone: dict[int, str]) -> FoundBody:
        """Return the body without the file's stickers in ``gone``, whose values are reasons."""
        kept = ~np.isin(self.sticker, list(gone))
        return replace(
            self,
            sticker=self.sticker[kept],
            members=self.members[kept],
            places=self.places[kept],
            missing=self.missing | gone,
        )


def standing(pairs: Sequence[Candidates]) -> NDArray[np.int_]:
    """Return the candidates (g, K) of g points in K pairs, or NONE where one is missing.

    Each of these points has the same pixels in two or more pairs.
    """
    counts = [len(one.points) for one in pairs]
    owner = np.repeat(np.arange(len(pairs)), counts)
    number = np.concatenate([np.arange(count) for count in counts])
    flat = np.concatenate([np.hstack(list(one.pixels)) for one in pairs])
    near = cKDTree(flat).query_ball_point(flat, STANDING_PX)
    pairs_near = np.array([len(set(owner[own])) for own in near], dtype=int)
    free = np.ones(len(flat), dtype=bool)
    found = []
    for k in np.argsort(-pairs_near, kind="stable").tolist():
        own = np.array([j for j in near[k] if free[j]], dtype=int)
        if pairs_near[k] < 2:
            break
        if not free[k] or len(set(owner[own])) < 2:
            continue
        members = np.full(len(pairs), NONE)
        # Of two candidates of one pair, the one nearer to the median of all candidates is taken.
        order = np.argsort(-np.linalg.norm(flat[own] - np.median(flat[own], axis=0), axis=1))
        members[owner[own[order]]] = number[own[order]]
        free[own] = False
        found.append(members)
    return np.array(found, dtype=int).reshape(-1, len(pairs))


def places_of(pairs: Sequence[Candidates], members: NDArray[np.int_]) -> Array:
    """Return the median places (g, 3) of points with candidates ``members`` (g, K)."""
    return np.array(
        [
            np.median([pairs[k].points[j] for k, j in enumerate(own) if j != NONE], axis=0)
            for own in members
        ]
    ).reshape(-1, 3)


@dataclass(frozen=True)
class Moving:
    """Rigid body that moves among the candidates of K pairs.

    members  (n, K), indices of the candidates of its n points, or NONE
    places   (n, 3), in the camera frame at the reference pair, m
    moves    (K, 4, 4), place of the body in each pair, relative to the reference pair
    seen     (K,), pairs in which the body was found
    """

    members: NDArray[np.int_]
    places: Array
    moves: Array
    seen: NDArray[np.bool_]


def moving(pairs: Sequence[Candidates], free: Sequence[NDArray[np.int_]], name: str) -> Moving:
    """Find the rigid body that moves among the ``free`` candidates of each pair.

    Raises LostError if it is found in fewer than two pairs.
    """
    # False candidates share spots with true ones, and would make the search long.
    clear = [own[one.alone[own]] for one, own in zip(pairs, free, strict=True)]
    best = np.zeros(len(pairs), dtype=bool)
    model = np.zeros((0, 3))
    moves = np.zeros((0, 4, 4))
    # The two images of a pair may not belong together, so some pairs are tried as the reference.
    for reference in np.argsort([-len(own) for own in clear])[:REFERENCES].tolist():
        own = pairs[reference].points[clear[reference]]
        try:
            shape, there, seen = _searched(own, reference, pairs, free, name)
        except LostError as error:
            said = error
            continue
        if seen.sum() > best.sum():
            model, moves, best = shape, there, seen
        if best.sum() > 0.5 * len(pairs):
            break
    if not best.any():
        raise said
    model = _extended(model, pairs, free, moves, best)
    members = np.full((len(model), len(pairs)), NONE)
    for k in np.flatnonzero(best).tolist():
        at, to = cKDTree(apply(moves[k], model)).query(
            pairs[k].points[free[k]], distance_upper_bound=2.0 * TAUGHT_TOLERANCE
        )
        order = np.argsort(-at)  # of two candidates the nearer one is entered last
        order = order[np.isfinite(at[order])]
        members[to[order], k] = free[k][order]
    often = np.sum(members != NONE, axis=1) >= 2
    return Moving(members[often], model[often], moves, best)


def _searched(
    model: Array,
    reference: int,
    pairs: Sequence[Candidates],
    free: Sequence[NDArray[np.int_]],
    name: str,
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Search a model (n, 3), the points of one pair, in all other pairs.

    Returns the part of the model that moves as one body, its moves (K, 4, 4) and the pairs (K,) in
    which it was found. Raises LostError if no other pair has it.
    """
    moves = np.tile(np.eye(4), (len(pairs), 1, 1))
    seen = np.zeros(len(pairs), dtype=bool)
    seen[reference] = True
    said = LostError(f"{name}: no pair to compare with")
    for k, own in enumerate(free):
        if k == reference:
            continue
        try:
            points = pairs[k].points[own]
            moves[k], known, _ = find_layout(model, points, TAUGHT_TOLERANCE, FEWEST_MOVING, name)
        except LostError as error:
            said = error
            continue
        seen[k] = True
        if len(known) < ENOUGH * len(model):
            model = model[known]
    if seen.sum() < 2:
        raise said
    return model, moves, seen


def _extended(
    model: Array,
    pairs: Sequence[Candidates],
    free: Sequence[NDArray[np.int_]],
    moves: Array,
    seen: NDArray[np.bool_],
) -> Array:
    """Return the model with points that the reference pair lacks, but two other pairs have."""
    others = []
    owner = []
    for k in np.flatnonzero(seen).tolist():
        back = apply(invert(moves[k]), pairs[k].points[free[k]])
        away = cKDTree(model).query(back)[0] > 4.0 * TAUGHT_TOLERANCE
        others.append(back[away])
        owner.append(np.full(int(away.sum()), k))
    points = np.concatenate(others)
    of = np.concatenate(owner)
    added: list[Array] = []
    near = cKDTree(points).query_ball_point(points, 2.0 * TAUGHT_TOLERANCE) if len(points) else []
    for own in sorted(near, key=lambda one: -len(set(of[one]))):
        middle = np.median(points[own], axis=0)
        far = all(np.linalg.norm(middle - one) > 4.0 * TAUGHT_TOLERANCE for one in added)
        if len(set(of[own])) >= 2 and far:
            added.append(middle)
    return np.concatenate([model, np.array(added).reshape(-1, 3)])


def named(body: MarkedBody, points: Array) -> tuple[Array, NDArray[np.int_], NDArray[np.int_]]:
    """Return the place (4, 4) of a body, and the found stickers and their points as indices (n,).

    Raises LostError if the rough places are not found among the points (g, 3).
    """
    for tolerance in ROUGH:
        try:
            place, _, _ = find_layout(body.nominal, points, tolerance, FEWEST_NOMINAL, body.name)
        except LostError as error:
            said = error
            continue
        # Stickers farther from their rough places are found once the body's place is known.
        for _ in range(2):
            gaps = np.linalg.norm(apply(place, body.nominal)[:, None] - points, axis=2)
            own = gaps.argmin(axis=1)
            mutual = gaps.argmin(axis=0)[own] == np.arange(len(own))
            stickers = np.flatnonzero(mutual & (gaps.min(axis=1) < ROUGH[-1]))
            own = own[stickers]
            even = np.ones((1, len(own)))
            place = rigid_starts(body.nominal[stickers], points[own][None], even)[0]
        return place, stickers, own
    raise said


def match(
    pairs: Sequence[Candidates], platform: MarkedBody, base: MarkedBody, names: Sequence[str]
) -> list[FoundBody]:
    """Return the stickers of base and platform in K pairs with ``names``. Raises LostError."""
    # Points that stand still in only a few pairs are kept, to show when a sticker has moved.
    briefly = standing(pairs)
    share = np.mean(briefly != NONE, axis=1)
    places = places_of(pairs, briefly)
    still = briefly[share >= STANDING_SHARE]
    shown, stood = briefly[share >= SHOWN_SHARE], places[share >= SHOWN_SHARE]
    place, stickers, own = named(base, stood)
    lost = _missing(base, place, stickers, places, briefly, names)
    stays = np.tile(np.eye(4), (len(pairs), 1, 1)), np.ones(len(pairs), dtype=bool)
    found = [FoundBody(stickers, shown[own], stood[own], *stays, {}).with_missing(lost)]
    try:
        # Standing stickers that do not belong to the base are left out as well.
        moved = moving(pairs, _free(pairs, np.concatenate([still, shown[own]])), platform.name)
    except LostError:
        # A platform that seldom moves stands in most pairs, too.
        moved = moving(pairs, _free(pairs, shown[own]), platform.name)
    place, stickers, own = named(platform, moved.places)
    lost = _missing(platform, place, stickers, moved.places, moved.members, names)
    body = FoundBody(stickers, moved.members[own], moved.places[own], moved.moves, moved.seen, {})
    return [*found, body.with_missing(lost)]


def _missing(
    body: MarkedBody,
    camera_from_body: Array,
    found: NDArray[np.int_],
    points: Array,
    members: NDArray[np.int_],
    names: Sequence[str],
) -> dict[int, str]:
    """Return reasons by the index of each sticker that cannot be used.

    Such a sticker was not found, or it has moved. If it has moved, points (g, 3) near its place
    belong to different pairs. ``members`` (g, K) are the candidates of the points.
    """
    reasons = {}
    seen = members != NONE
    for sticker, place in enumerate(apply(camera_from_body, body.nominal)):
        near = np.flatnonzero(np.linalg.norm(points - place, axis=1) < NEAR)
        near = near[np.argsort(-seen[near].sum(axis=1))]
        others = [k for k in near[1:] if not np.any(seen[near[0]] & seen[k])]
        if others:
            first, later = sorted((near[0], others[0]), key=lambda k: int(np.argmax(seen[k])))
            jump = 1e3 * np.linalg.norm(points[later] - points[first])
            last = names[len(names) - 1 - int(np.argmax(seen[first][::-1]))]
            reasons[sticker] = (
                f"moved by {jump:.2f} mm between {last} and {names[int(np.argmax(seen[later]))]}"
            )
        elif sticker not in found:
            count = int(seen[near[0]].sum()) if len(near) else 0
            reasons[sticker] = f"found in {count} of {len(names)} pairs near its rough place"
    return reasons


def _free(pairs: Sequence[Candidates], taken: NDArray[np.int_]) -> list[NDArray[np.int_]]:
    """Return the candidates of each of K pairs without the ``taken`` ones (g, K)."""
    return [
        np.setdiff1d(np.arange(len(one.points)), own)
        for one, own in zip(pairs, taken.T, strict=True)
    ]
