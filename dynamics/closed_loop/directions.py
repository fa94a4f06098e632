"""Directions of the commands of a run along which its poses are differentiated."""

import numpy as np

from dynamics.checks import check_type, floats
from dynamics.errors import SimulationError
from dynamics.parameters import RigidGroups
from dynamics.robot import Robot


def most_directions(robot: Robot, groups: RigidGroups | None = None) -> int:
    """Return the number of directions of commands along which one run can be differentiated.

    Parameters
    ----------
    robot : Robot
        Robot of the run.
    groups : RigidGroups, optional
        As for `differentiate_servo`. Columns that they spare are free for directions.

    Returns
    -------
    int
        Largest number of directions.

    Raises
    ------
    SimulationError
        If `robot` is not a Robot.

    Examples
    --------
    >>> closed_loop.most_directions(robot)
    44
    """
    check_type("robot", robot, Robot, SimulationError)
    layout = robot.layout
    shown = len(layout.names)
    if groups is not None:
        shown -= len(layout.rigid_names) - len(groups.pivots)
    # one column is for the length of a step that an event cuts
    return layout.derivatives(len(robot.geometry.chart.freedoms)) - shown - 1


def checked_directions(directions: object, shape: tuple[int, int], most: int) -> np.ndarray:
    """Directions (frames, n, k) of commands of a shape (frames, n), at most so many.

    Raises SimulationError.
    """
    given = np.asarray(directions)
    count = given.shape[2] if given.ndim == 3 else 0
    if count > most:
        raise SimulationError(f"{count} directions of the commands, at most {most} fit here")
    checked = floats("directions", directions, (*shape, count), error=SimulationError)
    return np.ascontiguousarray(checked)
