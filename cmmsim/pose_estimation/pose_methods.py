"""The two ways from observed stickers to the pose of the body in the camera frame."""

from __future__ import annotations

import numpy as np

from cmmsim.files.marked_body import MarkedBody
from cmmsim.geometry.plane_frame import frame_of_points
from cmmsim.geometry.pose import Array, invert, skew
from cmmsim.geometry.registration import register
from cmmsim.pose_estimation.observation import StickerObservation

Solution = tuple[Array, Array, StickerObservation]


def by_registration(observation: StickerObservation, places: Array) -> Solution:
    """camera_from_body (4,4), its covariance (6,6) and the stickers used, by a rigid fit of taught ``places`` (n,3).

    Raises LostError with fewer than three stickers off one line.
    """
    result = register(places[observation.index], observation.points, observation.covariances)
    return result.transform, result.covariance, observation


def by_planes(observation: StickerObservation, body: MarkedBody, towards: Array) -> Solution:
    """camera_from_body (4,4), its covariance (6,6) and the stickers used, by intersecting the three sticker planes.

    ``towards`` (3,3): rough normals of planes A, B, C in the camera frame. Raises LostError that names the plane.
    """
    frame, covariance = frame_of_points(
        observation.points, observation.covariances, body.plane_index[observation.index], towards
    )
    planes_from_body = invert(body.body_from_planes)
    return frame @ planes_from_body, move_origin(frame, covariance, planes_from_body[:3, 3]), observation


def move_origin(frame: Array, covariance: Array, origin: Array) -> Array:
    """Covariance (6,6) of [dt, dphi] for another origin of the same rigid frame, ``origin`` (3,) in its own axes."""
    lever = np.eye(6)
    lever[:3, 3:] = -skew(frame[:3, :3] @ origin)
    return lever @ covariance @ lever.T


METHODS: tuple[str, ...] = ("registration", "planes")
