"""Telemetry from a log whose columns have other names, which ``[columns]`` states.

A pose of the log is (R, p), a rotation and a position in the log's own frame. In our axes it is
(A R A^T, A p), where A has one entry of 1 or -1 in each row. If its determinant is -1, A makes a
left-handed system right-handed.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from dynamics import Robot
from identify.arrays import Array
from identify.errors import RecordError
from identify.files.dataset import POSE
from identify.record.columns import (
    ANGLES,
    FRAMES,
    LENGTHS,
    Columns,
    CommandColumns,
    Log,
    PoseColumns,
    axes_matrix,
    transform,
)
from identify.record.csv_record import symmetric
from identify.record.lost_pose_marks import check_zeros, lost_rows
from identify.record.readers.bags import Bag, is_bag
from identify.record.readers.csv_exports import LoggedTable
from identify.record.readers.streams import LoggedFile, Stream, checked_topic
from identify.record.telemetry import CommandLog, PoseLog, ReferenceLog, Rows, Telemetry

# Largest deviation of a quaternion's length from one, and of R R^T from the identity.
UNIT_LENGTH = 0.01
# Largest plausible Euler angle, or entry of a rotation vector, rad. Larger ones may be degrees.
MOST_RADIANS = 2 * np.pi + 0.1
# Largest factor, as an exponent of 1000, between the ratio of two durations and a power of 1000, at
# which the unit of one duration is likely wrong. The factor is 2.
ALIKE = 0.1
ZEROS_REMEDY = 'lost = "zeros" in [columns.measured] takes them as lost'


def open_log(path: Path) -> LoggedFile:
    """Return the file at a path, whose columns can then be read: a bag, or a table."""
    return Bag(path) if is_bag(path) else LoggedTable(path)


def read_mapped(columns: Columns, path: Path, robot: Robot, rate_hz: float) -> Telemetry:
    """Read the log at a path, and the further files that its columns name.

    columns  Names, units and frames of the columns.
    path     File of the record. Other files are relative to its folder.
    robot    Robot whose joints the commands move.
    rate_hz  Rate of times that are counted in frames.

    Raises RecordError if a file cannot be read, has no such column, or a row is wrong. The message
    names the row.
    """
    return _Reader(path, rate_hz).telemetry(columns, robot)


def read_otherwise(
    columns: Columns,
    path: Path,
    robot: Robot,
    rate_hz: float,
    seen: PoseLog,
    others: Sequence[PoseColumns],
) -> Iterator[tuple[PoseColumns, PoseLog]]:
    """Yield the poses of a log with other units and conventions of the same columns.

    The file is read once, without covariances. ``seen`` has the times and marks of the rows, as
    `read_mapped` has read them. Others with which a row is wrong are left out.
    """
    own = columns.measured
    stream = _Reader(path, rate_hz).stream(own, _pose_names(own), columns.holds_events)
    for other in others:
        with suppress(RecordError):
            poses, ok = _poses(stream, other)
            yield other, PoseLog(seen.time, _near_home(poses, robot), ok & seen.ok, stream.rows)


@dataclass
class _Reader:
    """Files of a record, each opened once."""

    path: Path
    rate_hz: float
    opened: dict[Path, LoggedFile] = field(default_factory=dict)

    def telemetry(self, columns: Columns, robot: Robot) -> Telemetry:
        """Return the logs of a record."""
        measured = columns.measured
        events = columns.holds_events
        stream = self.stream(measured, _pose_names(measured), events)
        moments = self._moments(stream, measured, measured.time)
        start = moments[0]
        poses, ok = _poses(stream, measured)
        covariances = _covariances(stream, measured, poses, robot)
        near = _near_home(poses, robot)
        log = PoseLog(_since(moments, start), near, ok, stream.rows, covariances)
        commands = self._commands(columns, start, robot)
        _check_overlap(log, commands)
        return Telemetry(log, commands, self._reference(columns, start, robot))

    def _commands(self, columns: Columns, start: Decimal, robot: Robot) -> CommandLog:
        given = columns.command
        own = given if given.is_own else _shared(given, columns.measured)
        written = [] if given.written is None else [given.written]
        stream = self.stream(own, [*given.names, *written], columns.holds_events)
        time = _since(self._moments(stream, own, own.time), start)
        commands = _joint_coordinates(stream, given, robot)
        if given.is_own:
            return CommandLog(time, commands, stream.rows, time)
        return CommandLog(
            time, commands, stream.rows, self._written(stream, own, given.written, start)
        )

    def _written(self, stream: Stream, own: Log, name: str | None, start: Decimal) -> Array | None:
        """Return the times (M,) at which commands were written, NaN in rows without one."""
        if name is None:
            return None
        kept = stream.filled([name])
        found = np.full(len(stream.rows.numbers), np.nan)
        found[kept] = _since(self._moments(stream.kept(kept), own, name), start)
        return found

    def _reference(self, columns: Columns, start: Decimal, robot: Robot) -> ReferenceLog | None:
        given = columns.reference
        if given is None:
            return None
        own = given if given.is_own else _shared(given, columns.measured)
        stream = self.stream(own, _pose_names(given), columns.holds_events)
        poses, ok = _poses(stream, given, measured=False)
        if not ok.all():
            row = int(np.argmin(ok))
            raise RecordError(f"{stream.rows.place(row)}: the desired pose has an empty cell")
        time = _since(self._moments(stream, own, own.time), start)
        return ReferenceLog(time, _near_home(poses, robot), stream.rows)

    def stream(self, log: Log, names: list[str], events: bool) -> Stream:
        """Return the rows that have a time and, if rows are events, any cell of the columns."""
        path = self.path if log.file is None else self.path.parent / log.file
        file = self.opened.setdefault(path, open_log(path))
        topic = checked_topic(file.headers, log.topic, str(path))
        stated = file.headers[topic].rate_hz
        if log.time_unit == FRAMES and stated is not None and stated != self.rate_hz:
            raise RecordError(
                f"{path} states {stated:g} frames per second, and timing.frame_rate_hz is "
                f"{self.rate_hz:g}, by which its times would be counted"
            )
        time = str(log.time)
        stream = file.read(topic, [time, *names])
        rows = stream.filled([time])
        if events:
            told = set(stream.filled(names))
            rows = [row for row in rows if row in told]
        if not rows:
            raise RecordError(
                f"{path}: no row has a time in {time} and a cell of {', '.join(names)}"
            )
        return stream.kept(rows)

    def _moments(self, stream: Stream, log: Log, name: str | None) -> list[Decimal]:
        offset = Decimal(repr(log.time_offset_s))
        return [
            moment + offset for moment in stream.moments(str(name), log.time_unit, self.rate_hz)
        ]


def _shared(own: Log, measured: PoseColumns) -> Log:
    """Return columns with the file, topic and times of the poses, whose rows they share."""
    return own.model_copy(update={name: getattr(measured, name) for name in Log.model_fields})


def _pose_names(log: PoseColumns) -> list[str]:
    more = [] if log.ok is None else [log.ok]
    return [*log.position, *log.orientation, *more, *(log.covariance or [])]


def _since(moments: Iterable[Decimal], start: Decimal) -> Array:
    """Return times (N,) since the start, s."""
    return np.array([float(moment - start) for moment in moments])


def _poses(
    stream: Stream, log: PoseColumns, measured: bool = True
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the poses (N, 6) of the platform in the base, and whether (N,) they were measured.

    Lost poses are NaN. measured: False for desired poses, which may not be lost. Raises RecordError
    for an invalid mark or rotation, for zeros in place of lost poses, or if all are lost.
    """
    position = np.stack([stream.numbers(name) for name in log.position], axis=1)
    orientation = np.stack([stream.numbers(name) for name in log.orientation], axis=1)
    cells = np.hstack([position, orientation])
    ok = np.asarray(np.isfinite(cells).all(axis=1)) & ~lost_rows(log.lost, position, orientation)
    if log.ok is not None:
        stated = stream.numbers(log.ok)
        strange = np.flatnonzero(~np.isin(stated, (0, 1)))
        if len(strange):
            row = int(strange[0])
            raise RecordError(
                f"{stream.rows.place(row)}: {log.ok} is {stated[row]:g}, must be 1 or 0"
            )
        ok &= stated == 1
    if measured:
        check_zeros(position, orientation, ok, stream.rows, ZEROS_REMEDY)
    poses = np.full((len(ok), 6), np.nan)
    if not ok.any():
        raise RecordError(f"{stream.rows.source}: no row has a whole pose")
    rows = Rows(
        stream.rows.source,
        [number for number, good in zip(stream.rows.numbers, ok, strict=True) if good],
        stream.rows.word,
    )
    turned = _rotations(orientation[ok], log, rows)
    poses[ok] = log.in_base(LENGTHS[log.position_unit] * position[ok], turned)
    return poses, ok


