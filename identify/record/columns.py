"""Table ``[columns]`` of the file that describes a record.

It states the names of the columns of a log, and their units, directions and frames. A pose of the
record is

    base_from_platform = base_from_frame · frame_from_body · body_from_platform

where the log holds the pose of the tracked body in the log's own frame, frame_from_body.
"""

from collections.abc import Sequence
from itertools import permutations, product
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, WithJsonSchema, model_validator
from scipy.spatial.transform import Rotation

from identify.arrays import Array
from identify.scenario.section import Section, quantity

ASKED = "?"  # value of a key that a proposal leaves to the user
# Seconds in each unit of time, as decimal numbers.
TIMES = {"s": "1", "ms": "1e-3", "us": "1e-6", "ns": "1e-9"}
FRAMES = "frames"  # unit of times that count frames at the rate of the timing
LENGTHS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "um": 1e-6}  # metres in each unit of length
# Radians in each unit of angle.
ANGLES = {"rad": 1.0, "deg": 0.017453292519943295, "turn": 6.283185307179586}
# Number of columns of each convention, except the Euler sequences, which have three.
COUNTS = {"quaternion_xyzw": 4, "quaternion_wxyz": 4, "matrix": 9, "rotation_vector": 3}

COVARIANCES = (6, 21, 36)  # possible numbers of columns of a covariance
COVARIANCES_SAID = "6 standard deviations, 21 of the upper triangle, or 36 row by row"

# Euler sequences. Two successive turns are never about the same axis.
EULER = tuple(
    f"euler_{a}{b}{c}"
    for axes in ("XYZ", "xyz")
    for a, b, c in product(axes, repeat=3)
    if a != b != c
)

EULER_USUAL = ("euler_XYZ", "euler_ZYX", "euler_xyz", "euler_zyx")  # those that are tried first

# Sequences about three different axes.
EULER_ORDERS = tuple(
    f"euler_{''.join(letters)}" for axes in ("XYZ", "xyz") for letters in permutations(axes)
)

CONVENTIONS = (*COUNTS, *EULER_USUAL, "...")  # names that a message lists


def _check_convention(name: str) -> str:
    if name in COUNTS or name in EULER:
        return name
    raise ValueError(
        f"{name!r} is not a convention: {', '.join(CONVENTIONS)}; capitals are turns about the "
        "body's own axes, small letters about fixed axes"
    )


Convention = Annotated[
    str,
    AfterValidator(_check_convention),
    WithJsonSchema({"enum": [*COUNTS, *EULER]}),
]


def _check_unit(unit: str | float) -> str | float:
    known = (*ANGLES, *LENGTHS)
    if unit in known or (isinstance(unit, float) and unit > 0):
        return unit
    raise ValueError(f"{unit!r} is not a unit: {', '.join(known)}, or a number > 0")


Axis = Literal["x", "y", "z", "-x", "-y", "-z"]


class Log(Section):
    """Rows of a log and their times."""

    file: str | None = Field(
        None, description="file with these columns; without it, that of the record"
    )
    topic: str | None = Field(
        None, description="topic of a bag, or section of a Vicon export, with these columns"
    )
    time: str | None = Field(
        None,
        description="column of the times; without it, that of the measured poses. Rows in which it "
        "is empty are ignored",
    )
    time_unit: Literal["s", "ms", "us", "ns", "frames"] = Field(
        "s", description="unit of the times; frames are those of timing.frame_rate_hz"
    )
    time_offset_s: float = quantity(
        0.0, "s", "what is added to the times, such as an offset of clocks", ge=-1e10, le=1e10
    )

    @property
    def is_own(self) -> bool:
        """True if these columns have rows of their own, and do not share those of the poses."""
        return not (self.file is None and self.topic is None and self.time is None)


