"""What a study may vary: the keys of a scenario, of a sensor file and of a kind's options, with their types."""

import difflib
import json
from collections.abc import Mapping
from functools import lru_cache
from typing import Annotated, Any, get_args

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from cmmsim.files.schema import SensorFile
from identify.errors import StudyError
from identify.scenario import Scenario

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
