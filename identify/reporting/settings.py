"""The settings of a run as its report tells them: what differs from the built-in scenario that it
began with.
"""

import tomllib
from collections.abc import Mapping
from typing import Any, NamedTuple

from identify.scenario import load_scenario, scenario_names

BUILT_IN_PAPER = "paper"
"""The scenario whose settings are the paper's, and with which those without a built-in name are
compared.
"""


class Setting(NamedTuple):
    """A setting of a run by its dotted key, of the scenario and of the built-in one; a dash where
    one has none.
    """

    key: str
    value: str
    built_in: str
    meaning: str


def changed_settings(
    recorded: str, estimator: Mapping[str, Any] | None = None
) -> tuple[str, list[Setting]]:
    """The built-in scenario that a recorded one (TOML) is to be compared with, by name, and the
    settings that differ.

    estimator: settings of the identification by dotted key, where they may have been changed after
    the record was made.
    """
    ours = _settings(recorded)
    name = ours["name"].value if "name" in ours else ""
    base = name if name in scenario_names() else BUILT_IN_PAPER
    theirs = _settings(load_scenario(base).to_toml())
    for key, value in (estimator or {}).items():
        before = ours.get(key) or _Stated(None, theirs[key].meaning if key in theirs else "")
        if value != before.value:
            when = f"when the record was made: {_shown(before.value)}"
            ours[key] = _Stated(value, f"{before.meaning}; {when}" if before.meaning else when)
    absent = _Stated(None, "")
    changed = []
    for key in dict.fromkeys((*ours, *theirs)):
        one = ours.get(key, absent)
        other = theirs.get(key, absent)
        if one.value != other.value:
            changed.append(
                Setting(key, _shown(one.value), _shown(other.value), one.meaning or other.meaning)
            )
    return base, changed


class _Stated(NamedTuple):
    """A value of a scenario, None where it states none, and what it means."""

    value: Any
    meaning: str


def _settings(text: str) -> dict[str, _Stated]:
    """The settings of a scenario as `to_toml` writes it, by dotted key."""
    found = {}
    section = ""
    for line in text.splitlines():
        if line.startswith("["):
            section = line.partition("]")[0].strip("[ ") + "."
        elif " = " in line:
            key, _, rest = line.partition(" = ")
            meaning = rest.rpartition(" # ")[2] if " # " in rest else ""
            found[section + key.strip()] = _Stated(
                tomllib.loads(f"value = {rest}")["value"], meaning.strip()
            )
    return found


def _shown(value: Any) -> str:
    """A value as a table shows it; a dash where there is none."""
    if value is None:
        return "-"
    return str(value).lower() if isinstance(value, bool) else str(value)
