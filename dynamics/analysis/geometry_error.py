"""A robot whose joints do not sit where the drawing says: the plant of a model with the nominal geometry."""

from dataclasses import replace

import numpy as np

from dynamics.checks import check_type, real
from dynamics.errors import RobotFileError
from dynamics.kinematics.geometry import LEGS, Rss6Geometry
from dynamics.kinematics.inverse_kinematics import home_angles
from dynamics.robot import Robot
from dynamics.robot_file import RobotDescription


def with_geometry_error(robot: Robot, std: float, rng: np.random.Generator) -> Robot:
    """The robot with every coordinate of its base joints B and platform joints A off by a normal error of `std`, m.

    Crank and link lengths and the crank axes stay. The cranks are set to zero at the home pose as those of a real
    robot are, so home keeps its crank angles. An error of zero gives the robot itself; the same state of `rng` gives
    the same robot. Raises RobotFileError for a negative error, and where a leg does not reach the home pose any more.
    """
    check_type("robot", robot, Robot, RobotFileError)
    if real("geometry error", std, RobotFileError, least=0, unit=" m") == 0:
        return robot
    base, platform = std * rng.standard_normal((2, LEGS, 3))
    nominal = robot.geometry
    moved = replace(nominal, base_joints=nominal.base_joints + base, platform_joints=nominal.platform_joints + platform)
    try:
        geometry = _zeroed_at_home(moved)
    except RobotFileError as error:
        raise RobotFileError(f"with joints off by {std:g} m: {error}") from error
    return Robot(RobotDescription(robot.name, geometry, robot.parameter_sets))


def _zeroed_at_home(geometry: Rss6Geometry) -> Rss6Geometry:
    """The geometry with its crank angles counted from where the cranks stand at the home pose."""
    angles = home_angles(geometry)[:, None]
    zero = geometry.crank_zero_directions
    turned = np.cos(angles) * zero + np.sin(angles) * np.cross(geometry.crank_axes, zero)
    return replace(geometry, crank_zero_directions=turned)
