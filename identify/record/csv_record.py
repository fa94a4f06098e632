"""Records as CSV tables: their columns, their rules, and reading them.

Each row has a time, and can hold a measured pose and a command. The names of most columns end with
their unit. Lines that begin with # are comments. Error messages name the line, counted from 1.
"""

import csv
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dynamics import Robot
from dynamics.files import read_bytes
from identify.arrays import Array
from identify.errors import RecordError
from identify.files.dataset import POSE
from identify.record.lost_pose_marks import check_zeros
from identify.record.telemetry import CommandLog, PoseLog, ReferenceLog, Rows, Telemetry

# Rules for users' tables, which templates and the documentation show.
RULES = """\
Units are m, rad and s. A pose is the pose of the platform frame in the base frame of the robot
file, R = Rx(alpha) Ry(beta) Rz(gamma). The time of a row is the instant at which the sensor saw the
pose. A command is the joint coordinate that is requested from its row on, with the zero and the
direction of the robot file. In one table with the poses, it acts from its command_time_s on, or
without that column one timing.latency_s after its row. In a log of its own, it acts from its own
time on, and timing.latency_s does not move it. As the rate of a command, the drives take its change
from the command before, divided by one period of timing.frame_rate_hz. In a row without a measured
pose the measured columns are empty, and in a row in which no command was written, so that the last
one was held, the command columns. The first row holds a command.

If rows are one frame of timing.frame_rate_hz apart, if the record begins at rest at its first
reference pose, and if the servo saw exactly the measured poses, a model can close its own loop.
Every row then has a reference and a command. Rates of the reference are the time derivatives of its
six numbers, not the angular velocity, and without rate columns come from a spline through it.

In every other record the logged commands drive the model: rows at any times, begun in motion,
without a reference, with commands in rows without poses, or with rows missing. The start is then
estimated, and after missing rows the model starts anew. A clock of the commands that differs from
that of the poses is estimated with timing.clock_offset_std_s and timing.clock_drift_std.
"""

# Largest size of a table, bytes. An hour at 60 Hz takes a hundred million bytes.
LARGEST = 200_000_000
# Beginnings of the names of columns that `cmmsim measure` writes in addition to those of a record.
# These columns are not read. The column ok that `cmmsim measure` writes is read as measured_ok.
BESIDE = ("pair", "stickers", "why", "common_")

ZEROS_REMEDY = (
    "leave their measured cells empty, or add a column measured_ok that is 0 there and 1 elsewhere"
)
UNITS = {name: "m" if name in POSE[:3] else "rad" for name in POSE}


@dataclass(frozen=True)
class Group:
    """Columns that belong together: their names and their meaning.

    A table has either all columns of an optional group, or none of them.
    """

    names: tuple[str, ...]
    meaning: str
    optional: bool = False


def columns_of(robot: Robot) -> dict[str, Group]:
    """Return the groups of columns of a robot's record, by name."""
    joints = range(1, robot.layout.joints + 1)
    unit = "m" if robot.layout.prismatic else "rad"
    pairs = [(a, b) for k, a in enumerate(POSE) for b in POSE[k:]]
    return {
        "time": Group(("time_s",), "time since the first row"),
        "reference": Group(
            tuple(f"reference_{a}_{UNITS[a]}" for a in POSE),
            "desired pose, which a model needs that closes its own loop",
            True,
        ),
        "measured": Group(
            tuple(f"measured_{a}_{UNITS[a]}" for a in POSE),
            "pose that the sensor measured, or empty",
        ),
        "command": Group(
            tuple(f"command_{n}_{unit}" for n in joints),
            "joint command from this row on, or empty where the last one was held",
        ),
        "command_time": Group(
            ("command_time_s",),
            "time at which the command of the row was written to the drives, or empty",
            True,
        ),
        "rate": Group(
            tuple(f"rate_{a}_{UNITS[a]}_s" for a in POSE), "time derivative of the reference", True
        ),
        "ok": Group(("measured_ok",), "1 where the pose was measured, 0 where it was lost", True),
        "covariance": Group(
            tuple(f"covariance_{a}_{b}" for a, b in pairs),
            "covariance of the measured pose, m2, m rad and rad2",
            True,
        ),
    }


@dataclass(frozen=True)
class Table:
    """Groups of columns of a file, each (N, k), and the line number of each row.

    Empty cells are NaN.
    """

    path: Path
    groups: Mapping[str, Array]
    lines: tuple[int, ...]

    def telemetry(self) -> Telemetry:
        """Return the logs of the table. The log of commands has only rows that hold a command.

        Raises RecordError with the line if the times do not increase, `measured_ok` is wrong, lost
        poses are zeros, a command lacks joints, or the first row holds no command.
        """
        start = self.groups["time"][0, 0]
        time = self.groups["time"][:, 0] - start
        rows = Rows(str(self.path), self.lines)
        ok = self._measured_ok()
        measured = self.groups["measured"]
        check_zeros(measured[:, :3], measured[:, 3:], ok, rows, ZEROS_REMEDY)
        written = self.groups.get("command_time")
        # In all other rows, the last command was held.
        commands = np.flatnonzero(np.isfinite(self.groups["command"]).any(axis=1))
        if not len(commands) or commands[0]:
            raise RecordError(
                f"{self.path} line {self.lines[0]}: the command is empty, and no command before it "
                "was held: the first row must hold one"
            )
        # Poses in rows that are marked as lost are ignored.
        poses = np.where(ok[:, None], measured, np.nan)
        return Telemetry(
            PoseLog(time, poses, ok, rows, self._covariances()),
            CommandLog(
                time[commands],
                self.groups["command"][commands],
                Rows(str(self.path), [self.lines[row] for row in commands]),
                None if written is None else written[commands, 0] - start,
            ),
            ReferenceLog(time, self.groups["reference"], rows, self.groups.get("rate"))
            if "reference" in self.groups
            else None,
        )

    def _measured_ok(self) -> NDArray[np.bool_]:
        """Return whether the pose of each row (N,) was measured.

        If it was, no measured cell is empty and the cell measured_ok, if the table has one, is 1.
        """
        whole = np.asarray(np.isfinite(self.groups["measured"]).all(axis=1))
        if "ok" not in self.groups:
            return whole
        stated = self.groups["ok"][:, 0]
        for wrong, why in (
            (~np.isin(stated, (0, 1)), "measured_ok must be 1 or 0"),
            ((stated == 1) & ~whole, "measured_ok is 1, but a measured column is empty"),
        ):
            if wrong.any():
                raise RecordError(f"{self.path} line {self.lines[int(np.argmax(wrong))]}: {why}")
        return whole & (stated == 1)

    def _covariances(self) -> Array | None:
        """Return the covariances (N, 6, 6) of the measured poses, or None without such columns."""
        if "covariance" not in self.groups:
            return None
        return symmetric(self.groups["covariance"])


