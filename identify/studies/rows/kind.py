"""Definition of a kind of row: a function, its options, its figures, and the keys that it reads.

A figure is a number that the function computes, such as an rms error.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache, reduce
from typing import Any

import numpy as np
from pydantic import BaseModel, ValidationError

from cmmsim.files import read_sensor_file
from dynamics import Robot, load_robot
from identify.errors import StudyError
from identify.scenario import Scenario
from identify.scenario.section import Section
from identify.scenario.settings_file import one_line
from identify.scenario.timing import IN_FILE
from identify.setup import Setup
from identify.studies.study_file import Range, Study


@dataclass(frozen=True)
class IneffectiveKeys:
    """Keys that have no effect under a condition.

    keys   Dotted paths, or sections.
    where  Tests of the values of dotted paths. The condition is that all tests hold.
    why    The condition as text for an error message, after "where".
    """

    keys: tuple[str, ...]
    where: Mapping[str, Callable[[Any], bool]]
    why: str


@dataclass(frozen=True)
class KeysRead:
    """Keys that a kind reads, in addition to all of its options.

    keys         Dotted paths, or sections that end in a dot.
    excluding    Keys in these sections that the kind does not read.
    ineffective  Keys that have no effect under some conditions.
    """

    keys: tuple[str, ...]
    excluding: tuple[str, ...] = ()
    ineffective: tuple[IneffectiveKeys, ...] = ()

    def covers(self, path: str) -> bool:
        """Return whether the kind reads a dotted path under at least one condition."""
        return path.startswith("options.") or (
            among(path, self.keys) and not among(path, self.excluding)
        )

    def __str__(self) -> str:
        read, not_read = (
            ", ".join(f"{key}*" if key.endswith(".") else key for key in keys)
            for keys in (self.keys, self.excluding)
        )
        return f"{read}{' but ' if not_read else ''}{not_read}"


def among(path: str, keys: tuple[str, ...]) -> bool:
    """Return whether a path is one of the keys, or lies in a section or table that is one."""
    return any(path == key or path.startswith(f"{key.removesuffix('.')}.") for key in keys)


def timing(*names: str) -> tuple[str, ...]:
    """Return two paths of each timing key: in a scenario's ``[timing]``, and in a sensor file."""
    return tuple(
        path
        for name in names
        for path in (f"scenario.timing.{name}", f"sensor.timing.{IN_FILE[name]}")
    )


# Keys of a sensor file except timing, labels and renderer. The renderer is left out because the
# scenario's renderer is always used.
SENSOR = (
    "sensor.rig.",
    "sensor.camera.",
    "sensor.lens.",
    "sensor.light.",
    "sensor.print.",
    "sensor.detection.",
    "sensor.stickers.",
    "sensor.platform.",
    "sensor.base.",
)

# Keys on which pictures and measured poses depend, apart from the timing.
PICTURES = ("scenario.sensor", "scenario.renderer", "scenario.pose_method", *SENSOR)

BOX = ("scenario.excitation.position_amplitude_m", "scenario.excitation.orientation_amplitude_rad")
# Keys on which a random pose or path in the scenario's box depends.
PATH = ("scenario.excitation.fundamental_hz", "scenario.excitation.harmonics", *BOX)

# Keys of the limits of a random path.
LIMITS = (
    "scenario.excitation.travel_margin_rad",
    "scenario.excitation.travel_margin_m",
    "scenario.excitation.max_joint_velocity_rad_s",
    "scenario.excitation.max_joint_velocity_m_s",
    "scenario.excitation.least_leverage",
    "scenario.excitation.most_condition",
)

NOISE_OFF = IneffectiveKeys(
    tuple(f"sensor.camera.{name}" for name in ("dark_noise", "prnu", "dsnu", "pattern_seed")),
    {"sensor.camera.noise": lambda noise: not noise},
    "sensor.camera.noise is false: pictures have no noise, and only its stated covariance would "
    "change",
)

# Keys without effect if the plant lacks the part to which they belong.
PLANT = (
    IneffectiveKeys(
        ("scenario.plant.geometry_seed",),
        {
            # A list states the error of each joint, and nothing is drawn.
            f"scenario.plant.{name}": lambda error: error == 0 or isinstance(error, list)
            for name in (
                "geometry_error_m",
                "length_error_m",
                "axis_error_rad",
                "joint_zero_error_rad",
                "joint_zero_error_m",
            )
        },
        "scenario.plant.geometry_error_m is 0, and so are the other errors that are drawn",
    ),
    IneffectiveKeys(
        ("scenario.plant.joint_damping_N_m_s_rad", "scenario.plant.motor_inertia_kg_m2"),
        {"scenario.plant.joint_stiffness_N_m_rad": lambda stiffness: stiffness is None},
        "scenario.plant.joint_stiffness_N_m_rad is not given: the joints are rigid",
    ),
    IneffectiveKeys(
        ("scenario.plant.joint_damping_N_s_m", "scenario.plant.motor_mass_kg"),
        {"scenario.plant.joint_stiffness_N_m": lambda stiffness: stiffness is None},
        "scenario.plant.joint_stiffness_N_m is not given: the joints are rigid",
    ),
)


