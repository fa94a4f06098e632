"""What the kinds of row read and measure: keys, columns with units, and options, checked before any row."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from identify.arrays import Array
from identify.errors import ScenarioError
from identify.scenario import Scenario
from identify.scenario.settings_file import one_line
from identify.scenario.timing import IN_FILE

# What a kind of row reads of a scenario and of its sensor's file: all that a study can vary, beside its options.


@dataclass(frozen=True)
class Idle:
    """Keys that do nothing where all of `where` hold: dotted paths with what is asked of their values; `why`, in words
    behind "where"."""

    keys: tuple[str, ...]
    where: Mapping[str, Callable[[Any], bool]]
    why: str


@dataclass(frozen=True)
class Reads:
    """What a kind reads: `keys`, dotted paths, or sections that end in a dot; not `but`; not always `idle`.

    It reads all of its options.
    """

    keys: tuple[str, ...]
    but: tuple[str, ...] = ()
    idle: tuple[Idle, ...] = ()

    def covers(self, path: str) -> bool:
        """Whether the kind ever reads a dotted path."""
        return path.startswith("options.") or (among(path, self.keys) and not among(path, self.but))

    def __str__(self) -> str:
        read, left = (
            ", ".join(f"{key}*" if key.endswith(".") else key for key in keys) for keys in (self.keys, self.but)
        )
        return f"{read}{' but ' if left else ''}{left}"


def among(path: str, keys: tuple[str, ...]) -> bool:
    """Whether a path is one of the keys, or in a section of them."""
    return any(path == key or (key.endswith(".") and path.startswith(key)) for key in keys)


def timing(*names: str) -> tuple[str, ...]:
    """Both paths of keys of a scenario's ``[timing]``: there, and in the sensor's file."""
    return tuple(path for name in names for path in (f"scenario.timing.{name}", f"sensor.timing.{IN_FILE[name]}"))


SENSOR = (
    "sensor.rig.", "sensor.camera.", "sensor.lens.", "sensor.detection.", "sensor.stickers.", "sensor.platform.",
    "sensor.base.",
)  # fmt: skip
"""All of a sensor's file but its timing and its labels; a scenario always says itself what draws."""

PICTURES = ("scenario.sensor", "scenario.renderer", "scenario.pose_method", *SENSOR)
"""What pictures, and the poses measured in them, depend on beside the timing."""

NOISE_OFF = Idle(
    tuple(f"sensor.camera.{name}" for name in ("dark_noise", "prnu", "dsnu", "pattern_seed")),
    {"sensor.camera.noise": lambda noise: not noise},
    "sensor.camera.noise is false: pictures have no noise, and only what is stated of it would change",
)

PLANT = (
    Idle(
        ("scenario.plant.geometry_seed",),
        {"scenario.plant.geometry_error_m": lambda error: error == 0},
        "scenario.plant.geometry_error_m is 0",
    ),
    Idle(
        ("scenario.plant.joint_damping_N_m_s_rad", "scenario.plant.motor_inertia_kg_m2"),
        {"scenario.plant.joint_stiffness_N_m_rad": lambda stiffness: stiffness is None},
        "scenario.plant.joint_stiffness_N_m_rad is not given: the joints are rigid",
    ),
)
"""Keys of a plant that does not have what they belong to."""


# What the kinds of row measure: columns with units, and options that are checked before a row is computed.


Row = dict[str, float]


@dataclass(frozen=True)
class Column:
    """Unit of a figure and what it is."""

    unit: str
    meaning: str


class RowOptions(BaseModel):
    """Options of a kind; unknown names and wrong values are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


@dataclass(frozen=True)
class Kind:
    """One kind of row: `compute(scenario, seed, options)` gives exactly `columns`; `main`: those that are drawn;
    `options`: their model; `reads`: what else acts on it; `what`: what a row is, in a sentence."""

    name: str
    what: str
    columns: Mapping[str, Column]
    main: tuple[str, ...]
    options: type[RowOptions]
    reads: Reads
    compute: Callable[[Scenario, np.random.SeedSequence, Any], Row]

    def checked(self, options: Mapping[str, Any]) -> RowOptions:
        """The options with their defaults. Raises ScenarioError with the valid names."""
        try:
            return self.options.model_validate(dict(options))
        except ValidationError as error:
            raise ScenarioError(f"options of {self.name}: {one_line(error, self.options)}") from error


def rms_um(errors: Array) -> float:
    """Root mean square in 1e-6 of the unit: over all entries, so per axis and frame."""
    return 1e6 * float(np.sqrt(np.mean(np.square(errors))))


def stated_um(covariances: Array) -> tuple[float, float]:
    """Rms standard deviation per axis of position [um] and orientation [urad] of covariances (n, 6, 6)."""
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    return 1e6 * float(np.sqrt(variances[:, :3].mean())), 1e6 * float(np.sqrt(variances[:, 3:].mean()))


POSE_COLUMNS = {
    "position_rms_um": Column("um", "measured against true position, rms over pictures and axes"),
    "orientation_rms_urad": Column("urad", "measured against true orientation, rms over pictures and axes"),
    "stated_position_rms_um": Column("um", "the same, as the sensor's own covariance states it"),
    "stated_orientation_rms_urad": Column("urad", "the same, as the sensor's own covariance states it"),
}
"""What every row says that has measured poses in it."""


def pose_figures(errors: Array, covariances: Array) -> Row:
    """The figures of POSE_COLUMNS of errors (n, 6) [m, rad] and stated covariances (n, 6, 6), n >= 1."""
    figures = (rms_um(errors[:, :3]), rms_um(errors[:, 3:]), *stated_um(covariances))
    return dict(zip(POSE_COLUMNS, figures, strict=True))
