"""Settings of a run, compared with the settings of the built-in scenario on which it is based."""

import tomllib
from collections.abc import Mapping
from typing import Any, NamedTuple

from identify.scenario import load_scenario, scenario_names

# Built-in scenario of the paper, with which scenarios without a built-in name are compared.
BUILT_IN_PAPER = "paper"


class Setting(NamedTuple):
    """Setting of a run by its dotted key, with its value and the value in the built-in scenario.

    A value is a dash if the scenario does not have the setting.
    """

    key: str
    value: str
    built_in: str
    meaning: str


def changed_settings(
    recorded: str, estimator: Mapping[str, Any] | None = None
) -> tuple[str, list[Setting]]:
    """Return the name of the built-in scenario for a comparison, and the settings that differ.

    recorded   Scenario of the record, as TOML.
    estimator  Settings of the identification by dotted key. A user can change them after the record
               was made, so that they replace those of the record.
    """
    base, ours, theirs = _compared(recorded)
    ours |= _set_anew(ours, theirs, estimator)
    absent = _Stated(None, "")
    changed = []
    # A set would lose the order of the file.
    for key in dict.fromkeys((*ours, *theirs)):
        one = ours.get(key, absent)
        other = theirs.get(key, absent)
        if one.value != other.value:
            changed.append(
                Setting(key, _shown(one.value), _shown(other.value), one.meaning or other.meaning)
            )
    return base, changed


def settings_set_anew(
    recorded: str, estimator: Mapping[str, Any] | None
) -> list[tuple[str, str, str]]:
    """Return key, value and meaning of each setting that was changed after the record was made.

    The arguments are those of `changed_settings`.
    """
    _, ours, theirs = _compared(recorded)
    anew = _set_anew(ours, theirs, estimator)
    return [(key, _shown(one.value), one.meaning) for key, one in anew.items()]


class _Stated(NamedTuple):
    """Value of a setting, or None if the scenario lacks it, and the meaning of the setting."""

    value: Any
    meaning: str


def _compared(recorded: str) -> tuple[str, dict[str, _Stated], dict[str, _Stated]]:
    """Return the name of the built-in scenario for a recorded one, and the settings of both.

    The settings of the recorded scenario come first.
    """
    ours = _settings(recorded)
    name = ours["name"].value if "name" in ours else ""
    # A user's own scenario may have any name.
    base = name if name in scenario_names() else BUILT_IN_PAPER
    return base, ours, _settings(load_scenario(base).to_toml())


def _set_anew(
    ours: Mapping[str, _Stated], theirs: Mapping[str, _Stated], estimator: Mapping[str, Any] | None
) -> dict[str, _Stated]:
    """Return the settings of the identification that differ from those of the record, `ours`.

    Their meanings say what the record had.
    """
    anew = {}
    for key, value in (estimator or {}).items():
        before = ours.get(key) or _Stated(None, theirs[key].meaning if key in theirs else "")
        if value != before.value:
            when = f"when the record was made: {_shown(before.value)}"
            anew[key] = _Stated(value, f"{before.meaning}; {when}" if before.meaning else when)
    return anew


def _settings(text: str) -> dict[str, _Stated]:
    """Return the settings of a scenario by dotted key, from the text that `to_toml` writes."""
    found = {}
    section = ""
    for line in text.splitlines():
        if line.startswith("["):
            section = line.partition("]")[0].strip("[ ") + "."
        elif " = " in line and not line.startswith("#"):
            key, _, rest = line.partition(" = ")
            # The comment after a value is the description of its setting.
            meaning = rest.rpartition(" # ")[2] if " # " in rest else ""
            found[section + key.strip()] = _Stated(
                tomllib.loads(f"value = {rest}")["value"], meaning.strip()
            )
    return found


def _shown(value: Any) -> str:
    """Format a value for a table, with a dash if there is none."""
    if value is None:
        return "-"
    return str(value).lower() if isinstance(value, bool) else str(value)
