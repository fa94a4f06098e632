"""Stickers of the platform that both cameras see at a pose, and the stated accuracy at that pose.

A sticker counts as visible if it lies in both images, at least `EDGE_PX` away from their edges, and
neither camera sees it at grazing incidence. Obstacles are not considered. For teaching, platform
and base can hide stickers.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmmsim.errors import LostError, SensorFileError
from cmmsim.files.rig_and_bodies import MarkedBody, marked_body, rig_from_file
from cmmsim.files.schema import SensorFile
from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.geometry.pose import (
    Array,
    apply,
    compose_covariance,
    invert,
    pose_covariance,
    pose_to_transform,
)
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.imaging.scene_bodies import TOUCHING, scene_body
from cmmsim.measuring.observation import DetectionSettings, faces_camera
from cmmsim.measuring.pose_estimator import by_planes, by_registration
from cmmsim.sensor import Sensor
from cmmsim.teaching import teaching_path

# Smallest distance of a visible sticker from an edge of an image, px: the side of a default window.
EDGE_PX = DetectionSettings().window_size
# Number of poses on the path of teaching at which stickers are looked for, besides home.
TRIED_POSES = 8
# Points of a sticker that no body may hide: on its rim, as fractions of the radius.
RIM = np.array([[np.cos(angle), np.sin(angle)] for angle in np.arange(8) * np.pi / 4])


@dataclass(frozen=True)
class SightLines:
    """Platform with nominal sticker positions, and the rig that sees it.

    ``camera_from_base`` is (4, 4).
    """

    platform: MarkedBody
    rig: StereoRig
    camera_from_base: Array

    @property
    def cameras_from_base(self) -> list[Array]:
        """Transforms (4,4) from base axes into the axes of the left and of the right camera."""
        return [move @ self.camera_from_base for move in self.rig.from_camera]

    def visible(self, pose: ArrayLike) -> NDArray[np.bool_]:
        """Return a mask (n,) of the stickers that both cameras see at a pose (6,), m and rad."""
        base_from_platform = pose_to_transform(pose)
        seen = np.ones(len(self.platform.sticker_ids), dtype=bool)
        for camera, from_base in zip(self.rig.cameras, self.cameras_from_base, strict=True):
            camera_from_platform = from_base @ base_from_platform
            positions = apply(camera_from_platform, self.platform.nominal)
            normals = self.platform.sticker_normals @ camera_from_platform[:3, :3].T
            pixels, ahead = camera.project(positions)
            seen &= ahead & camera.shows(pixels, EDGE_PX) & faces_camera(positions, normals)
        return seen


def sight_lines(name: str | Path, changes: Mapping[str, Any] | None = None) -> SightLines:
    """Return the sight lines of a built-in sensor or a sensor file, with changes to its entries.

    Raises the same exceptions as `read_sensor_file`.
    """
    file = read_sensor_file(name, changes)
    rig, camera_from_base = rig_from_file(file.rig)
    return SightLines(marked_body("platform", file.platform), rig, camera_from_base)


def unseen_at_teaching(file: SensorFile) -> dict[tuple[str, str], str]:
    """Return the stickers that teaching does not see, each with the reason.

    Teaching needs every sticker of the file, whole and in both images, along a path about home. The
    keys are body and sticker, such as ("platform", "A3"). Legs of a robot are not considered,
    because they are absent at teaching. Raises SensorFileError for an impossible rig or body.
    """
    rig, camera_from_base = rig_from_file(file.rig)
    sections = {"platform": file.platform, "base": file.base}
    bodies = [marked_body(name, section) for name, section in sections.items()]
    scenes = [
        scene_body(body, section, file.stickers, stream)
        for stream, (body, section) in enumerate(zip(bodies, sections.values(), strict=True))
    ]
    home = np.array(file.platform.home)
    radius = file.stickers.radius
    unseen: dict[tuple[str, str], str] = {}
    for pose in (home, *teaching_path(home, TRIED_POSES)):
        placed = [camera_from_base @ pose_to_transform(pose), camera_from_base]
        for side, move in enumerate(rig.from_camera):
            moves = [move @ transform for transform in placed]
            triangles = np.concatenate(
                [
                    apply(into, scene.solid.vertices)[scene.solid.faces]
                    for into, scene in zip(moves, scenes, strict=True)
                ]
            )
            camera = ("left", "right")[side]
            for body, scene, transform, into in zip(bodies, scenes, placed, moves, strict=True):
                shown = rig.project(apply(transform, scene.sticker_places))[1][side]
                radius = file.stickers.radius
                for k, reason in _unseen(
                    body, scene.sticker_places, into, radius, shown, triangles
                ):
                    key = body.name, str(body.sticker_ids[k])
                    unseen.setdefault(key, f"{reason} the {camera} camera")
    return unseen


def _unseen(
    body: MarkedBody,
    places: Array,
    camera_from_body: Array,
    radius: float,
    shown: NDArray[np.bool_],
    triangles: Array,
) -> Iterator[tuple[int, str]]:
    """Yield the index of each sticker that a camera does not see whole, with the reason.

    places (n, 3), shown (n,): centres of the stickers in the body, and whether the image contains
    them. triangles (m, 3, 3): surfaces of all bodies in the axes of the camera.
    """
    centres = apply(camera_from_body, places)
    facing = faces_camera(centres, body.sticker_normals @ camera_from_body[:3, :3].T)
    for k, place in enumerate(places):
        rim = place + radius * RIM @ body.in_plane[k].T
        if not shown[k]:
            yield k, "lies outside of the image of"
        elif not facing[k]:
            yield k, "is turned away from"
        elif _is_hidden(apply(camera_from_body, rim), triangles):
            yield k, "is hidden from"


def _is_hidden(points: Array, triangles: Array) -> bool:
    """Tell whether triangles (m, 3, 3) hide one of points (k, 3), both in the axes of a camera."""
    first, second, third = triangles.swapaxes(0, 1)
    sides = [
        points @ np.cross(one, other).T
        for one, other in ((first, second), (second, third), (third, first))
    ]
    inside = np.all([side >= 0.0 for side in sides], axis=0)
    inside |= np.all([side <= 0.0 for side in sides], axis=0)
    normals = np.cross(second - first, third - first)
    # Depth of each triangle's plane along each line of sight, as a fraction of the point's depth.
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.einsum("mi,mi->m", first, normals) / (points @ normals.T)
    return bool(np.any(inside & (depth > 0.0) & (depth < 1.0 - TOUCHING)))


def expected_covariance(
    name: str | Path,
    pose: ArrayLike,
    method: str = "registration",
    changes: Mapping[str, Any] | None = None,
) -> Array:
    """Return the covariance (6, 6) that a sensor would state for a pose (6,), m and rad.

    One exposure is drawn, see `drawing_sensor`. Teaching is assumed to be free of errors. Raises
    LostError if the stickers do not determine the pose, and the same exceptions as `load_sensor`.
    """
    sensor = drawing_sensor(read_sensor_file(name, changes), method)
    return stated_covariance(sensor, sight_lines(name, changes), pose)


def drawing_sensor(file: SensorFile, method: str = "registration") -> Sensor:
    """Return a sensor that draws without OpenGL, unless a sticker lies in a hollow of a mesh.

    In this case it draws with pyrender. Raises the same exceptions as `Sensor`.
    """
    sensor = Sensor(file, 0, method, renderer="analytic")
    try:
        sensor.camera  # noqa: B018  # the cameras are made on first use
    except SensorFileError:
        return Sensor(file, 0, method, renderer="pyrender")
    return sensor


def stated_covariance(sensor: Sensor, sight: SightLines, pose: ArrayLike) -> Array:
    """Return the covariance (6, 6) that a sensor states for a pose (6,), m and rad.

    One exposure is drawn. Stickers are measured at the pixels that follow from the pose, without
    teaching or search. Raises LostError if the stickers do not determine the pose.
    """
    base_from_platform = pose_to_transform(pose)
    expected = sight.camera_from_base @ base_from_platform
    seen = sensor.observer.observe(
        sensor.look(pose), expected, sight.platform.nominal, sight.platform.sticker_normals
    )
    if sensor.method == "planes":
        covariance = by_planes(seen, sight.platform, sight.platform.normals @ expected[:3, :3].T)[1]
    else:
        places = sight.platform.nominal.copy()
        places[seen.index] = apply(invert(expected), seen.points)
        covariance = by_registration(seen, places)[1]
    if not np.isfinite(covariance).all():
        raise LostError(
            f"sensor {sensor.name} states no covariance at pose {np.asarray(pose).tolist()}"
        )
    return pose_covariance(
        base_from_platform, compose_covariance(invert(sight.camera_from_base), covariance)
    )
