"""Frames from the planes of adjusted stickers, with the covariance of the whole result.

The frames are defined as in the simulated teaching. Their errors follow to first order from the
errors of all sticker positions together. The derivatives are central differences.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmmsim.errors import LostError
from cmmsim.files.rig_and_bodies import MarkedBody
from cmmsim.geometry.plane_frame import FEWEST_STICKERS, PLANE_NAMES
from cmmsim.geometry.pose import Array, apply_each, invert, point_jacobian, small_movement
from cmmsim.geometry.registration import register
from cmmsim.measuring.pose_estimator import frames_by_planes
from cmmsim.measuring.taught import Taught
from cmmsim.photographs.bundle import POSE, RIG, Bundle, Observations
from cmmsim.uncertainty.known_rig import KnownRig

# Half the distance between the two positions of a central difference, m.
STEP = 1e-6


@dataclass(frozen=True)
class TaughtFrames:
    """Base frame and positions of the platform's stickers, with their joint covariance.

    base_from_camera  (4, 4)
    base_places       (k, 3), positions of the base's stickers in base axes, m
    places            (n, 3), positions of the platform's stickers in platform axes, m
    covariance        (N, N) with N = 6 + 3 n + 24, of the small movement of base_from_camera, of
                      ``places``, and of the parameters of the rig
    base_ids          (k,), names of the base's stickers
    platform_ids      (n,), names of the platform's stickers
    effect            (6, 3 n), small error [dt, dphi] of a registered platform frame per error of
                      ``places``
    """

    base_from_camera: Array
    base_places: Array
    places: Array
    covariance: Array
    base_ids: NDArray[np.str_]
    platform_ids: NDArray[np.str_]
    effect: Array

    def taught(self, name: str, known: KnownRig | None, setup: str = "") -> Taught:
        """Return the result of teaching.

        ``known`` is the adjusted rig, or None if it is exact. ``setup`` is that of `Taught`.
        """
        split = POSE + self.places.size
        own = self.covariance[:split, :split]
        by_rig = None
        if known is not None:
            # Errors of the rig explain a part of the covariance. This part is stated as their
            # effect ``by_rig``, and only the rest is stated as noise.
            with_rig = self.covariance[:split, split:]
            slope = with_rig @ np.linalg.pinv(self.covariance[split:, split:], hermitian=True)
            own = own - slope @ with_rig.T
            # The errors of a rig are true minus known parameters.
            by_rig = -slope
        place_covariance = own[POSE:, POSE:]
        blocks = np.einsum(
            "iaib->iab", place_covariance.reshape(*self.places.shape, *self.places.shape)
        )
        return Taught(
            name,
            self.base_from_camera,
            own[:POSE, :POSE],
            self.places,
            np.array(blocks),
            self.effect @ place_covariance @ self.effect.T,
            self.base_places,
            setup,
            known,
            by_rig,
            tuple(self.platform_ids.tolist()),
        )


def require_planes(body: MarkedBody) -> None:
    """Raise LostError if a plane of a body has too few stickers."""
    counts = np.bincount(body.plane_index, minlength=len(PLANE_NAMES))
    for plane, count in zip(PLANE_NAMES, counts, strict=True):
        if count < FEWEST_STICKERS:
            raise LostError(
                f"{body.name}: plane {plane} has {count} stickers that can be used, but at least "
                f"{FEWEST_STICKERS} are needed"
            )


def taught_frames(
    bundle: Bundle, seen: Observations, base: MarkedBody, platform: MarkedBody
) -> TaughtFrames:
    """Return the frames of base and platform from the planes of their adjusted stickers.

    ``base`` and ``platform`` contain only the stickers that were adjusted.
    """
    places = bundle.state.places
    split = 3 * seen.base
    count = places.size
    covariance = bundle.covariance
    of_base = _frame_of(base, covariance[:split, :split])
    of_platform = _frame_of(platform, covariance[split:count, split:count])
    base_points, platform_points = places[: seen.base], places[seen.base :]
    base_from_camera = invert(of_base(base_points, base_points[None])[0])
    body_from_model = invert(of_platform(platform_points, platform_points[None])[0])
    slopes = np.zeros((POSE + platform_points.size + RIG, count + RIG))
    more, less = (invert(of_base(base_points, one)) for one in _moved(base_points))
    slopes[:POSE, :split] = np.array(
        [small_movement(a, b) / (2.0 * STEP) for a, b in zip(more, less, strict=True)]
    ).T
    more, less = (
        apply_each(invert(of_platform(platform_points, one)), one).reshape(platform_points.size, -1)
        for one in _moved(platform_points)
    )
    slopes[POSE : POSE + platform_points.size, split:count] = ((more - less) / (2.0 * STEP)).T
    slopes[POSE + platform_points.size :, count:] = np.eye(RIG)
    in_platform = apply_each(body_from_model, platform_points)
    return TaughtFrames(
        base_from_camera,
        apply_each(base_from_camera, base_points),
        in_platform,
        slopes @ bundle.covariance @ slopes.T,
        base.sticker_ids,
        platform.sticker_ids,
        _effect(bundle, seen, in_platform, body_from_model[:3, :3]),
    )


def _moved(points: Array) -> tuple[Array, Array]:
    """Return the points (3 n, n, 3) with each coordinate in turn moved by STEP, and by -STEP."""
    steps = STEP * np.eye(points.size).reshape(-1, *points.shape)
    return points + steps, points - steps


def _frame_of(body: MarkedBody, spread: Array) -> Callable[[Array, Array], Array]:
    """Return a function that computes the body's frames from its adjusted and its changed points.

    The frames are those of the changed points. The adjusted points only fix the signs of the
    normals. ``spread`` (3 n, 3 n) is the points' covariance.
    """
    size = len(body.nominal)
    blocks = np.array(np.einsum("iaib->iab", spread.reshape(size, 3, size, 3)))

    def frames(points: Array, changed: Array) -> Array:
        turn = register(body.nominal, points, blocks).transform[:3, :3]
        return frames_by_planes(body, changed, blocks, body.normals @ turn.T)

    return frames


def _effect(bundle: Bundle, seen: Observations, places: Array, turn: Array) -> Array:
    """Return the small error (6, 3 n) of a registered platform frame per error of the stickers.

    The positions ``places`` (n, 3) are in platform axes, into which ``turn`` (3, 3) rotates the
    axes of the adjusted state. The weight of a sticker is its information matrix from all
    photographs together.
    """
    own = seen.selected(seen.moves)
    by_points = bundle.state.rig.derivatives(bundle.state.points(own))[0]
    by_places = by_points @ bundle.state.poses[own.pair, :3, :3] @ turn.T
    each = np.einsum(
        "smia,smij,smjb->mab", by_places, np.linalg.inv(own.covariances), by_places, optimize=True
    )
    weights = np.zeros((len(places), 3, 3))
    np.add.at(weights, own.sticker - own.base, each)
    rows = point_jacobian(places)
    weighted = rows.swapaxes(1, 2) @ weights
    effect = np.linalg.solve((weighted @ rows).sum(axis=0), np.concatenate(list(weighted), axis=1))
    return np.asarray(effect)
