"""Study files in TOML: the scenario, its variation, and the laws that its rows should follow.

``cmmsim new study FILE`` writes a commented file. The keys of factors and changes are dotted paths:
``scenario.`` and a key of a scenario, ``sensor.`` and a key of a sensor file, or ``options.`` and
an option of the kind.
"""

import math
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError, field_validator, model_validator

from dynamics.files import Name
from identify.errors import StudyError
from identify.scenario.scenario import SCENARIOS, Scenario, has_field
from identify.scenario.section import Section
from identify.scenario.settings_file import SettingsFiles, one_line


class Law(Section):
    """Expected rms of a figure over rows. A figure is a number that each row computes.

    A law has one of three forms. ``exponent``: the rms is proportional to this power of ``factor``,
    a numeric factor, or another figure in a study of one factor. ``equals``: the rms equals that of
    another figure. ``order``: the rms grows along these values of ``factor``. The factors that
    ``factor`` does not name are fixed in the first and third form. ``tolerance`` is the allowed
    error of the exponent, or of the logarithm of a ratio.
    """

    figure: str = Field(description="figure of the rows; the law is about its rms over rows")
    per: str | None = Field(None, description="divisor: another figure of the same row")
    factor: str | None = Field(
        None,
        description="factor by dotted path; for exponent in a study of one factor, also a figure "
        "of the rows",
    )
    exponent: float | None = Field(
        None, ge=-100, le=100, description="the rms is proportional to this power of the factor"
    )
    equals: str | None = Field(None, description="figure that has the same rms")
    order: list[Any] | None = Field(
        None, description="values of the factor, the smallest rms first"
    )
    tolerance: float = Field(0.0, ge=0, le=1e3, description="allowed error of the law itself")
    why: str = Field("", description="reason for the law")

    @model_validator(mode="after")
    def _states_one_thing(self) -> "Law":
        stated = [
            name for name in ("exponent", "equals", "order") if getattr(self, name) is not None
        ]
        if len(stated) != 1:
            raise ValueError(
                f"a law states one of exponent, equals and order, got {', '.join(stated) or 'none'}"
            )
        if (self.factor is None) != (self.equals is not None):
            raise ValueError(
                f"a law with {stated[0]} {'needs a' if self.factor is None else 'has no'} factor"
            )
        if self.order is not None and len(self.order) < 2:
            raise ValueError(f"order needs two values or more, got {self.order}")
        return self

    @property
    def quantity(self) -> str:
        """Figure, or its ratio to the figure `per`, as text."""
        return self.figure if self.per is None else f"{self.figure} / {self.per}"

    @property
    def statement(self) -> str:
        """Statement of the law in one line."""
        if self.equals is not None:
            return f"{self.quantity} = {self.equals}"
        if self.order is not None:
            return f"{self.quantity} grows along {self.factor} = {', '.join(map(str, self.order))}"
        return f"{self.quantity} ~ {self.factor} ^ {self.exponent:g}"

    @property
    def expected(self) -> str:
        """Expected exponent or ratio, as text."""
        if self.order is not None:
            return "ratio > 1"
        value = "ratio 1" if self.exponent is None else f"{self.exponent:g}"
        return f"{value} ± {self.tolerance:g}" if self.tolerance else value


class Range(Section):
    """Interval from which a sample draws a factor, uniformly in its value or in its logarithm."""

    low: float
    high: float
    scale: Literal["linear", "log"] = "linear"

    @model_validator(mode="after")
    def _ordered(self) -> "Range":
        if not self.low < self.high:
            raise ValueError(f"low = {self.low:g} must be less than high = {self.high:g}")
        if self.scale == "log" and self.low <= 0:
            raise ValueError(f"low = {self.low:g} must be positive on a logarithmic scale")
        return self

    @property
    def ends(self) -> list[float]:
        """Both bounds, as integers where they are whole."""
        return [int(bound) if bound.is_integer() else bound for bound in (self.low, self.high)]


