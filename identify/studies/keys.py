"""What a study may vary and its laws may name, and whether its rows read it: asked before any row is computed."""

import difflib
import json
from collections.abc import Callable, Collection, Mapping
from functools import lru_cache, reduce
from typing import Annotated, Any, get_args

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from cmmsim.files.schema import SensorFile
from cmmsim.files.sensor_file import read_sensor_file
from identify.errors import StudyError
from identify.scenario import Scenario
from identify.studies.rows.columns import Reads, among, timing
from identify.studies.rows.kinds import figure_names
from identify.studies.study_file import Law, Range, Study

# What a study may vary: the keys of a scenario, of a sensor file and of a kind's options, with their types.


SENSOR_CHANGES = "sensor_changes"
"""The table of a scenario into which the keys ``sensor.`` go."""


def check(path: str, values: list[Any], options: type[BaseModel] | None) -> None:
    """Refuse a path that does not exist and values that are not of its type or within its limits.

    ``options``: the model of the kind's options; None for a kind of one's own, whose options are not checked.

    Raises:
        StudyError: with the nearest valid paths, or with the value.
    """
    if options is None and path.startswith("options."):
        return
    known = valid_keys(options)
    if path not in known:
        own = [key for key in known if path.startswith("options.") and key.startswith("options.")]
        valid = f"the kind has {', '.join(own)}" if own else f"the nearest are {', '.join(_nearest(path, known))}"
        raise StudyError(f"unknown key {path!r}; {valid}")
    field = known[path]
    # As in JSON, so that a list is a tuple's spelling but a text or a truth value is no number.
    annotation: Any = Annotated[field.annotation, field]
    adapter: TypeAdapter[Any] = TypeAdapter(annotation, config=_FINITE)
    for value in values:
        try:
            adapter.validate_json(json.dumps(value), strict=True)
        except ValidationError as error:
            message = error.errors()[0]["msg"]
            raise StudyError(f"{path} = {value!r}: {message[0].lower()}{message[1:]}") from error


def is_integer(path: str, options: type[BaseModel] | None) -> bool:
    """Whether the values of a path are integers."""
    field = valid_keys(options).get(path)
    return field is not None and field.annotation is int


