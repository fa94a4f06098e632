"""What a kind of row is: how a row is computed, its figures with units, its options, and the keys
that it reads.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import reduce
from typing import Any

import numpy as np
from pydantic import BaseModel, ValidationError

from cmmsim.files import read_sensor_file
from identify.errors import StudyError
from identify.scenario import Scenario
from identify.scenario.section import Section
from identify.scenario.settings_file import one_line
from identify.scenario.timing import IN_FILE
from identify.studies.study_file import Range, Study


@dataclass(frozen=True)
class Idle:
    """Keys that do nothing where all of `where` hold: dotted paths with what is asked of their
    values; `why`, in words behind "where"."""

    keys: tuple[str, ...]
    where: Mapping[str, Callable[[Any], bool]]
    why: str


@dataclass(frozen=True)
class Reads:
    """What a kind reads: `keys`, dotted paths, or sections that end in a dot; not `but`; not always
    `idle`.

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
            ", ".join(f"{key}*" if key.endswith(".") else key for key in keys)
            for keys in (self.keys, self.but)
        )
        return f"{read}{' but ' if left else ''}{left}"


def among(path: str, keys: tuple[str, ...]) -> bool:
    """Whether a path is one of the keys, or in a section or a table of them."""
    return any(path == key or path.startswith(f"{key.removesuffix('.')}.") for key in keys)


def timing(*names: str) -> tuple[str, ...]:
    """Both paths of keys of a scenario's ``[timing]``: there, and in the sensor's file."""
    return tuple(
        path
        for name in names
        for path in (f"scenario.timing.{name}", f"sensor.timing.{IN_FILE[name]}")
    )


SENSOR = (
    "sensor.rig.",
    "sensor.camera.",
    "sensor.lens.",
    "sensor.detection.",
    "sensor.stickers.",
    "sensor.platform.",
    "sensor.base.",
)
"""All of a sensor's file but its timing and its labels; a scenario always says itself what draws.
"""

PICTURES = ("scenario.sensor", "scenario.renderer", "scenario.pose_method", *SENSOR)
"""What pictures, and the poses measured in them, depend on beside the timing."""

BOX = ("scenario.excitation.position_amplitude_m", "scenario.excitation.orientation_amplitude_rad")
PATH = ("scenario.excitation.fundamental_hz", "scenario.excitation.harmonics", *BOX)
"""What draws a pose in the scenario's box, and a path in it."""

LIMITS = (
    "scenario.excitation.travel_margin_rad",
    "scenario.excitation.travel_margin_m",
    "scenario.excitation.max_joint_velocity_rad_s",
    "scenario.excitation.max_joint_velocity_m_s",
    "scenario.excitation.least_leverage",
    "scenario.excitation.most_condition",
)
"""What decides whether such a path is admissible."""

NOISE_OFF = Idle(
    tuple(f"sensor.camera.{name}" for name in ("dark_noise", "prnu", "dsnu", "pattern_seed")),
    {"sensor.camera.noise": lambda noise: not noise},
    "sensor.camera.noise is false: pictures have no noise, and only what is stated of it would "
    "change",
)

PLANT = (
    Idle(
        ("scenario.plant.geometry_seed",),
        {
            f"scenario.plant.{name}": lambda error: error == 0
            for name in ("geometry_error_m", "length_error_m", "axis_error_rad")
        },
        "scenario.plant.geometry_error_m is 0, and so are its other errors of geometry",
    ),
    Idle(
        ("scenario.plant.joint_damping_N_m_s_rad", "scenario.plant.motor_inertia_kg_m2"),
        {"scenario.plant.joint_stiffness_N_m_rad": lambda stiffness: stiffness is None},
        "scenario.plant.joint_stiffness_N_m_rad is not given: the joints are rigid",
    ),
    Idle(
        ("scenario.plant.joint_damping_N_s_m", "scenario.plant.motor_mass_kg"),
        {"scenario.plant.joint_stiffness_N_m": lambda stiffness: stiffness is None},
        "scenario.plant.joint_stiffness_N_m is not given: the joints are rigid",
    ),
)
"""Keys of a plant that does not have what they belong to."""


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
"""What may stand among the changes of any kind: labels, what draws if anything does, who watches
the cameras if anybody does, and what a scenario checks against its frame rate, for a change of that
may need one of these."""


