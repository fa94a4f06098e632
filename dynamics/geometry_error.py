"""A robot whose joints do not sit where the drawing says."""

import numpy as np

from dynamics.checks import check_type, real
from dynamics.errors import RobotFileError
from dynamics.geometry import RobotGeometry
from dynamics.legs.numbers import POINTS
from dynamics.robot import Robot
from dynamics.robot_file import RobotDescription


def with_geometry(robot: Robot, geometry: RobotGeometry) -> Robot:
    """The robot with another geometry of the same kinds of legs."""
    return Robot(RobotDescription(robot.name, geometry, robot.parameter_sets))


def with_geometry_error(
    robot: Robot, std: float, rng: np.random.Generator, length_std: float = 0.0, turn_std: float = 0.0
) -> Robot:
    """The robot with every coordinate of its base joints B and platform joints A off by a normal error of `std`, m, its
    lengths off by `length_std`, m, and its axes turned by `turn_std`, rad.

    Joint coordinates are set to zero at the home pose as those of a real robot are, so home keeps them where they are
    zero there. Errors of zero give the robot itself; the same state of `rng` gives the same robot.
    Raises RobotFileError for a negative error, and where a leg does not reach the home pose any more.
    """
    check_type("robot", robot, Robot, RobotFileError)
    real("geometry error", std, RobotFileError, least=0, unit=" m")
    real("error of lengths", length_std, RobotFileError, least=0, unit=" m")
    real("error of axes", turn_std, RobotFileError, least=0, unit=" rad")
    if std == length_std == turn_std == 0:
        return robot
    drawn = dict(zip(POINTS, std * rng.standard_normal((2, robot.layout.joints, 3)), strict=True))
    names, units = robot.geometry.number_names, robot.geometry.number_units
    deviations = rng.standard_normal(len(names)) * [length_std if unit == "m" else turn_std for unit in units]
    for place, (leg, field, entry) in enumerate(f"{name}.".split(".")[:3] for name in names):
        if field in drawn:
            deviations[place] = drawn[field][int(leg.removeprefix("leg")) - 1, "xyz".index(entry)]
    try:
        geometry = robot.geometry.moved(deviations).zeroed()
    except RobotFileError as error:
        raise RobotFileError(f"with joints off by {std:g} m: {error}") from error
    return with_geometry(robot, geometry)
