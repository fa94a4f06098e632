"""Workcell: a robot and the stereo sensor that looks at the robot, ready to be drawn."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

import cmmsim
from cmmsim.files import SensorFile
from cmmsim.files.rig_and_bodies import MarkedBody, marked_body, rig_from_file
from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import apply, invert, pose_to_transform
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.imaging.scene_bodies import scene_body
from cmmsim.visibility import SightLines
from dynamics import Robot
from dynamics.bodies import Part, parts_of
from identify.arrays import Array
from identify.errors import ScenarioError
from identify.experiment.leg_bodies import meshed_parts, robot_meshes, robot_transforms
from identify.experiment.sensor_in_loop import check_platform

PLATE_M = 0.012  # half the thickness, in m, of the plate drawn for a platform without a given shape


@dataclass(frozen=True)
class Solid:
    """Convex body with its stickers, in its own frame, in m.

    Attributes
    ----------
    vertices
        Vertices (n, 3).
    faces
        Triangles (m, 3). Their corners run counter-clockwise, seen from outside.
    ids
        Names (k,) of the stickers.
    places, normals
        True positions (k, 3) and outward normals (k, 3) of the stickers.
    radius, ring_radius
        Radii of a sticker and of its ring.
    """

    name: str
    vertices: Array
    faces: NDArray[np.int_]
    ids: tuple[str, ...] = ()
    places: Array = field(default_factory=lambda: np.zeros((0, 3)))
    normals: Array = field(default_factory=lambda: np.zeros((0, 3)))
    radius: float = 0.0
    ring_radius: float = 0.0


@dataclass(frozen=True)
class ViewingCamera:
    """Camera with its pose base_from_camera (4, 4). Its axes are x right, y down and z forward."""

    name: str
    lens: PinholeCamera
    base_from_camera: Array

    @property
    def centre(self) -> Array:
        """Centre of projection (3,) in the base frame, in m."""
        return np.asarray(self.base_from_camera[:3, 3])

    def frustum(self, depth: float) -> Array:
        """Return the corners (4, 3), m, of the field of view at a depth, m.

        The corners are in the base frame, clockwise from the top left corner of the image.
        """
        # The edges of the image have half-integer coordinates, because the centre of the first
        # pixel is (0, 0).
        right = self.lens.width - 0.5
        low = self.lens.height - 0.5
        pixels = np.array([[-0.5, -0.5], [right, -0.5], [right, low], [-0.5, low]])
        ideal = self.lens.undistort(pixels)[0]
        # Rays through the undistorted corners, because the lens bends the field of view.
        rays = np.column_stack([ideal, np.ones(4)]) @ np.linalg.inv(self.lens.matrix).T
        return apply(self.base_from_camera, depth * rays)


@dataclass(frozen=True, eq=False)
class Workcell:
    """Robot, sensor, or both, made by `workcell`. The sensor looks at the robot's platform."""

    robot: Robot | None
    sensor: SensorFile | None

    @property
    def name(self) -> str:
        """Name in a title."""
        robot = f"robot {self.robot.name}" if self.robot else ""
        sensor = f"sensor {self.sensor.name}" if self.sensor else ""
        return " and ".join(filter(None, (robot, sensor)))

    @property
    def home(self) -> Array:
        """Pose (6,) of the platform at home [m, rad]."""
        if self.robot is not None:
            return self.robot.home_pose
        assert self.sensor is not None
        return np.array(self.sensor.platform.home)

    @cached_property
    def bodies(self) -> tuple[Solid, ...]:
        """Platform in its own frame, and base with stickers in the base frame.

        Without a sensor, there is only the platform.
        """
        if self.sensor is None:
            assert self.robot is not None
            return (_plate("platform", self.robot.geometry.platform_joints),)
        return tuple(
            _marked(name, self.sensor, stream) for stream, name in enumerate(("platform", "base"))
        )

    def placed(self, pose: Array) -> list[tuple[Solid, Array]]:
        """Return the bodies, each with base_from_body (4, 4). The platform is at a pose (6,)."""
        return list(zip(self.bodies, (pose_to_transform(pose), np.eye(4)), strict=False))

    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """Bodies of the robot's legs, leg by leg from the base. There are none without a robot."""
        return () if self.robot is None else tuple(parts_of(self.robot.geometry).all)

    @cached_property
    def leg_meshes(self) -> Mapping[str, trimesh.Trimesh]:
        """Meshes that the robot file gives to bodies of the legs, by the names of their parts.

        Parts without a mesh are rods.
        """
        if self.robot is None or not self.robot.geometry.meshes:
            return {}
        meshes = robot_meshes(self.robot)
        meshed = meshed_parts(self.robot.geometry)
        return {name: meshes[name] for name, own in zip(meshes, meshed, strict=True) if own}

    def rods(self, pose: Array) -> Array:
        """Return the ends (parts, 2, 3) of the legs' bodies in the base frame, m.

        The platform is at a pose (6,). Raises dynamics.UnreachablePoseError or dynamics.ChartError.
        """
        if self.robot is None:
            return np.zeros((0, 2, 3))
        return parts_of(self.robot.geometry).rods(self.robot, pose)

    @cached_property
    def frame(self) -> Array:
        """Lines (n, 2, 3) between neighbouring base joints of the legs, in the base frame, m."""
        if self.robot is None:
            return np.zeros((0, 2, 3))
        joints = self.robot.geometry.base_joints
        # Joints are sorted by their angle about their centre, so that lines do not cross.
        away = joints - joints.mean(axis=0)
        around = joints[np.argsort(np.arctan2(away[:, 1], away[:, 0]))]
        return np.stack([around, np.roll(around, -1, axis=0)], axis=1)

    @cached_property
    def rig(self) -> tuple[StereoRig, Array] | None:
        """Stereo rig and camera_from_base (4, 4), or None without a sensor."""
        return None if self.sensor is None else rig_from_file(self.sensor.rig)

    @cached_property
    def cameras(self) -> tuple[ViewingCamera, ...]:
        """Left and right camera. There are none without a sensor."""
        if self.rig is None:
            return ()
        rig, camera_from_base = self.rig
        sides = zip(("left", "right"), rig.cameras, rig.from_camera, strict=True)
        return tuple(
            ViewingCamera(name, lens, invert(move @ camera_from_base)) for name, lens, move in sides
        )

    def seen(self, pose: Array) -> Array:
        """Return the positions (k, 3) of the platform's stickers that both cameras see.

        They are in the base frame, m, for a pose (6,). Occlusion by other bodies is neglected.
        """
        if self.rig is None or self.sensor is None:
            return np.zeros((0, 3))
        # Visibility is decided at nominal positions, but the true positions are returned.
        lines = SightLines(self.marked("platform"), *self.rig)
        return apply(pose_to_transform(pose), self.bodies[0].places[lines.visible(pose)])

    def marked(self, name: str) -> MarkedBody:
        """Return the nominal stickers of the "platform" or the "base" from the sensor file."""
        assert self.sensor is not None
        return marked_body(name, getattr(self.sensor, name))

    def live_sensor(self, seed: int, renderer: str) -> cmmsim.Sensor:
        """Return the sensor with the legs in its view. It is not taught."""
        assert self.sensor is not None
        sensor = cmmsim.Sensor(self.sensor, seed, renderer=renderer)
        if self.robot is not None:
            sensor.add_bodies(robot_meshes(self.robot))
        return sensor

    def obstacles(self, pose: Array) -> Mapping[str, Array]:
        """Return base_from_body (4, 4) of the legs' bodies, which can hide stickers, by name."""
        return {} if self.robot is None else robot_transforms(self.robot, pose)