class PoseColumns(Log):
    """Columns of the measured poses. Those of the desired poses have the same keys."""

    position: list[str] = Field(
        description="columns of x, y and z of the position", min_length=3, max_length=3
    )
    position_unit: Literal["m", "mm", "cm", "um"] = Field(description="unit of the position")
    orientation: list[str] = Field(
        description="columns of the orientation, as many as its convention has",
        min_length=3,
        max_length=9,
    )
    convention: Convention = Field(
        description="quaternion_xyzw, quaternion_wxyz, matrix (row by row), rotation_vector, or an "
        "Euler sequence of scipy's Rotation: euler_XYZ and so on turn about the body's own axes, "
        "euler_xyz about fixed axes"
    )
    angle_unit: Literal["rad", "deg"] = Field(
        "rad", description="unit of Euler angles and of a rotation vector"
    )
    axes: list[Axis] = Field(
        ["x", "y", "z"],
        description='axes of the log that are our x, y and z: ["x", "-z", "y"] turns y up into z '
        'up, and ["x", "z", "y"] makes a left-handed system with y up right-handed',
        min_length=3,
        max_length=3,
    )
    base_from_frame: list[float] = Field(
        [0.0] * 6,
        description="pose of the frame of the log in the base frame of the robot: x, y, z in m, "
        "alpha, beta, gamma in rad",
        min_length=6,
        max_length=6,
    )
    body_from_platform: list[float] = Field(
        [0.0] * 6,
        description="pose of the platform frame of the robot in the tracked body, in m and rad",
        min_length=6,
        max_length=6,
    )
    ok: str | None = Field(
        None, description="column that is 1 where the pose was measured, and 0 where it was lost"
    )
    lost: Literal["empty", "zeros", "repeated"] = Field(
        "empty",
        description="cells of a lost pose: empty or NaN; zeros; or repeated, those of the row "
        "before. Empty cells always count as lost",
    )
    covariance: list[str] | None = Field(
        None,
        description="columns of the covariance of the position and of small turns about fixed axes "
        "of the log, in squares of position_unit and angle_unit: 36 row by row, 21 of the upper "
        "triangle, or 6 standard deviations; without them, [record] states it",
    )
    covariance_of: Literal["turns", "angles"] = Field(
        "turns",
        description='"angles" if the covariance is that of the angles of convention euler_XYZ '
        "instead of small turns, as in tables of cmmsim measure",
    )

    def in_base(self, position: Array, turned: Rotation) -> Array:
        """Return the poses (N, 6) of the platform in the base.

        `position` (N, 3), m, and `turned` are those of the tracked body, in axes of the log.
        """
        axes = axes_matrix(self.axes)
        frame = Rotation.from_matrix(axes @ turned.as_matrix() @ axes.T)
        base, body = (transform(pose) for pose in (self.base_from_frame, self.body_from_platform))
        moved = base[1] + base[0].apply(position @ axes.T + frame.apply(body[1]))
        return np.hstack([moved, (base[0] * frame * body[0]).as_euler("XYZ")])

    def in_log(self, poses: Array) -> tuple[Array, Rotation]:
        """Return the position and rotation of which `in_base` makes the poses (N, 6)."""
        axes = axes_matrix(self.axes)
        base, body = (transform(pose) for pose in (self.base_from_frame, self.body_from_platform))
        frame = base[0].inv() * Rotation.from_euler("XYZ", poses[:, 3:]) * body[0].inv()
        position = base[0].inv().apply(poses[:, :3] - base[1]) - frame.apply(body[1])
        return position @ axes, Rotation.from_matrix(axes.T @ frame.as_matrix() @ axes)

    @property
    def other_conventions(self) -> tuple[str, ...]:
        """Other conventions with as many columns, for which this one is often mistaken."""
        turned = dict.fromkeys((*EULER_USUAL, *EULER_ORDERS))
        alike = {3: ("rotation_vector", *turned), 4: ("quaternion_xyzw", "quaternion_wxyz")}
        return tuple(
            name for name in alike.get(len(self.orientation), ()) if name != self.convention
        )

    @model_validator(mode="after")
    def _agree(self) -> "PoseColumns":
        wanted = COUNTS.get(self.convention, 3)
        if len(self.orientation) != wanted:
            raise ValueError(
                f"orientation names {len(self.orientation)} columns, but the convention "
                f"{self.convention} has {wanted}"
            )
        if sorted(axis.lstrip("-") for axis in self.axes) != ["x", "y", "z"]:
            raise ValueError(f"axes = {self.axes} must name each of x, y and z once")
        if self.covariance is not None and len(self.covariance) not in COVARIANCES:
            raise ValueError(
                f"covariance names {len(self.covariance)} columns, must be {COVARIANCES_SAID}"
            )
        if self.covariance_of == "angles" and self.convention != "euler_XYZ":
            raise ValueError(
                f'covariance_of = "angles" is for the convention euler_XYZ, not {self.convention}'
            )
        _check_once([*self.position, *self.orientation, *(self.covariance or [])])
        return self


