"""Bodies of a robot's legs in front of the cameras: rods, or the meshes of the robot file."""

from functools import lru_cache
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

import cmmsim
from cmmsim.files.body_meshes import closed_mesh
from cmmsim.geometry.pose import pose_to_transform
from cmmsim.imaging.scene_bodies import PlacedBodies, rod_transforms
from dynamics import Robot
from dynamics.bodies import Part, parts_of
from dynamics.body_mesh import BodyMesh
from dynamics.errors import RobotFileError
from dynamics.geometry import RobotGeometry
from identify.arrays import Array

LARGEST_SIZE_M = 10.0  # length, m, beyond which a mesh probably has a wrong unit


def robot_meshes(robot: Robot) -> dict[str, trimesh.Trimesh]:
    """Return the meshes [m] of the bodies of all legs, by name. The bodies can hide stickers.

    A rod lies along its z axis and begins at its first joint. A mesh of the robot file is in the
    axes of its body. Raises RobotFileError or cmmsim.CmmError for a mesh that cannot be used.
    """
    return dict(_meshes(robot.geometry))


def meshed_parts(geometry: RobotGeometry) -> NDArray[np.bool_]:
    """Return whether each part of `robot_meshes`, in their order, is a mesh of the robot file."""
    return np.array([bool(geometry.meshes_of(part.body)) for part in _drawn(geometry)[0]])


@lru_cache(maxsize=4)
def _meshes(geometry: RobotGeometry) -> dict[str, trimesh.Trimesh]:
    """Return the meshes of a geometry. They are cached for studies with a single robot."""
    return {part.name: _mesh(geometry, part) for part in _drawn(geometry)[0]}


def _mesh(geometry: RobotGeometry, part: Part) -> trimesh.Trimesh:
    """Return the rod of a part, or the meshes of its body as one."""
    pieces = [stated_mesh(one, part.name) for one in geometry.meshes_of(part.body)]
    if pieces:
        return trimesh.util.concatenate(pieces)
    length = float(np.linalg.norm(np.diff(part.segment.rod, axis=0)))
    return cmmsim.rod(length, part.segment.radius)


def stated_mesh(stated: BodyMesh, name: str) -> trimesh.Trimesh:
    """Return a mesh [m] of a robot file in the axes of its body.

    name: name of the body's part. Raises RobotFileError for a mesh that is far too large, and
    cmmsim.SensorFileError for one that cannot be read or is not closed.
    """
    where = f"the mesh {stated.file} of {name}"
    mesh = closed_mesh(Path(stated.file), stated.scale, where)
    if (size := float(np.max(mesh.extents))) > LARGEST_SIZE_M:
        raise RobotFileError(
            f"{where} is {size:g} m long, but at most {LARGEST_SIZE_M:g} m is possible; a file in "
            "millimetres needs scale = 0.001"
        )
    mesh.apply_transform(pose_to_transform(stated.pose))
    return mesh


@lru_cache(maxsize=16)
def _drawn(geometry: RobotGeometry) -> tuple[list[Part], tuple[str, ...], NDArray[np.int_]]:
    """Return the parts of a geometry sorted by body, their names, and their former indices (n,)."""
    parts = parts_of(geometry).all
    order = sorted(range(len(parts)), key=lambda index: parts[index].body)
    return (
        [parts[index] for index in order],
        tuple(parts[index].name for index in order),
        np.array(order),
    )


def robot_transforms(robot: Robot, pose: Array) -> PlacedBodies:
    """Return base_from_body (n, 4, 4) of all parts of the legs with the platform at a pose (6,).

    The order is that of `robot_meshes`.
    """
    _, names, order = _drawn(robot.geometry)
    parts = parts_of(robot.geometry)
    ends = parts.rods(robot, pose)[order]
    transforms = rod_transforms(ends[:, 0], ends[:, 1])
    if robot.geometry.meshes:
        frames = parts.frames(robot, pose)
        meshed = meshed_parts(robot.geometry)
        transforms[meshed, :3, :3] = frames.axes[order][meshed]
        transforms[meshed, :3, 3] = frames.origin[order][meshed]
    return PlacedBodies(names, transforms)
