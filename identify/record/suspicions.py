"""Likely mistakes in the units, frames and joints of telemetry, found by trying alternatives.

A pose and the commands at its time give the same joint coordinates, except for the lag of the
drives and the errors of the geometry. If they do not, the poses are tried in other units, with
other axes and mirrored, and the commands in other units, directions, orders and zeros. For a log
with ``[columns]``, the sentences have the lines that its file should have.
"""

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from dynamics import Robot
from identify.arrays import Array
from identify.filtering import interpolated
from identify.record.columns import Columns, CommandColumns, PoseColumns
from identify.record.delays import MotionLag, motion_lag
from identify.record.telemetry import Telemetry
from identify.record.tried_columns import (
    command_units,
    mirrored_axes,
    other_poses,
    reordered,
    signs_line,
    zeros_line,
)

TRIED = 200  # number of poses with which other units and axes are tried
# Lags, s, of the motion behind the commands that are tried with other units and axes.
LAGS_S = (0.0, 0.03, 0.06, 0.1, 0.15, 0.2, 0.3)
# Times, s, of the taps of the filter by which a joint follows its command, relative to the lag.
FILTER_S = (-0.1, -0.05, 0.0, 0.05, 0.1)
# Unexplained fraction of the joints' motion above which other orders are tried.
EXPLAINED = 0.02
# Largest ratio of the unexplained fraction of another order to that of the stated one at which the
# other one counts as right.
BETTER = 0.25
# Largest ratio of the unexplained fraction of an order to that of the best one at which the motion
# cannot choose between both.
EQUAL = 1.5
# Smallest fraction of poses in reach. With a smaller fraction, other units and axes are tried.
IN_REACH = 0.5
# Correlation of a joint with its command above which both are the same motion. It is also the
# smallest fraction of poses in reach with units and axes that fit.
FITS = 0.9
# Correlation of a joint with its command below which their directions are opposite.
OPPOSES = -0.8
# Distance, rad, of a joint's offset from whole turns below which it counts as these turns.
NEAR_TURN = 0.3
# Largest distance of poses from home as a mirror in the plane of the base shows it, as a fraction
# of the height of home above this plane.
OTHER_SIDE = 0.5
ALIKE = 0.02  # difference of mean correlations up to which units and axes fit equally well
# Largest offset of a joint from its command, as a fraction of its travel limit, that needs no other
# zero. Drives without an integral hold a joint away from its command.
ZERO = 0.5
SCALE = 2.0  # largest factor between two units that count as the same one. Loops overshoot and lag.


def suspicions(
    telemetry: Telemetry,
    robot: Robot,
    columns: Columns | None = None,
    lag_s: float | None = None,
) -> list[str]:
    """Return what is likely wrong with the units, frames and joints of telemetry, as sentences.

    ``columns`` is what the description of a log states. Units and axes that would fit are then
    those that it should state instead. Without ``lag_s``, the lag of the motion is determined here.
    """
    lag = lag_of(telemetry, robot).seconds if lag_s is None else lag_s
    return list(_found(telemetry, robot, columns, lag))


def fits(telemetry: Telemetry, robot: Robot, lag_s: float | None = None) -> bool:
    """Return whether the poses are in reach, and all joints move as their commands do.

    Without `lag_s`, the lag of the motion is determined here.
    """
    poses = telemetry.poses
    if _reached(_on_chart(poses.pose[poses.ok], robot), robot).mean() < FITS:
        return False
    time, coordinates = joint_motion(telemetry, robot)
    lag = lag_of(telemetry, robot).seconds if lag_s is None else lag_s
    commanded = _commands_at(telemetry, time - lag)
    return bool(np.diagonal(_correlations(commanded, coordinates)).min() > FITS)


def unexplained(telemetry: Telemetry, robot: Robot, lag_s: float | None = None) -> float:
    """Return the fraction of the joints' motion that the commands do not explain.

    Each joint follows its own command through a linear filter with the taps `FILTER_S` about the
    lag of the motion. The result is the unexplained fraction of the variance, averaged over the
    joints. It is 1 if too few poses are in reach. Without `lag_s`, the lag is determined here.
    """
    poses = telemetry.poses
    if _reached(_on_chart(poses.pose[poses.ok], robot), robot).mean() < FITS:
        return 1.0
    time, coordinates = joint_motion(telemetry, robot)
    lag = lag_of(telemetry, robot).seconds if lag_s is None else lag_s
    commanded = np.stack(
        [_commands_at(telemetry, time - lag + later) for later in FILTER_S], axis=-1
    )
    fractions = []
    for commands, motion in zip(np.moveaxis(commanded, 1, 0), coordinates.T, strict=True):
        taps = np.column_stack([commands, np.ones(len(motion))])
        residual = motion - taps @ np.linalg.lstsq(taps, motion, rcond=None)[0]
        fractions.append(residual.var() / max(motion.var(), np.finfo(float).tiny))
    return float(np.mean(fractions))


