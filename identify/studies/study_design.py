"""Design of a study: its rows, and the checks before any row is computed.

Rows are numbered from 0 repeat by repeat, and within a repeat point by point, with the last factor
varying fastest. The seed of row n is ``numpy.random.SeedSequence(seed).spawn(n + 1)[n]``.
The figures of a row therefore do not depend on the machines, on the order of work, or on the number
of repeats. With a single repeat they do not depend on the number of points of a sample either. Rows
are generated on demand, so a large grid takes no memory.
"""

import difflib
import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from functools import cached_property, lru_cache
from typing import Annotated, Any, ClassVar, get_args

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from cmmsim import CmmError, Sensor
from cmmsim.allowed_plugins import allowed_plugins
from cmmsim.files import SensorFile
from identify.errors import ScenarioError, StudyError
from identify.random_streams import SAMPLED_POINTS, child, mixed_generator
from identify.scenario import Scenario, load_scenario
from identify.scenario.scenario import tables_by_name
from identify.setup import Setup
from identify.studies.rows import KINDS, find_kind
from identify.studies.rows.kind import Kind, check_read
from identify.studies.study_file import Law, Range, Study

# Prefixes of the names of factors. No figure has such a prefix.
ROOTS = ("scenario.", "sensor.", "options.")
SENSOR_CHANGES = "sensor_changes"  # table of a scenario that holds the keys ``sensor.`` of a study
NEAREST = 4  # number of suggested names in an error message

STRICT = ConfigDict(strict=True, allow_inf_nan=False)


@dataclass(frozen=True)
class Case:
    """Row to be computed.

    number   Number of the row.
    repeat   Number of the repeat.
    factors  Value of each factor by dotted path.
    """

    number: int
    repeat: int
    factors: dict[str, Any]


@dataclass(frozen=True)
class Finished:
    """Finished row.

    number   Number of the row.
    figures  Figures by name. Empty if the row failed.
    seconds  Computing time, s.
    error    Reason of the failure in one line. Empty if the row did not fail.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT | ConfigDict(extra="forbid")

    number: Annotated[int, Field(ge=0)]
    figures: dict[str, float]
    seconds: float
    error: str = ""


@dataclass(frozen=True)
class Shared:
    """Common data of all rows of a study.

    kind      Kind of row.
    scenario  Scenario with the changes of all rows.
    options   Options of the kind that hold in all rows.
    seed      Seed of the study.
    """

    kind: str
    scenario: Scenario
    options: dict[str, Any]
    seed: int
    plugins: tuple[str, ...] = dataclass_field(default_factory=allowed_plugins)
    """Modules of users that are allowed to run, also on other machines."""

    def row_scenario(self, case: Case) -> Scenario:
        """Return the scenario of a row. Raises ScenarioError if its factors conflict."""
        return self.scenario.with_overrides(overrides(case.factors))

    def row_options(self, case: Case) -> dict[str, Any]:
        """Return the options of a row."""
        varied = {
            path: value for path, value in case.factors.items() if path.startswith("options.")
        }
        return self.options | {path.partition(".")[2]: value for path, value in varied.items()}

    def row_seed(self, number: int) -> np.random.SeedSequence:
        """Return the seed of a row."""
        return child(self.seed, number)


class Design:
    """Sequence of all rows of a study."""

    def __init__(self, study: Study) -> None:
        self._study = study

    def __len__(self) -> int:
        return self._study.rows

    def case(self, number: int) -> Case:
        """Return the row with this number."""
        repeat, point = divmod(number, self._study.points)
        return Case(
            number, repeat, self._drawn(point) if self._study.sample else self._on_grid(point)
        )

    def _on_grid(self, point: int) -> dict[str, Any]:
        lists = {
            path: values for path, values in self._study.factors.items() if isinstance(values, list)
        }
        indices = np.unravel_index(point, [len(values) for values in lists.values()])
        return {
            path: values[index]
            for (path, values), index in zip(lists.items(), indices, strict=True)
        }

    def _drawn(self, point: int) -> dict[str, Any]:
        fractions = zip(self._study.factors, self._fractions[point], strict=True)
        return {path: self._value(path, fraction) for path, fraction in fractions}

    @cached_property
    def _fractions(self) -> np.ndarray:
        """Positions (points, factors) of the points between the ends of each factor, in [0, 1)."""
        rng = mixed_generator(SAMPLED_POINTS, self._study.seed)
        return rng.random((self._study.points, len(self._study.factors)))

    def _value(self, path: str, fraction: float) -> Any:
        values = self._study.factors[path]
        if isinstance(values, list):
            return values[int(fraction * len(values))]
        # A user's own kind has no model of its options, and its module is not needed here.
        kind = KINDS.get(self._study.kind)
        field = field_of(path, kind.options if kind else None)
        if field is not None and field.annotation is int:
            # All integers from low to high are equally probable.
            return int(values.low) + int(fraction * (values.high - values.low + 1))
        if values.scale == "log":
            return float(values.low * (values.high / values.low) ** fraction)
        return float(values.low + (values.high - values.low) * fraction)


def overrides(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the overrides of a scenario for settings by path. Options are left out."""
    replaced = {}
    for path, value in settings.items():
        root, _, key = path.partition(".")
        if root == "scenario":
            replaced[key] = value
        elif root == "sensor":
            replaced[f"{SENSOR_CHANGES}.{key}"] = value
    return replaced