def check_read(study: Study, reads: Reads, first: Scenario, options: BaseModel) -> None:
    """Refuse factors, changes and options that the kind never reads, or that do nothing with all
    values of the others.

    It is told from what each kind says of itself, at no cost: to see that a factor changes no
    figure, a row would have to be computed once more for each factor and for each change.
    ``first``: the scenario of the first row, ``options``: its options, with their defaults.

    Raises StudyError: with all that the kind does read, or with the setting that leaves them
    without effect.
    """
    settings = {f"factors.{path}": path for path in study.factors}
    settings |= {f"changes.{path}": path for path in study.changes if not among(path, BESIDE)}
    settings |= {path: path for path in (f"options.{name}" for name in study.options)}
    for setting, path in settings.items():
        if not reads.covers(path):
            raise StudyError(
                f"{setting} does nothing: rows of kind {study.kind!r} do not read it; they read "
                f"{reads}, and their "
                "options"
            )
        for idle in reads.idle:
            if among(path, idle.keys) and all(
                _always(holds, key, study, first, options) for key, holds in idle.where.items()
            ):
                raise StudyError(
                    f"{setting} does nothing in rows of kind {study.kind!r} where {idle.why}"
                )


def _always(
    holds: Callable[[Any], bool], path: str, study: Study, first: Scenario, options: BaseModel
) -> bool:
    """Whether something holds of a path's value in all rows; no where another sensor may say
    otherwise.
    """
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


Row = dict[str, float]


def unwatched(scenario: Scenario) -> Scenario:
    """The scenario with nobody who watches its cameras: of what a watch finds no figure of a row
    speaks.
    """
    return scenario.with_overrides({"rig.watch": "none"})


@dataclass(frozen=True)
class Column:
    """Unit of a figure, what it is, and whether it is among the main ones: those that a summary
    shows and draws.
    """

    unit: str
    meaning: str
    main: bool = False


@dataclass(frozen=True)
class Kind:
    """One kind of row. `compute(scenario, seed, options)` gives a row's figures by name: the same
    arguments the same row, whatever was computed before.

    memory(scenario, options): bytes that a row holds at once; None where that is little. A built-in
    kind also says `what` a row is, its `columns`, the model of its `options` and what it `reads`. A
    function of one's own says none of this: its rows tell its figures, and it may take any options,
    or none.
    """

    name: str
    compute: Callable[[Scenario, np.random.SeedSequence, Any], Mapping[str, float]]
    what: str = ""
    columns: Mapping[str, Column] = field(default_factory=dict)
    options: type[Section] | None = None
    reads: Reads | None = None
    takes_options: bool = True
    memory: Callable[[Scenario, Any], float] | None = None

    def checked(self, options: Mapping[str, Any]) -> Any:
        """The options as `compute` takes them, with their defaults. Raises StudyError with the
        valid names.
        """
        if options and not self.takes_options:
            raise StudyError(
                f"kind {self.name!r} takes no options, got {', '.join(options)}; a function that "
                "does is "
                "run(scenario, seed, options)"
            )
        if self.options is None:
            return options
        try:
            return self.options.model_validate(dict(options))
        except ValidationError as error:
            raise StudyError(f"options of {self.name}: {one_line(error, self.options)}") from error

    def row(
        self, scenario: Scenario, seed: np.random.SeedSequence, options: Mapping[str, Any]
    ) -> Mapping[str, float]:
        """One row. Raises StudyError for wrong options, and what the row meets."""
        return self.compute(scenario, seed, self.checked(options))
