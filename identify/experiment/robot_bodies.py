"""Cranks and links as the cameras see them: rods between the joints, which can hide stickers."""

import trimesh

import cmmsim
from dynamics import Robot
from dynamics.analysis.body_frames import crank_rotations, crank_tips
from identify.arrays import Array

CRANK_RADIUS_M = 0.010
LINK_RADIUS_M = 0.006


def robot_meshes(robot: Robot) -> dict[str, trimesh.Trimesh]:
    """Meshes [m] of the six cranks and six links, each along its own z axis from its first joint."""
    crank = cmmsim.rod(robot.geometry.crank_length, CRANK_RADIUS_M)
    link = cmmsim.rod(robot.geometry.link_length, LINK_RADIUS_M)
    legs = range(1, 7)
    return {f"crank{leg}": crank for leg in legs} | {f"link{leg}": link for leg in legs}


def robot_transforms(robot: Robot, pose: Array) -> dict[str, Array]:
    """base_from_body (4, 4) of every crank and link with the platform at a pose (6,)."""
    geometry = robot.geometry
    base_from_platform = cmmsim.pose_to_transform(pose)
    ends = geometry.platform_joints @ base_from_platform[:3, :3].T + base_from_platform[:3, 3]
    tips = crank_tips(robot, crank_rotations(robot, robot.inverse_kinematics(pose)))
    transforms = {}
    for leg in range(6):
        transforms[f"crank{leg + 1}"] = cmmsim.rod_transform(geometry.base_joints[leg], tips[leg])
        transforms[f"link{leg + 1}"] = cmmsim.rod_transform(tips[leg], ends[leg])
    return transforms