def prepare(study: Study, given: Scenario | None = None) -> Shared:
    """Check a study's keys, values, kind and laws, and load the common data of its rows.

    The first row is checked completely. If values contradict each other only in other rows, these
    rows will get errors.

    Parameters
    ----------
    study : Study
        The study.
    given : Scenario, optional
        Scenario that is varied. The default is the scenario that the study names.

    Raises
    ------
    StudyError
        The scenario does not exist, or the changes contradict it. The kind, a key, an option, a
        figure, or a law's factor is unknown (the message suggests valid names). A value is wrong,
        rows of this kind do not read a key, or the statistical renderer was not validated for the
        sensor.
    ScenarioError
        The factors of the first row contradict each other.
    """
    kind = find_kind(study.kind)
    kind.checked(study.options)
    _check_keys(study, kind)
    try:
        # "auto" is resolved here, so that all machines use the same renderer.
        stated = (given or load_scenario(study.scenario)).with_overrides(overrides(study.changes))
        scenario = Setup(stated).on_this_machine().scenario
    except ScenarioError as error:
        raise StudyError(f"scenario of the study: {error}") from error
    shared = Shared(study.kind, scenario, study.options, study.seed)
    first = Design(study).case(0)
    row_scenario = shared.row_scenario(first)
    row_options = kind.checked(shared.row_options(first))
    if kind.reads is not None:
        check_read(study, kind.reads, row_scenario, row_options)
    if getattr(row_options, "sensor", "images") == "images":
        plan = Setup(row_scenario).sensor_plan
        try:
            # The statistical renderer was validated for some sensors only. The property `camera`
            # raises CmmError for others.
            if plan.renderer == "statistical":
                _ = Sensor(plan.file, renderer=plan.renderer).camera
        except CmmError as error:
            raise StudyError(f"the first row's sensor: {error}") from error
    for name in study.figures or [] if kind.columns else []:
        if name not in kind.columns:
            raise StudyError(
                f"figures has {name!r}, which is not a figure of {study.kind}; "
                f"{_nearest(name, kind.columns)}"
            )
    for number, law in enumerate(study.theory, start=1):
        try:
            _check_law(law, study, list(kind.columns))
        except StudyError as error:
            raise StudyError(f"[[theory]] {number}: {error}") from error
    return shared


def _check_keys(study: Study, kind: Kind) -> None:
    """Raise StudyError for unknown, misplaced or repeated keys, and wrong or repeated values."""
    for path, value in study.changes.items():
        if path.startswith("options."):
            raise StudyError(f"changes.{path}: options of all rows belong in [options]")
        _check_values(path, [value], kind)
    for path, values in study.factors.items():
        if path.startswith("options.") and path.partition(".")[2] in study.options:
            raise StudyError(f"{path} is both a factor and among the options")
        _check_values(path, values.ends if isinstance(values, Range) else values, kind)
        if not isinstance(values, list):
            continue
        # TOML writes a number as 1 or as 1.0, and True is an int in Python.
        types = {
            "number" if type(value) in (int, float) else type(value).__name__ for value in values
        }
        if len(types) > 1:
            raise StudyError(
                f"factors.{path} = {values} has values of several kinds: {', '.join(sorted(types))}"
            )
        # Values can be lists, which are not hashable, so their texts are compared.
        if len({repr(value) for value in values}) < len(values):
            raise StudyError(
                f"factors.{path} = {values} has a value twice; use repeats = N to compute every "
                "point N times"
            )