class CommandColumns(Log):
    """Columns of the joint commands.

    Without file, topic and time, each row of the poses holds a command. If file, topic and time are
    again those of the poses, a row can hold a pose, a command or both. Otherwise commands have rows
    of their own. A joint coordinate of the robot file is sign · unit · (column - zero).
    """

    names: list[str] = Field(description="columns of the commands of joints 1, 2, ...")
    unit: Annotated[str | float, AfterValidator(_check_unit)] = Field(
        description="unit of the commands, or rad or m per unit, as for a gear or a spindle"
    )
    signs: list[Literal[1, -1]] | None = Field(
        None, description="1 for joints with the direction of the robot file, -1 for all others"
    )
    zeros: list[float] | None = Field(
        None, description="values of the columns at the zeros of the robot file's joints"
    )
    written: str | None = Field(
        None,
        description="column of the times at which commands were written to the drives, if commands "
        "share the rows of the poses; commands in rows of their own are written at the rows' times",
    )

    @model_validator(mode="after")
    def _agree(self) -> "CommandColumns":
        for name in ("signs", "zeros"):
            values = getattr(self, name)
            if values is not None and len(values) != len(self.names):
                raise ValueError(
                    f"{name} has {len(values)} numbers, and names has {len(self.names)} columns"
                )
        if self.written is not None and self.is_own:
            raise ValueError(
                f"written = {self.written!r} is for commands in the rows of the poses, but these "
                "commands have rows of their own, and are written at the times of these rows"
            )
        _check_once(self.names)
        return self

    @property
    def factor(self) -> float:
        """Rad or m in a unit of the columns."""
        return (ANGLES | LENGTHS)[self.unit] if isinstance(self.unit, str) else self.unit

    @property
    def all_signs(self) -> list[int]:
        """Sign of each joint, 1 where none is stated."""
        return [1] * len(self.names) if self.signs is None else [*self.signs]

    @property
    def all_zeros(self) -> Array:
        """Values (n,) of the columns at the zeros of the joints, 0 where none is stated."""
        return np.zeros(len(self.names)) if self.zeros is None else np.array(self.zeros)


class Columns(Section):
    """Columns of a log whose names differ from those of a record."""

    measured: PoseColumns
    command: CommandColumns
    reference: PoseColumns | None = Field(
        None, description="columns of the desired poses, with the keys of [columns.measured]"
    )

    @property
    def holds_events(self) -> bool:
        """True if poses and commands are rows of one table, with one column of times.

        Commands then name the time of the poses again. A row without a pose is not a lost pose.
        """
        sources = [(log.file, log.topic, log.time) for log in (self.measured, self.command)]
        return sources[0] == sources[1]

    @model_validator(mode="after")
    def _agree(self) -> "Columns":
        if self.measured.time is None:
            raise ValueError("measured.time must name the column of the times")
        for name in ("command", "reference"):
            log = getattr(self, name)
            if log is not None and log.is_own and log.time is None:
                raise ValueError(f"{name}.time must name the column of the times of its own rows")
        self._check_named_once()
        return self

    def _check_named_once(self) -> None:
        """Check that no column is both a pose and a command. Raises ValueError with its name."""
        pose = [*self.measured.position, *self.measured.orientation]
        command = self.command
        if not command.is_own or (command.file, command.topic) == (
            self.measured.file,
            self.measured.topic,
        ):
            _check_once([*pose, *command.names])


def axes_matrix(names: Sequence[str]) -> Array:
    """Return A (3, 3), whose rows are the axes of the log that are our x, y and z."""
    rows = np.zeros((3, 3))
    for row, name in enumerate(names):
        rows[row, "xyz".index(name[-1])] = -1 if name.startswith("-") else 1
    return rows


def transform(pose: Sequence[float]) -> tuple[Rotation, Array]:
    """Return the rotation and the translation, m, of a pose of six numbers."""
    return Rotation.from_euler("XYZ", pose[3:]), np.array(pose[:3])


def _check_once(names: list[str]) -> None:
    """Check that no column is named twice. Raises ValueError with its name."""
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"column {name!r} is named twice")