def _covariances(stream: Stream, log: PoseColumns, poses: Array, robot: Robot) -> Array | None:
    """Return the covariances (N, 6, 6) of poses (N, 6), NaN where lost, or None if there are none.

    The columns are for small shifts and turns of the tracked body in axes of the log. They move the
    platform as a twist does. Raises RecordError if a covariance of a measured pose is not finite.
    """
    if log.covariance is None:
        return None
    cells = np.stack([stream.numbers(name) for name in log.covariance], axis=1)
    good = np.isfinite(poses).all(axis=1)
    missing = np.flatnonzero(good & ~np.isfinite(cells).all(axis=1))
    if len(missing):
        raise RecordError(
            f"{stream.rows.place(int(missing[0]))}: a covariance of a measured pose is empty or "
            "not finite"
        )
    found = np.full((len(poses), 6, 6), np.nan)
    own = _matrices(cells[good])
    if log.covariance_of == "angles":
        angles = np.stack([stream.numbers(name) for name in log.orientation], axis=1)[good]
        own = _of_turns(own, ANGLES[log.angle_unit] * angles)
    units = np.repeat([LENGTHS[log.position_unit], ANGLES[log.angle_unit]], 3)
    axes = axes_matrix(log.axes)
    base, body = (transform(pose) for pose in (log.base_from_frame, log.body_from_platform))
    turn = base[0].as_matrix() @ axes
    # Turns are axial vectors, which mirrored axes reverse.
    moved = block_diag(turn, np.linalg.det(axes) * turn) * units
    whole = Rotation.from_euler("XYZ", poses[good, 3:])
    lever = (whole * body[0].inv()).apply(body[1])
    twists = np.tile(moved, (len(own), 1, 1))
    twists[:, :3] += np.cross(moved[3:].T, lever[:, None]).transpose(0, 2, 1)
    slopes = np.stack([robot.pose_rate(poses[good], one) for one in np.moveaxis(twists, 2, 0)], 2)
    found[good] = slopes @ own @ slopes.transpose(0, 2, 1)
    return found