def symmetric(triangles: Array) -> Array:
    """Return matrices (N, 6, 6) with these upper triangles (N, 21), row by row."""
    rows, columns = np.triu_indices(len(POSE))
    found = np.empty((len(triangles), len(POSE), len(POSE)))
    found[:, rows, columns] = found[:, columns, rows] = triangles
    return found


def read_table(path: Path, robot: Robot) -> Table:
    """Read the table of a robot's record.

    Raises RecordError if the file does not exist, a column is missing, unknown or doubled, a cell
    is not a number, or there are no rows.
    """
    groups = columns_of(robot)
    lines = lines_of(path)
    number, names = next(lines, (0, []))
    header = ["measured_ok" if name == "ok" else name for name in names]
    present = _checked_header(path, number, header, groups)
    rows = [(number, _numbers(path, number, header, cells)) for number, cells in lines]
    if not rows:
        raise RecordError(f"{path} has no rows below its header")
    values = np.array([row for _, row in rows])
    taken = {
        name: values[:, [header.index(column) for column in groups[name].names]] for name in present
    }
    return Table(path, taken, tuple(number for number, _ in rows))


def lines_of(path: Path, separators: str = ",") -> Iterator[tuple[int, list[str]]]:
    """Yield number and cells of each line that is neither empty nor a comment.

    Of several possible separators, the one that is most frequent in the first line with any of them
    is used. Raises RecordError if the file cannot be read.
    """
    content = read_bytes(path, f"record {path}", RecordError, LARGEST)
    # Spreadsheets write a byte order mark at the beginning, which utf-8-sig removes.
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise RecordError(f"cannot read record {path}: {error}") from error
    separator = separators[0]
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            if len(separators) > 1 and any(one in line for one in separators):
                separator = max(separators, key=line.count)
                separators = separator
            try:
                cells = next(csv.reader([line], delimiter=separator))
            except csv.Error as error:
                raise RecordError(f"{path} line {number}: {error}") from error
            yield number, [cell.strip() for cell in cells]


def _checked_header(
    path: Path, number: int, header: list[str], groups: Mapping[str, Group]
) -> list[str]:
    """Return the names of the groups in a header. Raises RecordError if the header is not valid."""
    if len(header) == 1 and ";" in header[0]:
        raise RecordError(
            f"{path} line {number}: cells are separated by semicolons, and must be by commas"
        )
    known = [name for group in groups.values() for name in group.names]
    for name in header:
        if name not in known and not name.startswith(BESIDE):
            raise RecordError(f"{path} line {number}: unknown column {name!r}{_meant(name, known)}")
        if header.count(name) > 1:
            raise RecordError(f"{path} line {number}: there are two columns {name!r}")
    for group in groups.values():
        missing = [name for name in group.names if name not in header]
        if missing and not (group.optional and len(missing) == len(group.names)):
            raise RecordError(
                f"{path} line {number}: there is no column {', '.join(missing)} ({group.meaning})"
            )
    return [key for key, group in groups.items() if group.names[0] in header]


def _meant(name: str, known: list[str]) -> str:
    """Return a hint about the column that was probably meant, or else a list of all columns."""
    stem = name.rpartition("_")[0]
    alike = [one for one in known if stem and one.startswith(f"{stem}_")]
    # For reference_x_mm the hint is reference_x_m, but for rate_x_mm it is not rate_x_m_s.
    meant = [one for one in alike if "_s" not in one[len(stem) + 1 :]]
    if len(meant) == 1:
        return f": use {meant[0]}, in {meant[0].rpartition('_')[2]}"
    return (
        f"; the columns are {', '.join(known)}, or those that [columns] of the TOML file names, "
        "which cmmsim new record --from FILE proposes"
    )


def _numbers(path: Path, number: int, header: list[str], cells: list[str]) -> list[float]:
    if len(cells) != len(header):
        raise RecordError(
            f"{path} line {number} has {len(cells)} cells, and the header has {len(header)} columns"
        )
    values = []
    for name, cell in zip(header, cells, strict=True):
        if name.startswith(BESIDE):
            values.append(np.nan)
            continue
        try:
            if "_" in cell:  # float() would read 1_0 as 10
                raise ValueError
            values.append(float(cell) if cell else np.nan)
        except ValueError:
            raise RecordError(
                f"{path} line {number}: {name} is {cell[:40]!r}, which is not a number"
            ) from None
        may_be_empty = name.startswith(("measured_", "covariance_", "command_"))
        if np.isinf(values[-1]) or (np.isnan(values[-1]) and not may_be_empty):
            raise RecordError(
                f"{path} line {number}: {name} is {cell or 'empty'}, must be a finite number"
            )
    return values