# Keys that are allowed among the changes of any kind. They are labels, the renderer, the drift
# watch, and all keys that a scenario checks against its frame rate. A change of the frame rate can
# require a change of such a key.
BESIDE = (
    "scenario.name",
    "scenario.description",
    "scenario.sensor_note",
    "sensor.name",
    "sensor.note",
    "scenario.renderer",
    *timing("frame_rate_hz", "exposure_s", "latency_s", "latency_jitter_s"),
    "scenario.filter.",
    "scenario.excitation.fundamental_hz",
    "scenario.excitation.harmonics",
    "scenario.excitation.duration_s",
    "scenario.validation.duration_s",
    "scenario.rig.watch",
)


def check_read(study: Study, reads: KeysRead, first: Scenario, options: BaseModel) -> None:
    """Check that each factor, change and option of a study has an effect in at least one row.

    The check uses the statements of each kind about its keys. Computing rows to find keys without
    effect would take minutes per key.

    reads    Keys that the study's kind reads.
    first    Scenario of the first row.
    options  Options of the first row, with their defaults.

    Raises StudyError if a key is never read, or has no effect. The message names the keys that the
    kind reads, or the setting that makes the key ineffective.
    """
    settings = {f"factors.{path}": path for path in study.factors}
    # Changes are allowed to hold some keys that rows do not read, see BESIDE.
    settings |= {f"changes.{path}": path for path in study.changes if not among(path, BESIDE)}
    settings |= {path: path for path in (f"options.{name}" for name in study.options)}
    for setting, path in settings.items():
        if not reads.covers(path):
            raise StudyError(
                f"{setting} does nothing: rows of kind {study.kind!r} do not read it; they read "
                f"{reads}, and their options"
            )
        for ineffective in reads.ineffective:
            if among(path, ineffective.keys) and all(
                _always(holds, key, study, first, options)
                for key, holds in ineffective.where.items()
            ):
                raise StudyError(
                    f"{setting} does nothing in rows of kind {study.kind!r} where {ineffective.why}"
                )


def _always(
    holds: Callable[[Any], bool], path: str, study: Study, first: Scenario, options: BaseModel
) -> bool:
    """Return whether a test holds for the value of a path in all rows.

    The result is False if another sensor of the study could have another value.
    """
    # A timing key can be in the scenario or in the sensor file.
    both = next((pair for pair in _SPELLINGS if path in pair), (path,))
    for one in both:
        if one in study.factors:
            values = study.factors[one]
            return all(map(holds, values.ends if isinstance(values, Range) else values))
    root, _, key = path.partition(".")
    if root == "options":
        return holds(getattr(options, key))
    if "scenario.sensor" in study.factors and (root == "sensor" or len(both) > 1):
        return False
    owner: BaseModel = (
        first if root == "scenario" else read_sensor_file(first.sensor, first.sensor_changes)
    )
    return holds(reduce(getattr, key.split("."), owner))


_SPELLINGS = [timing(name) for name in IN_FILE]


Row = dict[str, float]  # figures of a row by name
# Override of a scenario in all rows: no drift watch of the cameras, as no figure depends on it.
UNWATCHED = {"rig.watch": "none"}
# Beginning of the names of figures that are probabilities of values below the truth. They are
# uniform over the rows if the stated distributions are right, see `studies.uniformity`.
PROBABILITY = "below: "


@dataclass(frozen=True)
class Column:
    """Figure of a row.

    unit     Unit, "1" for a number without unit.
    meaning  Description of the figure.
    main     Whether summaries show and plot the figure.
    """

    unit: str
    meaning: str
    main: bool = False


@dataclass(frozen=True)
class Kind:
    """Kind of row of a study.

    A user's own kind has only a name and a function. The figures of such a kind are known from its
    rows, and any options are allowed, or none.

    name           Name in study files.
    compute        Function (scenario, seed, options) that returns a row's figures by name. The same
                   arguments give the same row, whatever was computed before.
    what           Description of a row.
    columns        Figures of a row.
    options        Model of the options. None means that options are not checked.
    reads          Keys that rows read. None means that keys without effect are not refused.
    takes_options  Whether options are allowed.
    memory         Function (setup, options) that returns the memory, bytes, that a row needs beyond
                   that of its process. None means little memory.
    """

    name: str
    compute: Callable[[Scenario, np.random.SeedSequence, Any], Mapping[str, float]]
    what: str = ""
    columns: Mapping[str, Column] = field(default_factory=dict)
    options: type[Section] | None = None
    reads: KeysRead | None = None
    takes_options: bool = True
    memory: Callable[[Setup, Any], float] | None = None

    def checked(self, options: Mapping[str, Any]) -> Any:
        """Return the options for `compute`, with their defaults.

        Raises StudyError for invalid options. The message has the valid names.
        """
        if options and not self.takes_options:
            raise StudyError(
                f"kind {self.name!r} takes no options, got {', '.join(options)}; a function with "
                "options is run(scenario, seed, options)"
            )
        if self.options is None:
            return options
        try:
            return self.options.model_validate(dict(options))
        except ValidationError as error:
            raise StudyError(f"options of {self.name}: {one_line(error, self.options)}") from error


@lru_cache(maxsize=4)
def robot_named(name: str) -> Robot:
    """Load a robot. Each process caches the four robots used most recently."""
    return load_robot(name)
