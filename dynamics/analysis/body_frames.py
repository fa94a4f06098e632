"""Where cranks and links are and how they turn at a pose: what a multibody engine needs to be put into that state.

Crank frame: z along the joint axis, x from B to T. Link frame: z from T to A, x = s x z normalised. Rotations are
base-from-body, base axes, SI units.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from dynamics.robot import Robot


@dataclass(frozen=True)
class BodyFrames:
    """Crank angles (6,), crank tips T and platform joints A (6, 3) in m, and base-from-body rotations of the platform
    (3, 3), the cranks (6, 3, 3) and the links (6, 3, 3)."""

    angle: np.ndarray
    tip: np.ndarray
    joint: np.ndarray
    platform: np.ndarray
    crank: np.ndarray
    link: np.ndarray


def body_frames(robot: Robot, pose: np.ndarray) -> BodyFrames:
    """Frames of all bodies with the platform at a pose (6,)."""
    geometry, angle = robot.geometry, robot.inverse_kinematics(pose)
    platform = Rotation.from_euler("XYZ", pose[3:6]).as_matrix()
    crank = crank_rotations(robot, angle)
    tip = crank_tips(robot, crank)
    joint = pose[:3] + geometry.platform_joints @ platform.T
    return BodyFrames(angle, tip, joint, platform, crank, _link_rotations(geometry.crank_axes, joint - tip))


def crank_rotations(robot: Robot, angle: np.ndarray) -> np.ndarray:
    """Base-from-crank (6, 3, 3) at crank angles (6,)."""
    axis, zero = robot.geometry.crank_axes, robot.geometry.crank_zero_directions
    x = np.cos(angle)[:, None] * zero + np.sin(angle)[:, None] * np.cross(axis, zero)
    return np.stack([x, np.cross(axis, x), axis], axis=-1)


def crank_tips(robot: Robot, crank: np.ndarray) -> np.ndarray:
    """Crank tips T (6, 3) in m of base-from-crank rotations (6, 3, 3)."""
    return np.asarray(robot.geometry.base_joints + robot.geometry.crank_length * crank[:, :, 0])


def link_angular_velocities(robot: Robot, frames: BodyFrames, pose: np.ndarray, twist: np.ndarray) -> np.ndarray:
    """Angular velocities (6, 3) of the links in rad/s, base axes, without spin about their own axes (eq. 12)."""
    axis, rate = robot.geometry.crank_axes, robot.joint_jacobian(pose) @ twist
    link = frames.joint - frames.tip
    tip_rate = rate[:, None] * np.cross(axis, robot.geometry.crank_length * frames.crank[:, :, 0])
    link_rate = twist[:3] + np.cross(twist[3:], frames.joint - pose[:3]) - tip_rate
    return np.cross(link, link_rate) / np.sum(link**2, axis=1, keepdims=True)


def _link_rotations(axis: np.ndarray, link: np.ndarray) -> np.ndarray:
    z = link / np.linalg.norm(link, axis=1, keepdims=True)
    across = np.cross(axis, z)
    x = across / np.linalg.norm(across, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1)
