"""What may stand in scenario, sensor, robot and study files, from their JSON schemas."""

import json
from typing import Any

from cmmsim.files.sensor_file import sensor_schema
from dynamics.robot_file import FAMILIES, robot_schema
from identify.record.conditions import OPTIONAL
from identify.record.csv_record import RULES
from identify.record.own_record import record_schema
from identify.record.recording import VARIABLES
from identify.scenario.scenario import scenario_schema
from identify.studies.labels import factor_unit
from identify.studies.rows import KINDS
from identify.studies.study_file import study_schema


def scenario() -> str:
    """Scenario files."""
    return _page(scenario_schema())


def sensor() -> str:
    """Sensor files."""
    return _page(sensor_schema())


def robot() -> str:
    """Robot files."""
    families = "\n".join(
        f"| `{name}` | `{one.kind}` | {one.legs} | `{one.chart}` |"
        for name, one in FAMILIES.items()
    )
    head = (
        "| family | kind of its legs | legs | freedoms |\n| --- | --- | --- | --- "
        f"|\n{families}\n\n"
    )
    return head + _page(robot_schema())


def study() -> str:
    """Study files, and the kinds of row with their options and figures."""
    parts = [_page(study_schema())]
    for kind in KINDS.values():
        parts.append(f"## Rows of kind `{kind.name}`\n\n{_sentence(kind.what)}")
        if kind.options is not None:
            parts.append(
                _table(
                    kind.options.model_json_schema(),
                    {},
                    units=lambda key: factor_unit(f"options.{key}"),
                )
            )
        figures = "\n".join(
            f"| `{name}` | {'' if one.unit == '1' else one.unit} | {_plain(one.meaning)} |"
            for name, one in kind.columns.items()
        )
        parts.append(f"| figure | unit | what it is |\n| --- | --- | --- |\n{figures}")
    return "\n\n".join(parts) + "\n"


def record() -> str:
    """The TOML file beside a record as CSV."""
    return _page(record_schema(), "###")


def record_rules() -> str:
    """The rules that a record keeps, one a line."""
    sentences = _plain(RULES.replace("\n", " ")).split(". ")
    return "\n".join(f"- {sentence.rstrip('.')}." for sentence in sentences) + "\n"


def record_variables() -> str:
    """What a record holds as netCDF."""
    rows = "\n".join(
        f"| `{name}` | {', '.join(sizes)} | {'' if unit == '1' else unit} | {_plain(what)} |"
        for name, (sizes, unit, what) in (VARIABLES | OPTIONAL).items()
    )
    return f"| variable | over | unit | what |\n| --- | --- | --- | --- |\n{rows}\n"