def overrides(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of ``scenario.`` and ``sensor.`` as overrides of a scenario."""
    found = {}
    for path, value in settings.items():
        root, _, key = path.partition(".")
        if root == "scenario":
            found[key] = value
        elif root == "sensor":
            found[f"{SENSOR_CHANGES}.{key}"] = value
    return found


def options_in(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of ``options.`` without that prefix."""
    return {path.partition(".")[2]: value for path, value in settings.items() if path.startswith("options.")}


_FINITE = ConfigDict(allow_inf_nan=False)


@lru_cache(maxsize=8)
def valid_keys(options: type[BaseModel] | None) -> dict[str, FieldInfo]:
    """Every dotted path that a study may vary, with its field; `options`: as in :func:`check`."""
    found = _leaves(Scenario, "scenario.") | _leaves(SensorFile, "sensor.")
    for path in (f"scenario.{SENSOR_CHANGES}", "sensor.based_on"):
        del found[path]
    return found | (_leaves(options, "options.") if options is not None else {})


def _leaves(model: type[BaseModel], prefix: str) -> dict[str, FieldInfo]:
    """Fields that are no sections, by dotted path."""
    found: dict[str, FieldInfo] = {}
    for name, field in model.model_fields.items():
        inner = next((a for a in (field.annotation, *get_args(field.annotation)) if _is_model(a)), None)
        listed = getattr(field.annotation, "__origin__", None) is list
        found |= {f"{prefix}{name}": field} if inner is None or listed else _leaves(inner, f"{prefix}{name}.")
    return found


def _is_model(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _nearest(path: str, known: Mapping[str, Any]) -> list[str]:
    """Up to four valid paths: those spelled alike, else those with the same last part, else some of the same root."""
    alike = difflib.get_close_matches(path, known, n=4, cutoff=0.6)
    last = [key for key in known if key.rpartition(".")[2] == path.rpartition(".")[2]]
    same_root = [key for key in known if key.startswith(path.partition(".")[0] + ".")]
    return list(dict.fromkeys([*last, *alike]))[:4] or same_root[:4] or ["scenario.KEY", "sensor.KEY", "options.KEY"]


# Whether a study's laws speak of what its rows will have: asked before any row is computed.


ROOTS = ("scenario.", "sensor.", "options.")
"""How factors begin, and figures do not."""
NEAREST = 4
"""Valid names that a refusal gives."""


def check_law_names(study: Study) -> None:
    """Refuse laws of figures that the kind's rows do not have, or of factors and values that the study does not vary.

    The figures of a kind of one's own are not known before its rows are, and are not checked here.

    Raises:
        StudyError: with the law, the name and the nearest valid ones.
    """
    figures = figure_names(study.kind)
    for place, law in enumerate(study.theory, start=1):
        try:
            _check(law, study, figures)
        except StudyError as error:
            raise StudyError(f"[[theory]] {place}: {error}") from error


def _check(law: Law, study: Study, figures: list[str] | None) -> None:
    for key in ("figure", "per", "equals"):
        name = getattr(law, key)
        if figures is not None and name is not None and name not in figures:
            raise StudyError(f"{key} = {name!r} is no figure of {study.kind}; {_suggestion(name, figures)}")
    if law.factor is None:
        return
    known = [*study.factors, *(figures or [])]
    if law.factor not in known and (figures is not None or law.factor.startswith(ROOTS)):
        raise StudyError(f"factor = {law.factor!r} is not varied by the study; {_suggestion(law.factor, known)}")
    values = study.factors.get(law.factor)
    unknown = [value for value in law.order or [] if isinstance(values, list) and value not in values]
    if unknown:
        raise StudyError(f"order has {unknown[0]!r}, and {law.factor} has the values {values}")


def _suggestion(name: str, known: Collection[str]) -> str:
    """The valid names most like a name, or the first of them where none is alike."""
    near = difflib.get_close_matches(name, known, n=NEAREST, cutoff=0.5) or list(known)[:NEAREST]
    return f"the nearest are {', '.join(near)}" if near else "it has no factors"


# Whether a study's rows read what it sets: asked before any row is computed, so that no factor varies nothing.


BESIDE = (
    "scenario.name", "scenario.description", "scenario.sensor_note", "sensor.name", "sensor.note", "scenario.renderer",
    *timing("frame_rate_hz", "exposure_s", "latency_s", "latency_jitter_s"), "scenario.filter.",
    "scenario.excitation.fundamental_hz", "scenario.excitation.harmonics", "scenario.excitation.duration_s",
    "scenario.validation.duration_s",
)  # fmt: skip
"""What may stand among the changes of any kind: labels, what draws if anything does, and what a scenario checks against
its frame rate, for a change of that may need one of these."""


def check_ever_read(study: Study, reads: Reads) -> None:
    """Refuse factors that the kind never reads, and changes likewise but for those of BESIDE.

    Raises:
        StudyError: with all that it does read.
    """
    changes = [path for path in study.changes if not among(path, BESIDE)]
    for table, paths in (("factors", list(study.factors)), ("changes", changes)):
        for path in paths:
            if not reads.covers(path):
                raise StudyError(
                    f"{table}.{path} does nothing: rows of kind {study.kind!r} do not read it; they read {reads}, and "
                    "their options"
                )


def check_read_here(study: Study, reads: Reads, first: Scenario, options: BaseModel) -> None:
    """Refuse factors, changes and options that do nothing with all values of the others.

    ``first``: the scenario of the first row, ``options``: its options, with their defaults.

    Raises:
        StudyError: with the setting that leaves them without effect.
    """
    changes = [f"changes.{path}" for path in study.changes if not among(path, BESIDE)]
    settings = [f"factors.{path}" for path in study.factors] + changes + [f"options.{name}" for name in study.options]
    for idle in reads.idle:
        if not all(_always(holds, path, study, first, options) for path, holds in idle.where.items()):
            continue
        for setting in settings:
            if among(setting.removeprefix("factors.").removeprefix("changes."), idle.keys):
                raise StudyError(f"{setting} does nothing in rows of kind {study.kind!r} where {idle.why}")


def _always(holds: Callable[[Any], bool], path: str, study: Study, first: Scenario, options: BaseModel) -> bool:
    """Whether something holds of a path's value in all rows; no where another sensor may say otherwise."""
    twins = next((pair for pair in _TWINS if path in pair), (path,))
    for twin in twins:
        if twin in study.factors:
            values = study.factors[twin]
            return all(map(holds, [values.low, values.high] if isinstance(values, Range) else values))
    root, _, key = path.partition(".")
    if root == "options":
        return holds(getattr(options, key))
    if "scenario.sensor" in study.factors and (root == "sensor" or len(twins) > 1):
        return False
    owner: BaseModel = first if root == "scenario" else read_sensor_file(first.sensor, first.sensor_changes)
    return holds(reduce(getattr, key.split("."), owner))


_TWINS = [timing(name) for name in ("frame_rate_hz", "exposure_s", "latency_s", "latency_jitter_s", "dropout")]