def workcell(robot: Robot | None = None, sensor: SensorFile | None = None) -> Workcell:
    """Return the workcell of a robot, of the file of a sensor, or of both.

    `cmmsim.files.read_sensor_file` reads the file of a sensor. Raises ScenarioError if neither is
    given, or if the platform in the sensor file is not the robot's platform.
    """
    if robot is None and sensor is None:
        raise ScenarioError("a scene needs a robot, a sensor, or both")
    if robot is not None and sensor is not None:
        check_platform(robot, sensor, sensor.name)
    return Workcell(robot, sensor)


def _marked(name: str, file: SensorFile, stream: int) -> Solid:
    """Return a body of a sensor file with its stickers at their true positions."""
    section = getattr(file, name)
    stickers = file.stickers
    marked = marked_body(name, section)
    drawn = scene_body(marked, section, stickers, stream)
    ids = tuple(map(str, marked.sticker_ids))
    normals = marked.sticker_normals
    return Solid(
        name,
        drawn.solid.vertices,
        drawn.solid.faces,
        ids,
        drawn.sticker_places,
        normals,
        stickers.radius,
        stickers.ring_radius,
    )


def _plate(name: str, joints: Array) -> Solid:
    """Return a plate around joints (n, 3), for a platform without a further description."""
    around = PLATE_M * np.vstack([np.eye(3), -np.eye(3)]) * np.array([1.5, 1.5, 1.0])
    points = (joints[:, None] + around).reshape(-1, 3)
    hull = ConvexHull(points)
    corners = points[hull.simplices]
    outward = hull.equations[:, :3]
    # Qhull does not order the corners of its triangles.
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    turned = np.einsum("ni,ni->n", normals, outward) < 0
    faces = np.where(turned[:, None], hull.simplices[:, ::-1], hull.simplices).astype(int)
    return Solid(name, points, faces)