def better_order(stated: float, shares: Mapping[str, float]) -> str:
    """Return a sentence about conventions of Euler angles that fit better than the stated one.

    It is empty if none fits much better. ``stated`` is the fraction of the motion that is
    `unexplained` with the stated convention. ``shares`` are those of other conventions by name.
    """
    best = min(shares.values(), default=1.0)
    if best > BETTER * stated:
        return ""
    fitting = sorted((share, name) for name, share in shares.items() if share <= EQUAL * best)
    named = " or ".join(repr(name) for _, name in fitting)
    return (
        f"the order of the Euler angles is likely wrong: the commands leave {stated:.0%} of the "
        f"joints' motion unexplained, and {best:.1%} with convention = {named}"
    )


def joint_motion(telemetry: Telemetry, robot: Robot) -> tuple[Array, Array]:
    """Return the times (K,) and joint coordinates (K, n) of the measured poses in reach."""
    poses = telemetry.poses
    free = _on_chart(poses.pose[poses.ok], robot)
    reached = _reached(free, robot)
    return poses.time[poses.ok][reached], robot.inverse_kinematics(free[reached])


def lag_of(telemetry: Telemetry, robot: Robot) -> MotionLag:
    """Return the lag of the measured motion behind the commands."""
    time, coordinates = joint_motion(telemetry, robot)
    commands = telemetry.commands
    return motion_lag(time, coordinates, commands.time, commands.command)


def _found(
    telemetry: Telemetry, robot: Robot, columns: Columns | None, lag: float
) -> Iterator[str]:
    poses = telemetry.poses
    measured, given = (columns.measured, columns.command) if columns else (None, None)
    reached = _reached(_on_chart(poses.pose[poses.ok], robot), robot)
    if reached.mean() < IN_REACH:
        yield _out_of_reach(telemetry, robot, reached, measured)
        return
    time, coordinates = joint_motion(telemetry, robot)
    commanded = _commands_at(telemetry, time - lag)
    moving = (np.ptp(commanded, axis=0) > 0) & (np.ptp(coordinates, axis=0) > 0)
    if not moving.all():
        return
    alike = np.diagonal(_correlations(commanded, coordinates))
    order = "" if alike.min() > FITS else _other_order(telemetry, time, coordinates, given)
    sure = np.flatnonzero(np.abs(alike) > FITS)
    hint = ""
    if len(sure) < len(alike):
        hint = order or _fitting(telemetry, robot, alike.mean(), measured)
    elif alike.min() > 0 and unexplained(telemetry, robot, lag) > EXPLAINED:
        # Wrong columns of small angles leave all joints similar to their commands.
        hint = _fitting(telemetry, robot, alike.mean(), measured)
    if not hint:
        # A joint whose drive does not follow says nothing about its own zero.
        yield from _of_joints(sure, commanded, coordinates, alike, robot, order, given)
        if alike.min() > FITS:
            yield from _mirrored(telemetry, robot, measured)
    else:
        yield (
            "the measured motion is not that of the commands (correlations of the joints from "
            f"{alike.min():.2f} to {alike.max():.2f}); {hint}"
        )


def _mirrored(telemetry: Telemetry, robot: Robot, measured: PoseColumns | None) -> Iterator[str]:
    """Yield a sentence if poses lie where a mirror in the plane of the base would show home."""
    poses = telemetry.poses
    height = float(np.median(poses.pose[poses.ok, 2]))
    home = float(robot.home_pose[2])
    if abs(height + home) < OTHER_SIDE * abs(home):
        yield (
            f"the poses lie at z = {height:.3g} m, and home is at {home:.3g} m: a pose mirrored in "
            f"the plane of the base has the same joint coordinates{mirrored_axes(measured)}"
        )


def _other_order(
    telemetry: Telemetry, time: Array, coordinates: Array, given: CommandColumns | None
) -> str:
    """Return a hint about the order of the joints in which all commands fit, or an empty string."""
    for lag in LAGS_S:
        alike = _correlations(_commands_at(telemetry, time - lag), coordinates)
        joints, order = linear_sum_assignment(-alike)
        if (order != joints).any() and alike[joints, order].min() > FITS:
            movers = np.argsort(order)
            listed = ", ".join(str(column + 1) for column in movers)
            said = f"in another order they would fit: columns {listed} move joints 1, 2, ..."
            return said + ("" if given is None else f", {reordered(given, movers)}")
    return ""


