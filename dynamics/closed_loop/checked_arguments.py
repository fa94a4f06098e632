"""Checked arguments of a run: times of its frames, commands, and directions of the commands.

A direction is a change of all commands of a run. Poses can be differentiated along it.
"""

import numpy as np

from dynamics.checks import check_type, floats
from dynamics.errors import SimulationError
from dynamics.parameters import RigidGroups
from dynamics.robot import Robot


def most_directions(robot: Robot, groups: RigidGroups | None = None) -> int:
    """Return the largest number of directions along which one run can be differentiated.

    Parameters
    ----------
    robot : Robot
        Robot of the run.
    groups : RigidGroups, optional
        Groups as for `differentiate_servo`. With groups, derivatives with respect to the parameters
        take fewer columns, so that there is room for more directions.

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
    parameter_columns = len(layout.names)
    if groups is not None:
        parameter_columns -= len(layout.rigid_names) - len(groups.pivots)
    # one column is for the length of a step that an event shortens
    return layout.derivatives(len(robot.geometry.chart.freedoms)) - parameter_columns - 1


def checked_directions(
    directions: object, before: object, shape: tuple[int, int], most: int
) -> tuple[np.ndarray, np.ndarray]:
    """Checked directions: (frames, n, k) for the run, and (n, k) for the commands before it.

    `shape` is (frames, n). If `directions` is None, k is 0. If `before` is None, the commands
    before the run do not change. Raises SimulationError for a wrong shape, and if k exceeds `most`.
    """
    directions = np.zeros((*shape, 0)) if directions is None else directions
    given = np.asarray(directions)
    count = given.shape[2] if given.ndim == 3 else 0
    if count > most:
        raise SimulationError(f"{count} directions of the commands, but at most {most} fit here")
    checked = floats("directions", directions, (*shape, count), error=SimulationError)
    start = np.zeros((shape[1], count)) if before is None else before
    start = floats("start_directions", start, (shape[1], count), error=SimulationError)
    return np.ascontiguousarray(checked), np.ascontiguousarray(start)


def checked_times(times: object, frames: int) -> np.ndarray:
    """Times (frames,) of frames, s, that increase. Raises SimulationError otherwise."""
    checked = floats("times", times, (frames,), error=SimulationError)
    not_later = np.flatnonzero(np.diff(checked) <= 0)
    if len(not_later):
        first = int(not_later[0])
        raise SimulationError(
            f"times must increase, but frame {first + 1} is at {checked[first + 1]:.9g} s and "
            f"frame {first} at {checked[first]:.9g} s"
        )
    return checked


def held_commands(
    commands: object, shape: tuple[int, int], before: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Commands (frames, n) with the previous command in rows of NaN, and a mask (frames,).

    The mask is False for rows of NaN. `before` (n,) is the command before the first row. Raises
    SimulationError for a row that is neither finite nor all NaN.
    """
    given = floats("commands", commands, shape, error=SimulationError, finite=False)
    missing = np.isnan(given)
    written = ~missing.all(axis=1)
    if not np.isfinite(given[written]).all():
        frame = int(np.flatnonzero(written & ~np.isfinite(given).all(axis=1))[0])
        raise SimulationError(
            f"commands of frame {frame} are {given[frame]}: a row must be finite, or NaN as a whole"
        )
    newest = np.maximum.accumulate(np.where(written, np.arange(len(given)), -1))
    held = np.where((newest >= 0)[:, None], given[newest], before)
    return np.ascontiguousarray(held), written
