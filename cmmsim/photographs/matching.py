"""Matching of the spots in many pairs of photographs to stickers, without labels in the print.

A spot of the left image and a spot of the right image that lie on each other's epipolar lines form
a candidate, which is a point in space. The stickers of the base stand still, so their candidates
have the same pixels in most pairs. All other candidates are assumed to be points of one rigid body,
the platform. The candidates of one pair are its first model, which is searched in every other pair.
The rough positions in the sensor file only serve to identify the stickers that were found.
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

# A point can be a base sticker if it has the same pixels in at least this fraction of all pairs. It
# may be hidden in the others.
SHOWN_SHARE = 0.25
# A point with the same pixels in at least this fraction of all pairs is at first not taken for a
# point of the platform.
STANDING_SHARE = 0.6
# A point has the same pixels in two pairs if the norm of the change of its four coordinates in both
# images is at most this.
STANDING_PX = 0.7
# The platform is found in a pair if at least this many candidates match its model.
FEWEST_MOVING = 6
# Tolerances of rough positions, m. The second is tried if no body is found with the first. In any
# case, single stickers may be off by the second.
ROUGH = (NOMINAL_TOLERANCE, 3.0 * NOMINAL_TOLERANCE)
# Index of a candidate that is missing.
NONE = -1
# Largest number of pairs that are tried as the first model of the platform.
REFERENCES = 4
# A sticker that has moved, or was seldom found, is searched this near to its rough position, m.
NEAR = 0.015


@dataclass(frozen=True)
class Candidates:
    """Possible stickers of one pair of images: m combinations of a left and a right spot.

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
    """Return the possible stickers of a pair of images, some of which are not stickers."""
    good = []
    ideal = []
    limits = observer.settings.limits
    for camera, fits in zip(observer.rig.cameras, spots, strict=True):
        pixels, valid = camera.undistort(fits.centres)
        # In images that are noisier than stated, the limit grows with the typical misfit.
        typical = max(1.0, float(np.median(fits.misfits[fits.good]))) if fits.good.any() else 1.0
        allowed = replace(limits, largest_misfit=typical * limits.largest_misfit)
        valid &= fits.within(allowed, observer.upright).good
        good.append(np.flatnonzero(valid))
        ideal.append(pixels[good[-1]])
    off_line = LINE_TOLERANCE_PX + LINE_STDS * observer.settings.line_error_px
    pairs, points = candidate_pairs(observer.rig.ideal, ideal[0], ideal[1], off_line)
    chosen = [(fits, own[members]) for fits, own, members in zip(spots, good, pairs.T, strict=True)]
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

    sticker   (n,), indices of the found stickers among all stickers of the body
    members   (n, K), indices of their candidates in each pair, or NONE
    places    (n, 3), positions in the camera frame at the reference pair, m
    moves     (K, 4, 4), motion of the body from the reference pair to each pair
    seen      (K,), True for pairs in which the body was found
    missing   reasons by the index of each sticker of the body that is not used
    """

    sticker: NDArray[np.int_]
    members: NDArray[np.int_]
    places: Array
    moves: Array
    seen: NDArray[np.bool_]
    missing: dict[int, str]

    def without(self, positions: dict[int, str]) -> FoundBody:
        """Return the body without the stickers ``sticker[k]`` for the keys k of ``positions``.

        The values are reasons. Keys out of range are ignored.
        """
        count = len(self.sticker)
        gone = {int(self.sticker[k]): why for k, why in positions.items() if 0 <= k < count}
        return self.with_missing(gone)

    def with_missing(self, gone: dict[int, str]) -> FoundBody:
        """Return the body without the stickers whose indices are keys of ``gone``.

        The values are reasons.
        """
        kept = ~np.isin(self.sticker, list(gone))
        return replace(
            self,
            sticker=self.sticker[kept],
            members=self.members[kept],
            places=self.places[kept],
            missing=self.missing | gone,
        )


def standing(pairs: Sequence[Candidates]) -> NDArray[np.int_]:
    """Return the indices (g, K) of the candidates of g points in K pairs; NONE if one is missing.

    Each of these points has the same pixels in two or more pairs.
    """
    counts = [len(one.points) for one in pairs]
    owner = np.repeat(np.arange(len(pairs)), counts)
    number = np.concatenate([np.arange(count) for count in counts])
    flat = np.concatenate([np.hstack(list(one.pixels)) for one in pairs])
    near = cKDTree(flat).query_ball_point(flat, STANDING_PX)
    pairs_near = np.array([len(set(owner[own])) for own in near], dtype=int)
    free = np.ones(len(flat), dtype=bool)
    points = []
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
        points.append(members)
    return np.array(points, dtype=int).reshape(-1, len(pairs))


def places_of(pairs: Sequence[Candidates], members: NDArray[np.int_]) -> Array:
    """Return the median positions (g, 3), m, of points, from the result of `standing` (g, K)."""
    return np.array(
        [
            np.median([pairs[k].points[j] for k, j in enumerate(own) if j != NONE], axis=0)
            for own in members
        ]
    ).reshape(-1, 3)


@dataclass(frozen=True)
class Moving:
    """Rigid body that moves among the candidates of K pairs.

    members  (n, K), indices of the candidates of its n points in each pair, or NONE
    places   (n, 3), positions in the camera frame at the reference pair, m
    moves    (K, 4, 4), motion of the body from the reference pair to each pair
    seen     (K,), True for pairs in which the body was found
    """

    members: NDArray[np.int_]
    places: Array
    moves: Array
    seen: NDArray[np.bool_]


def moving(pairs: Sequence[Candidates], free: Sequence[NDArray[np.int_]], name: str) -> Moving:
    """Find the rigid body that moves among the candidates with indices ``free`` of each pair.

    Raises LostError if it is found in fewer than two pairs. ``name`` is its name in messages.
    """
    # False candidates share spots with true ones, and would make the search long.
    clear = [own[one.alone[own]] for one, own in zip(pairs, free, strict=True)]
    found_in = np.zeros(len(pairs), dtype=bool)
    model = np.zeros((0, 3))
    moves = np.zeros((0, 4, 4))
    # The two images of a pair may not belong together, so some pairs are tried as the reference.
    for reference in np.argsort([-len(own) for own in clear])[:REFERENCES].tolist():
        own = pairs[reference].points[clear[reference]]
        try:
            shape, shape_moves, seen = _searched(own, reference, pairs, free, name)
        except LostError as error:
            failure = error
            continue
        if seen.sum() > found_in.sum():
            model, moves, found_in = shape, shape_moves, seen
        if found_in.sum() > 0.5 * len(pairs):
            break
    if not found_in.any():
        raise failure
    model = _extended(model, pairs, free, moves, found_in)
    members = np.full((len(model), len(pairs)), NONE)
    for k in np.flatnonzero(found_in).tolist():
        distances, nearest = cKDTree(apply(moves[k], model)).query(
            pairs[k].points[free[k]], distance_upper_bound=2.0 * TAUGHT_TOLERANCE
        )
        order = np.argsort(-distances)  # of two candidates for a point, the nearer one overwrites
        order = order[np.isfinite(distances[order])]
        members[nearest[order], k] = free[k][order]
    often = np.sum(members != NONE, axis=1) >= 2
    return Moving(members[often], model[often], moves, found_in)


def _searched(
    model: Array,
    reference: int,
    pairs: Sequence[Candidates],
    free: Sequence[NDArray[np.int_]],
    name: str,
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Search a model (n, 3), which are points of the ``reference`` pair, in all other pairs.

    Return the part of the model that moves as one body, its motions (K, 4, 4) from the reference
    pair, and a mask (K,) of the pairs in which it was found. Raises LostError if it is found in no
    other pair.
    """
    moves = np.tile(np.eye(4), (len(pairs), 1, 1))
    seen = np.zeros(len(pairs), dtype=bool)
    seen[reference] = True
    failure = LostError(f"{name}: no pair to compare with")
    for k, own in enumerate(free):
        if k == reference:
            continue
        try:
            points = pairs[k].points[own]
            moves[k], known, _ = find_layout(model, points, TAUGHT_TOLERANCE, FEWEST_MOVING, name)
        except LostError as error:
            failure = error
            continue
        seen[k] = True
        if len(known) < ENOUGH * len(model):
            model = model[known]
    if seen.sum() < 2:
        raise failure
    return model, moves, seen