def _of_turns(covariances: Array, angles: Array) -> Array:
    """Return covariances (N, 6, 6) with small turns in place of Euler angles (N, 3) XYZ, rad."""
    about_x = Rotation.from_euler("X", angles[:, :1])
    about_xy = Rotation.from_euler("XY", angles[:, :2])
    turns = np.tile(np.eye(6), (len(angles), 1, 1))
    # The columns are the axes about which the three angles turn.
    turns[:, 3:, 4] = about_x.apply([0.0, 1.0, 0.0])
    turns[:, 3:, 5] = about_xy.apply([0.0, 0.0, 1.0])
    return turns @ covariances @ turns.transpose(0, 2, 1)


def _matrices(cells: Array) -> Array:
    """Return the matrices (N, 6, 6) of the columns (N, k) of a covariance."""
    count = cells.shape[1]
    if count == len(POSE):
        return np.asarray(cells[:, :, None] ** 2 * np.eye(count))
    if count == len(POSE) ** 2:
        return cells.reshape(-1, len(POSE), len(POSE))
    return symmetric(cells)


def _rotations(cells: Array, log: PoseColumns, rows: Rows) -> Rotation:
    """Return the rotations of columns (N, k). Raises RecordError with the first invalid row."""
    named = ", ".join(log.orientation)
    if log.convention.startswith("quaternion"):
        length = np.linalg.norm(cells, axis=1)
        wrong = np.flatnonzero(np.abs(length - 1) > UNIT_LENGTH)
        if len(wrong):
            row = int(wrong[0])
            raise RecordError(
                f"{rows.place(row)}: the quaternion {named} has the length {length[row]:.6g}, "
                f"must be 1 (in {len(wrong)} of {len(cells)} rows it is not)"
            )
        return Rotation.from_quat(cells, scalar_first=log.convention.endswith("wxyz"))
    if log.convention == "matrix":
        return _from_matrices(cells.reshape(-1, 3, 3), named, rows)
    radians = ANGLES[log.angle_unit] * cells
    large = np.flatnonzero(np.abs(radians).max(axis=1) > MOST_RADIANS)
    if log.angle_unit == "rad" and len(large):
        row = int(large[0])
        worst = float(np.abs(cells[row]).max())
        raise RecordError(
            f"{rows.place(row)}: an angle of {named} is {worst:.6g} rad, more than a turn; if "
            'these are degrees, angle_unit = "deg"'
        )
    if log.convention == "rotation_vector":
        return Rotation.from_rotvec(radians)
    return Rotation.from_euler(log.convention.removeprefix("euler_"), radians)