class Study(Section):
    """Content of a study file. `load_study` reads a file."""

    name: Name = Field(description="short name, used for folders")
    title: str = Field("", description="question of the study, the title of its plots")
    kind: str = Field(description="kind of row: a built-in one, or module:function")
    scenario: str = Field(
        "paper",
        description="built-in scenario, or path of a scenario file relative to this file",
    )
    changes: dict[str, Any] = Field({}, description="values of all rows, by dotted path")
    factors: dict[str, list[Any] | Range] = Field(
        {}, description="values of each factor, by dotted path"
    )
    sample: int | None = Field(
        None, description="number of points drawn at random; none: the whole grid", ge=1
    )
    repeats: int = Field(1, description="rows at each point", ge=1)
    seed: int = Field(0, description="seed of all randomness", ge=0)
    theory: list[Law] = Field([], description="laws with which the summary compares the rows")
    options: dict[str, Any] = Field({}, description="options of the kind")
    figures: list[str] | None = Field(
        None,
        description="figures of the rows that are plotted and tabulated; none: the main figures of "
        "the kind",
    )

    @field_validator("changes", mode="before")
    @classmethod
    def _changes_by_path(cls, tables: Any) -> Any:
        return _by_path(tables)

    @field_validator("factors", mode="before")
    @classmethod
    def _factors_by_path(cls, tables: Any) -> Any:
        values = _by_path(tables, keep=("low", "high"))
        return (
            {path: _factor(path, value) for path, value in values.items()}
            if isinstance(values, dict)
            else values
        )

    @model_validator(mode="after")
    def _fits_together(self) -> "Study":
        for path, values in self.factors.items():
            if isinstance(values, Range) and self.sample is None:
                raise ValueError(
                    f"factors.{path} with low and high needs sample = N; a grid needs a list"
                )
            if isinstance(values, list) and not values:
                raise ValueError(f"factors.{path} has no values")
            if path in self.changes:
                raise ValueError(f"{path} is both a factor and among the changes")
        return self

    @property
    def points(self) -> int:
        """Number of different settings."""
        if self.sample is not None:
            return self.sample
        return math.prod(
            len(values) for values in self.factors.values() if isinstance(values, list)
        )

    @property
    def rows(self) -> int:
        """Number of rows, one for each point and repeat."""
        return self.points * self.repeats

    def with_settings(self, settings: Mapping[str, Any]) -> "Study":
        """Return a copy of the study in which ``settings``, values by dotted path, replace entries.

        An example is ``{"repeats": 5, "scenario.timing.latency_s": 0.01}``. A key of the scenario,
        of the sensor or of the options becomes a factor if its value is a list, or a table of low
        and high. Any other value becomes the value of all rows.

        Raises
        ------
        StudyError
            There is no such entry (the message names valid ones), or a value does not fit.
        """
        data = {"factors": {}, "changes": {}, "options": {}} | self.model_dump(exclude_unset=True)
        single = [
            name
            for name in Study.model_fields
            if name not in ("factors", "changes", "options", "theory")
        ]
        for path, value in settings.items():
            root, _, key = path.partition(".")
            if path in single:
                data[path] = value
            elif root in ("scenario", "sensor", "options") and key:
                table = "options" if root == "options" else "changes"
                name = key if root == "options" else path
                data["factors"] = _without(data["factors"], path)
                data[table] = _without(data[table], name)
                is_range = isinstance(value, dict) and set(value) & set(Range.model_fields)
                if isinstance(value, list) or is_range:
                    data["factors"][path] = value
                else:
                    data[table][name] = value
            else:
                meant = _with_root(path)
                raise StudyError(
                    f"unknown key {path!r} of study {self.name!r}; "
                    + (f"did you mean {meant}? Other " if meant else "")
                    + f"valid names: {', '.join(single)}, and scenario.*, "
                    "sensor.* and options.* for factors and changes"
                )
        return STUDIES.from_dict(data, f"study {self.name!r}")


# Keys of scenarios that name files, in the tables of changes and factors, with the built-in names.
_VARIED = {
    f"{table}.scenario.{key}": names
    for table in ("changes", "factors")
    for key, names in SCENARIOS.files.items()
}
STUDIES = SettingsFiles(
    "study",
    Path(__file__).parent / "built_in",
    Study,
    StudyError,
    {"scenario": SCENARIOS.names, **_VARIED},
)

STARTING = Path(__file__).parent / "starting.toml"  # template of a study file, with all keys


def load_study(name_or_path: str | Path) -> Study:
    """Load a built-in study by name, or a study from a TOML file.

    Paths in a file are relative to its folder. The keys of factors and changes are checked later,
    by `identify.studies.study_design`.

    Raises
    ------
    StudyError
        There is no such study (the message names the built-in studies), or the file is not TOML or
        has wrong content.
    """
    return STUDIES.load(name_or_path)


def study_schema() -> dict[str, Any]:
    """Return the JSON schema of study files. Editors read it from `built_in/study.schema.json`.

    Factors and changes are nested tables. Their keys are keys of scenarios, of sensor files, and of
    options.
    """
    schema = Study.model_json_schema()
    for name in ("changes", "factors"):
        known = schema["properties"][name]
        schema["properties"][name] = {
            "type": "object",
            "description": known["description"],
            "propertyNames": {"pattern": r"^(scenario|sensor|options)(\.|$)"},
        }
    # The schema does not refer to Range any more.
    del schema["$defs"]["Range"]
    return schema


def _factor(path: str, value: Any) -> Any:
    """Return a factor's list of values or range. Raises ValueError for anything else."""
    if isinstance(value, (list, Range)):
        return value
    if not isinstance(value, Mapping):
        raise ValueError(
            f"{path} = {value!r} is not a list of values; write a value of all rows under [changes]"
        )
    try:
        return Range.model_validate(value)
    except ValidationError as error:
        raise ValueError(f"{path}: {one_line(error, Range)}") from error


def _with_root(path: str) -> str:
    """Return a key of a scenario or a sensor file with the root that it lacks, or no text."""
    from cmmsim.files import SensorFile

    models = (("scenario", Scenario), ("sensor", SensorFile))
    return next((f"{root}.{path}" for root, model in models if has_field(model, path)), "")


def _without(values: dict[str, Any], path: str) -> dict[str, Any]:
    """Return a copy of values by dotted path, without the one at a path and those of its table."""
    return {key: value for key, value in values.items() if not f"{key}.".startswith(f"{path}.")}


def _by_path(tables: Any, keep: Collection[str] = (), prefix: str = "") -> Any:
    """Flatten nested tables by dotted path, except empty ones and those with a key in ``keep``."""
    if not isinstance(tables, Mapping):
        return tables
    flat: dict[str, Any] = {}
    for key, value in tables.items():
        nested = isinstance(value, Mapping) and value and not set(value) & set(keep)
        flat |= _by_path(value, keep, f"{prefix}{key}.") if nested else {f"{prefix}{key}": value}
    return flat