def _extended(
    model: Array,
    pairs: Sequence[Candidates],
    free: Sequence[NDArray[np.int_]],
    moves: Array,
    seen: NDArray[np.bool_],
) -> Array:
    """Return the model with further points, each of which at least two pairs show."""
    others = []
    owner = []
    for k in np.flatnonzero(seen).tolist():
        back = apply(invert(moves[k]), pairs[k].points[free[k]])
        away = cKDTree(model).query(back)[0] > 4.0 * TAUGHT_TOLERANCE
        others.append(back[away])
        owner.append(np.full(int(away.sum()), k))
    points = np.concatenate(others)
    pair_of = np.concatenate(owner)
    added: list[Array] = []
    near = cKDTree(points).query_ball_point(points, 2.0 * TAUGHT_TOLERANCE) if len(points) else []
    for own in sorted(near, key=lambda one: -len(set(pair_of[one]))):
        middle = np.median(points[own], axis=0)
        far = all(np.linalg.norm(middle - one) > 4.0 * TAUGHT_TOLERANCE for one in added)
        if len(set(pair_of[own])) >= 2 and far:
            added.append(middle)
    return np.concatenate([model, np.array(added).reshape(-1, 3)])


def named(body: MarkedBody, points: Array) -> tuple[Array, NDArray[np.int_], NDArray[np.int_]]:
    """Return camera_from_body (4, 4), and the indices (n,) of found stickers and of their points.

    Raises LostError if the rough positions are not found among the points (g, 3).
    """
    for tolerance in ROUGH:
        try:
            pose, _, _ = find_layout(body.nominal, points, tolerance, FEWEST_NOMINAL, body.name)
        except LostError as error:
            failure = error
            continue
        # Stickers farther from their rough positions are found once the body's pose is known.
        for _ in range(2):
            distances = np.linalg.norm(apply(pose, body.nominal)[:, None] - points, axis=2)
            own = distances.argmin(axis=1)
            mutual = distances.argmin(axis=0)[own] == np.arange(len(own))
            stickers = np.flatnonzero(mutual & (distances.min(axis=1) < ROUGH[-1]))
            own = own[stickers]
            even = np.ones((1, len(own)))
            pose = rigid_starts(body.nominal[stickers], points[own][None], even)[0]
        return pose, stickers, own
    raise failure


