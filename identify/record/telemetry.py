"""Logs of a run: poses, commands and the reference, each with times of its own.

Readers of files make a Telemetry, whatever the columns are called in a file. Units are m, rad and
s, and the conventions are those of records. Times count from the first row of the poses. Commands
can be logged at another rate than poses, and begin before them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from identify.arrays import Array
from identify.errors import RecordError

# Largest error of the time between two frames, as a fraction of the frame period.
TIME_ROUNDING = 1e-3


@dataclass(frozen=True)
class Rows:
    """Numbers of rows in a file, by which messages name the rows."""

    source: str
    """File, or file and topic."""

    numbers: Sequence[int]
    """Number of each row, counted from 1."""

    word: str = "line"
    """Word for a row: line or message."""

    def place(self, row: int) -> str:
        """Return the name of a row, counted from 0, such as ``mine.csv line 12``."""
        return f"{self.source} {self.word} {self.numbers[row]}"


@dataclass(frozen=True)
class PoseLog:
    """Measured poses (N, 6), NaN where lost, and the times (N,) at which they were seen.

    Raises RecordError with the row if the times do not increase.
    """

    time: Array
    pose: Array
    ok: NDArray[np.bool_]
    """(N,): true where the pose was measured."""

    rows: Rows
    covariance: Array | None = None
    """(N, 6, 6): covariances of the poses, or None if the file holds none."""

    def __post_init__(self) -> None:
        check_increasing(self.time, self.rows)


@dataclass(frozen=True)
class CommandLog:
    """Joint commands (M, n) and the times (M,) of their rows. Rows of NaN issue no command.

    Raises RecordError with the row if the times do not increase, or only a part of a row is NaN.
    """

    time: Array
    command: Array
    rows: Rows
    written: Array | None = None
    """(M,): times at which the commands were written to the drives, NaN where none was.

    It is None if these times are not logged. A command then acts one latency of the timing after
    its row. In a table of commands alone, these are the times of the rows.
    """

    def __post_init__(self) -> None:
        check_increasing(self.time, self.rows)
        missing = np.isnan(self.command)
        partly = np.flatnonzero(missing.any(axis=1) & ~missing.all(axis=1))
        if len(partly):
            row = int(partly[0])
            raise RecordError(
                f"{self.rows.place(row)}: the command of joint {int(np.argmax(missing[row])) + 1} "
                "is empty, and others are not: a row holds the commands of all joints, or of none"
            )


@dataclass(frozen=True)
class ReferenceLog:
    """Desired poses (R, 6) and the times (R,) of their rows.

    Raises RecordError with the row if the times do not increase.
    """

    time: Array
    pose: Array
    rows: Rows
    rate: Array | None = None
    """(R, 6): time derivatives of the poses, or None if they are not logged."""

    def __post_init__(self) -> None:
        check_increasing(self.time, self.rows)


@dataclass(frozen=True)
class Telemetry:
    """Logs of one run. The reference is None if the file holds none."""

    poses: PoseLog
    commands: CommandLog
    reference: ReferenceLog | None = None

    @property
    def is_one_table(self) -> bool:
        """True if poses, commands and the reference, if there is one, have the same times."""
        times = [self.commands.time]
        times += [] if self.reference is None else [self.reference.time]
        return all(np.array_equal(time, self.poses.time) for time in times)


def check_increasing(time: Array, rows: Rows) -> None:
    """Check that the times (N,) of rows are finite and increase.

    Raises RecordError with the first row that is wrong.
    """
    strange = np.flatnonzero(~np.isfinite(time))
    if len(strange):
        raise RecordError(f"{rows.place(int(strange[0]))}: its time is not a finite number")
    back = np.flatnonzero(np.diff(time) <= 0)
    if not len(back):
        return
    row = int(back[0]) + 1
    before = f"{rows.word} {rows.numbers[row - 1]}"
    said = (
        f"its time {time[row]:.9g} s is also that of {before}"
        if time[row] == time[row - 1]
        else f"its time {time[row]:.9g} s is before {time[row - 1]:.9g} s of {before}"
    )
    more = f"; the same in {len(back)} rows" if len(back) > 1 else ""
    raise RecordError(f"{rows.place(row)}: {said}{more}")