def _page(schema: dict[str, Any], mark: str = "##") -> str:
    definitions = schema.get("$defs", {})
    parts = [f"{mark} At the top of the file", _table(schema, definitions)]
    seen: set[str] = set()
    _tables(schema, definitions, "", parts, seen)
    parts = [
        part.replace("## ", f"{mark} ", 1) if part.startswith("## ") else part for part in parts
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _tables(
    schema: dict[str, Any], definitions: dict[str, Any], path: str, parts: list[str], seen: set[str]
) -> None:
    """A heading and a table for each section, once, where it is first met."""
    extra = schema.get("additionalProperties")
    properties = dict(schema.get("properties", {}))
    if isinstance(extra, dict):
        properties["NAME"] = extra
    for key, value in properties.items():
        place = f"{path}.{key}".lstrip(".")
        for name in _referenced(value):
            if name in seen:
                continue
            seen.add(name)
            inner = definitions[name]
            if "properties" not in inner and "additionalProperties" not in inner:
                continue
            several = value.get("type") == "array" or any(
                one.get("type") == "array" for one in value.get("anyOf", [])
            )
            by_name = isinstance(value.get("additionalProperties"), dict)
            shown = f"{place}.NAME" if by_name else place
            title = f"`[[{shown}]]`" if several else f"`[{shown}]`"
            kind = inner.get("properties", {}).get("type", {}).get("const")
            parts.append(f"## {title}{f' of type `{kind}`' if kind else ''}")
            parts += [_plain(inner.get("description", "")), _table(inner, definitions)]
            _tables(inner, definitions, shown, parts, seen)


def _referenced(value: Any) -> list[str]:
    """Names of the definitions that a property takes, in their order."""
    if isinstance(value, list):
        return [name for one in value for name in _referenced(one)]
    if not isinstance(value, dict):
        return []
    if "$ref" in value:
        return [value["$ref"].rpartition("/")[2]]
    return [
        name
        for key, one in value.items()
        if key not in ("default", "discriminator")
        for name in _referenced(one)
    ]


def _table(schema: dict[str, Any], definitions: dict[str, Any], units: Any = None) -> str:
    required, rows = schema.get("required", []), []
    for key, value in schema.get("properties", {}).items():
        if _is_section(value, definitions):
            continue  # it has a heading and a table of its own
        default = "required" if key in required else _default(value)
        unit = units(key) if units else value.get("unit", "")
        unit = "" if unit == "1" else unit
        what = "; ".join(
            part for part in (_plain(value.get("description", "")), _limits(value)) if part
        )
        rows.append((f"`{key}`", _type(value, definitions), default, unit, what))
    if not rows:
        return ""
    kept = [k for k in range(5) if k != 3 or any(row[3] for row in rows)]
    lines = [("key", "type", "default", "unit", "what"), ("---",) * 5, *rows]
    return "\n".join(f"| {' | '.join(line[k] for k in kept)} |" for line in lines)


def _is_section(value: dict[str, Any], definitions: dict[str, Any]) -> bool:
    """Whether a property is a table with known keys, and nothing else."""
    return "$ref" in value and "properties" in definitions[value["$ref"].rpartition("/")[2]]


def _default(value: dict[str, Any]) -> str:
    if "default" not in value or value["default"] is None or isinstance(value["default"], dict):
        return ""
    shown = json.dumps(value["default"])
    return f"`{shown}`" if len(shown) < 40 else ""


def _type(value: dict[str, Any], definitions: dict[str, Any]) -> str:
    """A property's type in words."""
    if "const" in value:
        return f"`{json.dumps(value['const'])}`"
    if "enum" in value:
        return ", ".join(f"`{json.dumps(one)}`" for one in value["enum"])
    if "$ref" in value:
        name = value["$ref"].rpartition("/")[2]
        inner = definitions.get(name, {})
        return "table" if "properties" in inner or not inner else _type(inner, definitions)
    for joint in ("anyOf", "oneOf"):
        if joint in value:
            kinds = [_type(one, definitions) for one in value[joint] if one.get("type") != "null"]
            return " or ".join(dict.fromkeys(kinds))
    if value.get("type") == "array":
        if "prefixItems" in value:
            return (
                f"{len(value['prefixItems'])} "
                f"{_plural(_type(value['prefixItems'][0], definitions))}"
            )
        inner = _plural(_type(value.get("items", {}), definitions))
        least, most = value.get("minItems"), value.get("maxItems")
        return f"{least} {inner}" if least is not None and least == most else f"list of {inner}"
    words = {"integer": "whole number", "number": "number", "string": "text", "boolean": "true or "
                                                                                         "false",
             "object": "table"}  # fmt: skip
    return words.get(value.get("type", ""), "any value")


def _plural(kind: str) -> str:
    words = {
        "number": "numbers",
        "whole number": "whole numbers",
        "text": "texts",
        "table": "tables",
    }
    return words.get(kind, kind)


def _limits(value: dict[str, Any]) -> str:
    """Narrowest of the lower and of the upper limits of a property, in words."""
    parts = [value, *(one for one in value.get("anyOf", []) if isinstance(one, dict))]
    lower = [
        (part[name], sign)
        for part in parts
        for name, sign in (("minimum", "≥"), ("exclusiveMinimum", ">"))
        if name in part
    ]
    upper = [
        (part[name], sign)
        for part in parts
        for name, sign in (("maximum", "≤"), ("exclusiveMaximum", "<"))
        if name in part
    ]
    # Of equal numbers the limit that excludes the number is the narrower one.
    narrowest = [
        *sorted(lower, key=lambda limit: (-limit[0], limit[1] == "≥"))[:1],
        *sorted(upper, key=lambda limit: (limit[0], limit[1] == "≤"))[:1],
    ]
    return " and ".join(f"{sign} {number:g}" for number, sign in narrowest)


def _sentence(text: str) -> str:
    return _plain(text[:1].upper() + text[1:]).rstrip(".") + "."


def _plain(text: str) -> str:
    """A docstring's text in a Markdown table or paragraph."""
    for role in (":mod:", ":class:"):
        text = text.replace(role, "")
    text = text.replace("``", "`")
    pieces = text.split("`")
    for k in range(0, len(pieces), 2):
        for sign in "\\*_|<>{}$":
            pieces[k] = pieces[k].replace(sign, f"\\{sign}")
    return " ".join("`".join(pieces).split())
