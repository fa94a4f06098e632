"""Constellation of a body's stickers: the mean of many views, and the frame that it defines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cmmsim.files.rig_and_bodies import MarkedBody
from cmmsim.geometry.pose import Array, apply, apply_each, compose_covariance, invert
from cmmsim.geometry.registration import register, register_sets
from cmmsim.measuring.pose_estimator import by_planes, frames_by_planes
from cmmsim.measuring.sticker_windows import StickerObservation


def platform_frame(
    platform: MarkedBody, seen: list[StickerObservation], constant: Array
) -> tuple[Array, Array, Array]:
    """Return sticker places (n, 3) on the platform with their covariances (n, 3, 3).

    The third result is the covariance (6, 6) of the platform frame's small error [dt, dphi], in
    platform axes. Each view must contain all stickers, in the same order. ``constant`` (n, 3, 3)
    are the covariances of the errors that all views have in common.
    """
    points = np.stack([view.points for view in seen])
    mean, covariances = mean_constellation(points, np.stack([view.covariances for view in seen]))
    covariances = covariances + constant
    rough_normals = plane_normals(platform, register(platform.nominal, mean, covariances).transform)
    whole = replace(seen[0], points=mean, covariances=covariances)
    mean_from_body, frame_covariance, _ = by_planes(whole, platform, rough_normals)
    body_from_mean = invert(mean_from_body)
    rotation = body_from_mean[:3, :3]
    return (
        apply(body_from_mean, mean),
        rotation @ covariances @ rotation.T,
        compose_covariance(body_from_mean, frame_covariance),
    )


def platform_places(platform: MarkedBody, points: Array, covariances: Array) -> Array:
    """Return the sticker places (c, n, 3) on the platform from c teachings.

    The places are those of ``platform_frame`` without constant errors. Each teaching has v views of
    the stickers. ``points`` is (c, v, n, 3), and ``covariances`` is (c, v, n, 3, 3).
    """
    mean, covariances = mean_constellation(points, covariances)
    rough_normals = plane_normals(
        platform, register_sets(platform.nominal, mean, covariances).transform
    )
    return apply_each(invert(frames_by_planes(platform, mean, covariances, rough_normals)), mean)


def plane_normals(body: MarkedBody, camera_from_body: Array) -> Array:
    """Return the normals of a body's planes in the camera frame, as the rows of (..., 3, 3).

    The body stands at ``camera_from_body`` (..., 4, 4).
    """
    return np.asarray(body.normals @ camera_from_body[..., :3, :3].swapaxes(-1, -2))


def mean_constellation(points: Array, covariances: Array) -> tuple[Array, Array]:
    """Move v views of the same stickers onto each other, and return their mean (..., n, 3).

    The mean is weighted, and has about the place and orientation of the first view. The second
    result is its covariances (..., n, 3, 3). ``points`` of the views is (..., v, n, 3), and
    ``covariances`` is (..., v, n, 3, 3).
    """
    weights = np.linalg.inv(covariances)
    mean = points[..., 0, :, :]
    mean_covariances = covariances[..., 0, :, :, :]
    # Mean and transforms depend on each other. Three alternating steps are enough for convergence.
    for _ in range(3):
        means = np.broadcast_to(mean[..., None, :, :], points.shape).reshape(-1, *points.shape[-2:])
        view_from_mean = register_sets(
            means, points.reshape(means.shape), covariances.reshape(*means.shape, 3)
        ).transform
        to_mean = invert(view_from_mean).reshape(*points.shape[:-2], 4, 4)
        rotations = to_mean[..., None, :3, :3]
        rotated_weights = rotations @ weights @ rotations.swapaxes(-1, -2)
        weighted_sum = (rotated_weights @ apply_each(to_mean, points)[..., None]).sum(axis=-4)
        mean_covariances = np.linalg.inv(rotated_weights.sum(axis=-4))
        mean = (mean_covariances @ weighted_sum)[..., 0]
    return mean, mean_covariances