def _from_matrices(matrices: Array, named: str, rows: Rows) -> Rotation:
    """Return the rotations of matrices (N, 3, 3). Raises RecordError if one is no rotation."""
    deviation = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    wrong = np.flatnonzero(deviation > UNIT_LENGTH)
    if len(wrong):
        row = int(wrong[0])
        raise RecordError(
            f"{rows.place(row)}: the matrix {named} is not a rotation, its rows are not of length "
            f"one and at right angles to within {UNIT_LENGTH:g}: {deviation[row]:.3g}"
        )
    mirrored = np.flatnonzero(np.linalg.det(matrices) < 0)
    if len(mirrored):
        raise RecordError(
            f"{rows.place(int(mirrored[0]))}: the matrix {named} mirrors (its determinant is -1): "
            "a left-handed frame"
        )
    return Rotation.from_matrix(matrices)


def _near_home(poses: Array, robot: Robot) -> Array:
    """Return poses (N, 6) with unwrapped angles, which begin within half a turn of home."""
    good = np.isfinite(poses).all(axis=1)
    angles = np.unwrap(poses[good, 3:], axis=0)
    turns = np.round((robot.home_pose[3:] - angles[0]) / (2 * np.pi))
    unwrapped = poses.copy()
    unwrapped[good, 3:] = angles + 2 * np.pi * turns
    return unwrapped


def _joint_coordinates(stream: Stream, given: CommandColumns, robot: Robot) -> Array:
    """Return commands (M, n) with the units, directions and zeros of the robot file.

    Raises RecordError if the columns do not fit the robot, or a command is empty.
    """
    joints = robot.layout.joints
    if len(given.names) != joints:
        raise RecordError(
            f"columns.command.names has {len(given.names)} columns, and {robot.name} has {joints} "
            "joints"
        )
    table = LENGTHS if robot.layout.prismatic else ANGLES
    if isinstance(given.unit, str) and given.unit not in table:
        raise RecordError(
            f"columns.command.unit is {given.unit!r}, and the joints of {robot.name} move in "
            f"{robot.layout.joint_unit}: one of {', '.join(table)}"
        )
    cells = np.stack([stream.numbers(name) for name in given.names], axis=1)
    missing = np.argwhere(~np.isfinite(cells))
    if len(missing):
        row, joint = missing[0]
        count = int((~np.isfinite(cells)).any(axis=1).sum())
        raise RecordError(
            f"{stream.rows.place(int(row))}: the command {given.names[joint]} is empty or not "
            f"finite, as in {count} of {len(cells)} rows; if the last command was held there, "
            "state the column of the times in [columns.command], too (time = ...): rows without a "
            "command are then left out"
        )
    signs = np.array(given.all_signs, dtype=float)
    return np.asarray(signs * given.factor * (cells - given.all_zeros))


def _check_overlap(poses: PoseLog, commands: CommandLog) -> None:
    """Check that the clocks of poses and commands overlap. Raises RecordError with both spans."""
    first, last = commands.time[0], commands.time[-1]
    if first <= poses.time[-1] and last >= 0:
        return
    spans = float(np.ptp(poses.time)), float(np.ptp(commands.time))
    powers = float(np.log10(max(spans[0], 1e-9) / max(spans[1], 1e-9))) / 3
    if round(powers) and abs(powers - round(powers)) < ALIKE:
        raise RecordError(
            f"the poses of {poses.rows.source} last {spans[0]:.4g} s, and the commands of "
            f"{commands.rows.source} {spans[1]:.4g} s: the unit of one of their times seems wrong "
            f"by a factor of {1000 ** abs(round(powers)):g}; state it by time_unit in "
            "[columns.measured] or [columns.command]"
        )
    raise RecordError(
        f"the commands of {commands.rows.source} run from {first:.12g} to {last:.12g} s after the "
        f"first pose, and the poses of {poses.rows.source} to {poses.time[-1]:.9g} s: the clocks "
        "do not overlap; columns.command.time_offset_s is added to the times of commands, and "
        f"with {-first:.12g} s more both would begin together"
    )