def _check_values(path: str, values: list[Any], kind: Kind) -> None:
    """Raise StudyError for a path that does not exist, and for values that are not of its type.

    Options of a user's own kind are not checked.
    """
    if kind.options is None and path.startswith("options."):
        return
    known = valid_keys(kind.options)
    field = field_of(path, kind.options)
    if field is None:
        own = [key for key in known if path.startswith("options.") and key.startswith("options.")]
        valid = f"the kind has {', '.join(own)}" if own else _nearest(path, known)
        raise StudyError(f"unknown key {path!r}; {valid}")
    # Values are validated as JSON, in which a list can be a tuple. In strict mode, a text or a bool
    # is not accepted as a number.
    annotation: Any = Annotated[field.annotation, field]
    adapter: TypeAdapter[Any] = TypeAdapter(annotation, config=ConfigDict(allow_inf_nan=False))
    for value in values:
        try:
            adapter.validate_json(json.dumps(value), strict=True)
        except ValidationError as error:
            message = error.errors()[0]["msg"]
            raise StudyError(f"{path} = {value!r}: {message[0].lower()}{message[1:]}") from error


@lru_cache(maxsize=8)
def valid_keys(options: type[BaseModel] | None) -> dict[str, FieldInfo]:
    """Return every dotted path that a study can vary, with its field.

    The paths are keys of scenarios, of sensor files, and of `options`, the model of the options of
    a kind.
    """
    fields = _leaves(Scenario, "scenario.") | _leaves(SensorFile, "sensor.")
    for path in (f"scenario.{SENSOR_CHANGES}", "sensor.based_on"):
        del fields[path]
    return fields | (_leaves(options, "options.") if options is not None else {})


def field_of(path: str, options: type[BaseModel] | None = None) -> FieldInfo | None:
    """Return the field of a dotted path that a study can vary, or None.

    The path can also name an entry of a table of a scenario, such as `scenario.plant.values`.
    """
    for table, entry in tables_by_name():
        if path.startswith(f"scenario.{table}."):
            return FieldInfo(annotation=entry)
    return valid_keys(options).get(path)


def _leaves(model: type[BaseModel], prefix: str) -> dict[str, FieldInfo]:
    """Return the fields that are not sections, by dotted path."""
    leaves: dict[str, FieldInfo] = {}
    for name, field in model.model_fields.items():
        kinds = (field.annotation, *get_args(field.annotation))
        inner = next((t for t in kinds if isinstance(t, type) and issubclass(t, BaseModel)), None)
        # A list of sections counts as one value, because no dotted path leads to its entries.
        listed = getattr(field.annotation, "__origin__", None) is list
        if inner is None or listed:
            leaves[f"{prefix}{name}"] = field
        else:
            leaves |= _leaves(inner, f"{prefix}{name}.")
    return leaves


def _nearest(name: str, known: Collection[str]) -> str:
    """Return a text that suggests valid names.

    Names with the same last part or a similar spelling are suggested. If there are none, the first
    names with the same root are suggested, or else the first of all names.
    """
    last = [key for key in known if key.rpartition(".")[2] == name.rpartition(".")[2]]
    alike = difflib.get_close_matches(name, known, n=NEAREST, cutoff=0.5)
    root = [key for key in known if key.startswith(name.partition(".")[0] + ".")]
    near = list(dict.fromkeys([*last, *alike])) or root or list(known)
    return f"the nearest are {', '.join(near[:NEAREST])}" if near else "it has no factors"


def _check_law(law: Law, study: Study, figures: list[str]) -> None:
    """Raise StudyError for a law with unknown figures, or with factors or values not varied.

    The figures of a user's own kind are unknown before its rows are computed. `figures` is then
    empty, and the figures of the law are not checked.
    """
    for key in ("figure", "per", "equals"):
        name = getattr(law, key)
        if figures and name is not None and name not in figures:
            raise StudyError(
                f"{key} = {name!r} is not a figure of {study.kind}; {_nearest(name, figures)}"
            )
    if law.factor is None:
        return
    known = [*study.factors, *figures]
    if law.factor not in known and (figures or law.factor.startswith(ROOTS)):
        raise StudyError(
            f"factor = {law.factor!r} is not varied by the study; {_nearest(law.factor, known)}"
        )
    if law.factor not in study.factors and len(study.factors) > 1:
        ratio = f'per = "{law.factor}", factor = "{next(iter(study.factors))}", exponent = 0.0'
        raise StudyError(
            f"a law against the figure {law.factor!r} needs a study of one factor, but "
            f"{', '.join(study.factors)} are varied"
            + (f"; state a constant ratio instead: {ratio}" if law.exponent == 1.0 else "")
        )
    values = study.factors.get(law.factor)
    unknown = [
        value for value in law.order or [] if isinstance(values, list) and value not in values
    ]
    if unknown:
        raise StudyError(f"order has {unknown[0]!r}, but {law.factor} has the values {values}")