def match(
    pairs: Sequence[Candidates], platform: MarkedBody, base: MarkedBody, names: Sequence[str]
) -> list[FoundBody]:
    """Return the found base and the found platform in K pairs with ``names``.

    Raises LostError if one of them is not found.
    """
    # Points that stand still in only a few pairs are kept, to show when a sticker has moved.
    briefly = standing(pairs)
    fractions = np.mean(briefly != NONE, axis=1)
    places = places_of(pairs, briefly)
    still = briefly[fractions >= STANDING_SHARE]
    shown, stood = briefly[fractions >= SHOWN_SHARE], places[fractions >= SHOWN_SHARE]
    pose, stickers, own = named(base, stood)
    lost = _missing(base, pose, stickers, places, briefly, names)
    stays = np.tile(np.eye(4), (len(pairs), 1, 1)), np.ones(len(pairs), dtype=bool)
    bodies = [FoundBody(stickers, shown[own], stood[own], *stays, {}).with_missing(lost)]
    try:
        # Standing stickers that do not belong to the base are left out as well.
        moved = moving(pairs, _free(pairs, np.concatenate([still, shown[own]])), platform.name)
    except LostError:
        # A platform that seldom moves stands in most pairs, too.
        moved = moving(pairs, _free(pairs, shown[own]), platform.name)
    pose, stickers, own = named(platform, moved.places)
    lost = _missing(platform, pose, stickers, moved.places, moved.members, names)
    body = FoundBody(stickers, moved.members[own], moved.places[own], moved.moves, moved.seen, {})
    return [*bodies, body.with_missing(lost)]


def _missing(
    body: MarkedBody,
    camera_from_body: Array,
    found: NDArray[np.int_],
    points: Array,
    members: NDArray[np.int_],
    names: Sequence[str],
) -> dict[int, str]:
    """Return reasons by the index of each sticker that cannot be used.

    Such a sticker was not found, or it has moved. If it has moved, points (g, 3) near its rough
    position belong to different pairs. ``members`` (g, K) are the indices of their candidates.
    """
    reasons = {}
    seen = members != NONE
    for sticker, position in enumerate(apply(camera_from_body, body.nominal)):
        near = np.flatnonzero(np.linalg.norm(points - position, axis=1) < NEAR)
        near = near[np.argsort(-seen[near].sum(axis=1))]
        others = [k for k in near[1:] if not np.any(seen[near[0]] & seen[k])]
        if others:
            first, later = sorted((near[0], others[0]), key=lambda k: int(np.argmax(seen[k])))
            jump = 1e3 * np.linalg.norm(points[later] - points[first])
            before = names[len(names) - 1 - int(np.argmax(seen[first][::-1]))]
            reasons[sticker] = (
                f"moved by {jump:.2f} mm between {before} and {names[int(np.argmax(seen[later]))]}"
            )
        elif sticker not in found:
            count = int(seen[near[0]].sum()) if len(near) else 0
            reasons[sticker] = f"found in {count} of {len(names)} pairs near its rough position"
    return reasons


def _free(pairs: Sequence[Candidates], taken: NDArray[np.int_]) -> list[NDArray[np.int_]]:
    """Return the indices of the candidates of each pair without those ``taken`` (g, K)."""
    return [
        np.setdiff1d(np.arange(len(one.points)), own)
        for one, own in zip(pairs, taken.T, strict=True)
    ]