def _of_joints(
    joints: NDArray[np.intp],
    commanded: Array,
    coordinates: Array,
    alike: Array,
    robot: Robot,
    order: str,
    given: CommandColumns | None,
) -> Iterator[str]:
    """Yield sentences on wrong directions, units and zeros of joints (k,) that follow commands.

    `alike` (n,) has the correlations of all joints with their commands. Negative ones count, too.
    `order` is a hint about another order in which the commands would fit, or empty. `given` is what
    a description states of the commands.
    """
    if not len(joints):
        return
    prismatic = robot.layout.prismatic
    unit = robot.layout.joint_unit
    against = joints[alike[joints] < OPPOSES]
    if len(against):
        listed = ", ".join(str(joint + 1) for joint in against)
        yield (
            f"the commands of joint {listed} count against the direction of the robot file: their "
            f"correlation with the poses is {alike[against[0]]:.2f} {signs_line(given, against)}"
            + (f"; or {order}" if order else "")
        )
        return
    slopes = alike * coordinates.std(axis=0) / commanded.std(axis=0)
    slope = float(np.median(slopes[joints]))
    for factor, said in command_units(prismatic, given):
        if said and abs(np.log(slope / factor)) < np.log(SCALE):
            yield (
                f"the commands are {1 / slope:.3g} times the joint coordinates of the poses: {said}"
            )
            return
    offsets = np.median(coordinates - commanded, axis=0)
    whole = np.zeros(len(offsets)) if prismatic else 2 * np.pi * np.round(offsets / (2 * np.pi))
    whole[np.abs(offsets - whole) >= NEAR_TURN] = 0.0
    for joint, offset in zip(joints, offsets[joints], strict=True):
        turns = round(whole[joint] / (2 * np.pi))
        text = (
            f"the commands of joint {joint + 1} lie {-offset:.4g} {unit} from the joint "
            "coordinates of the poses"
        )
        if turns:
            by = "a turn" if abs(turns) == 1 else f"{abs(turns)} turns"
            yield f"{text}: its zero is off by {by} {zeros_line(given, whole)}"
        elif abs(offset) > ZERO * robot.travel_limit:
            yield (
                f"{text}, {abs(offset) / robot.travel_limit:.0%} of the travel limit: its zero, or "
                "the frame of the poses, differs from the robot file"
            )


def _out_of_reach(
    telemetry: Telemetry,
    robot: Robot,
    reached: NDArray[np.bool_],
    measured: PoseColumns | None,
) -> str:
    """Return a message that poses are out of reach, with the first row and what would fit."""
    poses = telemetry.poses
    row = int(np.flatnonzero(poses.ok)[np.argmin(reached)])
    place = poses.rows.place(row)
    pose = ", ".join(f"{value:.6g}" for value in poses.pose[row])
    leg = int(np.argmin(robot.reach_margin(_on_chart(poses.pose[row], robot)))) + 1
    hint = _fitting(telemetry, robot, 0.0, measured)
    return (
        f"{place}: leg {leg} of {robot.name} cannot reach the measured pose [{pose}], m and rad, "
        f"and {1 - reached.mean():.0%} of the poses are out of reach; "
        + (hint or "its units, its frame (base_from_frame) or its body differ from the robot file")
    )


def _fitting(telemetry: Telemetry, robot: Robot, alike: float, measured: PoseColumns | None) -> str:
    """Return a hint about units and axes with which the poses would move as the commands do.

    It is empty if none fit much better than the present ones, whose mean correlation is `alike`.
    `measured` is what a description states of the poses.
    """
    poses = telemetry.poses
    rows = np.flatnonzero(poses.ok)
    rows = rows[:: -(-len(rows) // TRIED)]
    commanded = [_commands_at(telemetry, poses.time[rows] - lag) for lag in LAGS_S]
    best = max(alike, FITS - 0.1)
    nearest = 0.0
    found = ""
    for said, other in other_poses(poses.pose[rows], measured):
        tried = _on_chart(other, robot)
        reached = _reached(tried, robot)
        if reached.mean() < FITS:
            continue
        joints = robot.inverse_kinematics(tried[reached])
        score = max(np.diagonal(_correlations(one[reached], joints)).mean() for one in commanded)
        # A pose mirrored in the plane of the base has the same joint coordinates.
        distance = float(np.abs(np.median(tried, axis=0) - robot.home_pose)[:3].max())
        # Smaller changes are tried first. Only a better fit, or one nearer to home, replaces them.
        if score > best + ALIKE or (score > best - ALIKE and distance < nearest / 2):
            best = max(best, score)
            nearest = distance
            found = said
    return found


def _commands_at(telemetry: Telemetry, time: Array) -> Array:
    """Return the commands (N, n), interpolated at times (N,) and held beyond the first and last."""
    commands = telemetry.commands
    return interpolated(time, commands.time, commands.command)


def _on_chart(poses: Array, robot: Robot) -> Array:
    """Return poses (N, 6) with the entries that the platform cannot change set to those of home."""
    return np.asarray(robot.pose(robot.coordinates(poses)))


def _reached(poses: Array, robot: Robot) -> NDArray[np.bool_]:
    return np.asarray((robot.reach_margin(poses) > 0).all(axis=-1))


def _correlations(commanded: Array, coordinates: Array) -> Array:
    """Return the correlations (n, n) of the commands with the joint coordinates, both (N, n)."""
    wanted = commanded - commanded.mean(axis=0)
    moved = coordinates - coordinates.mean(axis=0)
    scale = np.sqrt(np.outer((wanted**2).sum(axis=0), (moved**2).sum(axis=0)))
    # A joint that does not move correlates with none.
    return np.asarray((wanted.T @ moved) / np.where(scale > 0, scale, 1.0))
