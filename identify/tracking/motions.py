"""Motions to follow, which all start at rest.

They are the Fourier trajectories of the validation, a circle, a square, and motions through poses
from a file. Circle and square lie in the first two coordinates of the platform, within the box of
the scenario's excitation, and start at home.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import make_interp_spline

from dynamics import Robot, workspace
from dynamics.errors import DynamicsError
from dynamics.files import read_bytes
from dynamics.kinematics.platform import POSE_NAMES, Chart
from identify.arrays import Array
from identify.errors import TrajectoryError
from identify.excitation.design import DesignTask, validation_trajectories
from identify.experiment.law_in_loop import NamedMotion
from identify.loop_parameters import of_actuators
from identify.trajectory import box_of

LARGEST_MOTION = 100_000_000  # largest number of bytes of a file of poses: an hour at 200 Hz

COLUMNS = ("t", *POSE_NAMES)

FEWEST_ROWS = 6  # number of rows that a spline of fifth degree needs


@dataclass(frozen=True)
class CoordinateMotion:
    """Motion of a platform by functions of time.

    The functions return the coordinates (N, m) at times (N,) [s], and their first and second
    derivatives.
    """

    chart: Chart
    coordinates: tuple[Callable[[Array], Array], ...]

    def pose(self, t: Array) -> Array:
        """Return the poses (N, 6) [m, rad]."""
        return self.chart.pose(self.coordinates[0](t))

    def pose_rate(self, t: Array) -> Array:
        """Return the time derivatives (N, 6) of the poses."""
        return self.chart.lifted(self.coordinates[1](t))

    def pose_acceleration(self, t: Array) -> Array:
        """Return the second time derivatives (N, 6) of the poses."""
        return self.chart.lifted(self.coordinates[2](t))


def motions(design: DesignTask, seed: int, own: Path | None = None) -> list[NamedMotion]:
    """Return the validation trajectories of a design, a circle and a square.

    With a file ``own``, only the motion through its poses is returned, see `read_motion`. Raises
    TrajectoryError.
    """
    robot = design.robot
    limits = design.settings
    if own is not None:
        fastest = of_actuators(robot, limits, "max_joint_velocity")
        return [read_motion(own, robot, fastest)]
    duration = design.validation.duration_s
    named: list[NamedMotion] = [
        NamedMotion(f"unseen {k}", path, duration)
        for k, path in enumerate(validation_trajectories(design, seed), start=1)
    ]
    box = box_of(
        robot.geometry.chart, limits.position_amplitude_m, limits.orientation_amplitude_rad
    )
    # One turn takes one period of the highest harmonic.
    turn_s = 1 / (limits.fundamental_hz * limits.harmonics)
    named.append(NamedMotion("circle", circle(robot, float(box[0]) / 2, turn_s), duration))
    named.append(NamedMotion("corner", square(robot, float(box[:2].min()), duration / 5), duration))
    return named


def circle(robot: Robot, radius: float, turn_s: float) -> CoordinateMotion:
    """Return a motion along a circle through home, with a radius in m.

    At full speed one turn takes ``turn_s``, in s. The speed rises smoothly during the first
    ``turn_s``.
    """
    home = robot.coordinates(robot.home_pose)
    speed = 2 * np.pi / turn_s

    def angle(t: Array) -> tuple[Array, Array, Array]:
        s = np.clip(t / turn_s, 0.0, 1.0)
        # This is the integral of the smooth step of fifth degree.
        travelled = s**4 * (2.5 - 3 * s + s**2)
        step = s**3 * (10 - 15 * s + 6 * s**2)
        rising = 30 * s**2 * (1 - s) ** 2 / turn_s
        turned = speed * (turn_s * travelled + np.maximum(t - turn_s, 0.0))
        return turned, speed * step, speed * rising

    def laid(first: Array, second: Array, base: Array) -> Array:
        rows = np.tile(base, (len(first), 1))
        rows[:, 0] += radius * first
        rows[:, 1] += radius * second
        return rows

    def position(t: Array) -> Array:
        phi = angle(np.asarray(t))[0]
        return laid(np.cos(phi) - 1, np.sin(phi), home)

    def rate(t: Array) -> Array:
        phi, w, _ = angle(np.asarray(t))
        return laid(-np.sin(phi) * w, np.cos(phi) * w, 0 * home)

    def acceleration(t: Array) -> Array:
        phi, w, rising = angle(np.asarray(t))
        first = -np.cos(phi) * w**2 - np.sin(phi) * rising
        second = np.cos(phi) * rising - np.sin(phi) * w**2
        return laid(first, second, 0 * home)

    return CoordinateMotion(robot.geometry.chart, (position, rate, acceleration))


def square(robot: Robot, side: float, edge_s: float) -> CoordinateMotion:
    """Return a motion along a square from home.

    The motion follows the first coordinate, then the second, and back in the same order. Each edge
    takes ``edge_s``, in s, and is a polynomial of fifth degree from rest to rest. The jerk is at
    most 60 side / edge_s^3.
    """
    home = robot.coordinates(robot.home_pose)
    corners = side * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0]])

    def rows(t: Array, along: Array, base: Array, whole: float) -> Array:
        # After the last edge, the motion rests at its end, which is home.
        edge = np.clip(np.floor(np.asarray(t) / edge_s).astype(int), 0, 3)
        laid = np.tile(base, (len(edge), 1))
        laid[:, :2] += whole * corners[edge] + along[:, None] * np.diff(corners, axis=0)[edge]
        return laid

    def fraction(t: Array) -> Array:
        edge = np.clip(np.floor(np.asarray(t) / edge_s), 0, 3)
        return np.clip(np.asarray(t) / edge_s - edge, 0.0, 1.0)

    def position(t: Array) -> Array:
        s = fraction(t)
        return rows(t, s**3 * (10 - 15 * s + 6 * s**2), home, 1.0)

    def rate(t: Array) -> Array:
        s = fraction(t)
        return rows(t, 30 * s**2 * (1 - s) ** 2 / edge_s, 0 * home, 0.0)

    def acceleration(t: Array) -> Array:
        s = fraction(t)
        return rows(t, 60 * s * (1 - s) * (1 - 2 * s) / edge_s**2, 0 * home, 0.0)

    return CoordinateMotion(robot.geometry.chart, (position, rate, acceleration))


def read_motion(path: Path, robot: Robot, fastest: float) -> NamedMotion:
    """Read a motion through the poses of a CSV file.

    Parameters
    ----------
    path
        File with the columns t, x, y, z, alpha, beta, gamma, in s, m and rad. The motion is a
        spline of fifth degree through the poses, at rest and without acceleration at both ends.
    robot
        Robot that follows the motion.
    fastest
        Largest speed of a joint, in rad/s or m/s.

    Raises
    ------
    TrajectoryError
        The file cannot be read, columns are missing, there are too few rows, the times do not begin
        at 0 or do not increase, numbers are not finite, the platform cannot have a pose, or a step
        between rows needs a larger joint speed.
    """
    try:
        # Spreadsheets write a byte order mark, which utf-8-sig skips.
        content = read_bytes(path, f"the motion {path}", TrajectoryError, LARGEST_MOTION)
        text = content.decode("utf-8-sig")
        lines = [line.split(",") for line in text.splitlines() if line.strip()]
    except UnicodeDecodeError as error:
        raise TrajectoryError(f"cannot read the motion {path}: {error}") from None
    header = [name.strip() for name in lines[0]] if lines else []
    if len(header) == 1 and ";" in header[0]:
        raise TrajectoryError(f"{path}: cells must be separated by commas, not by semicolons")
    missing = [name for name in COLUMNS if name not in header]
    if missing:
        raise TrajectoryError(
            f"{path} lacks the columns {', '.join(missing)}; it needs {', '.join(COLUMNS)}"
        )
    table = np.empty((len(lines) - 1, len(COLUMNS)))
    for row, line in enumerate(lines[1:]):
        try:
            table[row] = [float(line[header.index(name)]) for name in COLUMNS]
        except (ValueError, IndexError):
            raise TrajectoryError(
                f"{path}, row {row + 1}: {','.join(line)!r} are not {len(COLUMNS)} numbers"
            ) from None
    times = table[:, 0]
    poses = table[:, 1:]
    if len(table) < FEWEST_ROWS:
        raise TrajectoryError(f"{path} has {len(table)} rows; it needs at least {FEWEST_ROWS}")
    if not np.isfinite(table).all():
        row = int(np.argmin(np.isfinite(table).all(axis=1)))
        raise TrajectoryError(
            f"{path}, row {row + 1}: {','.join(lines[row + 1])!r} are not all finite numbers"
        )
    if times[0] != 0 or not (np.diff(times) > 0).all():
        # This is the first row whose time does not increase.
        row = int(np.argmin(np.diff(times, prepend=-1.0) > 0)) if times[0] == 0 else 0
        raise TrajectoryError(
            f"{path}, row {row + 1}: t is {times[row]:g}; times must begin at 0 and increase"
        )
    try:
        robot.charted(poses)
    except DynamicsError as error:
        raise TrajectoryError(f"{path}: {error}") from None
    _check_jumps(path, robot, times, poses, fastest)
    zeros = np.zeros(len(robot.coordinate_names))
    still = [(1, zeros), (2, zeros)]
    spline = make_interp_spline(times, robot.coordinates(poses), k=5, bc_type=(still, still))
    end = float(times[-1])

    def held(order: int) -> Callable[[Array], Array]:
        # After the end the platform stands still: the pose is constant, derivatives are zero.
        derivative = spline.derivative(order)
        return lambda t: (
            derivative(np.clip(t, 0.0, end))
            * (1.0 if order == 0 else (np.asarray(t) <= end)[:, None])
        )

    motion = CoordinateMotion(robot.geometry.chart, (held(0), held(1), held(2)))
    return NamedMotion(path.stem, motion, end)


def _check_jumps(path: Path, robot: Robot, times: Array, poses: Array, fastest: float) -> None:
    """Raise TrajectoryError if a step between rows is too fast for a joint.

    Poses out of reach have no joint coordinates. They are not checked here.
    """
    steps = np.diff(times)
    unit = robot.layout.joint_unit
    moved = np.abs(np.diff(workspace.measure(robot, poses).theta, axis=0))
    speeds = np.nan_to_num(moved / steps[:, None])
    row = int(np.argmax(speeds.max(axis=1) > fastest))
    joint = int(np.argmax(speeds[row]))
    jump = np.diff(poses, axis=0)[row]
    if speeds[row, joint] > fastest:
        raise TrajectoryError(
            f"{path}, row {row + 2}: the step from the row before, {np.linalg.norm(jump[:3]):.3g} "
            f"m and {np.linalg.norm(jump[3:]):.3g} rad in {steps[row]:.3g} s, asks joint "
            f"{joint + 1} for {speeds[row, joint]:.3g} {unit}/s, limit "
            f"excitation.max_joint_velocity_{unit}_s = {fastest:g}"
        )
