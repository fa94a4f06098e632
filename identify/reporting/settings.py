"""The settings of a run as its report tells them: what differs from the built-in scenario that it began with."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from identify.scenario import load_scenario, scenario_names
from identify.scenario.settings_file import toml_value

BUILT_IN_PAPER = "paper"
"""The scenario whose settings are the paper's, and with which those without a built-in name are compared."""


class Setting(NamedTuple):
    """A setting of a run by its dotted key, as the scenario has it and as the built-in one; empty where it has none."""

    key: str
    value: str
    built_in: str
    meaning: str


def changed_settings(recorded: str, estimator: Mapping[str, Any] | None = None) -> tuple[str, list[Setting]]:
    """The built-in scenario that a recorded one (TOML) is to be compared with, by name, and the settings that differ.

    estimator: settings of the identification by dotted key, where they may have been changed after the record was made.
    """
    ours = _settings(recorded)
    name = ours.get("name", ("", ""))[0].strip('"')
    base = name if name in scenario_names() else BUILT_IN_PAPER
    theirs = _settings(load_scenario(base).to_toml())
    for key, value in (estimator or {}).items():
        recorded_value, meaning = ours.get(key) or ("", theirs.get(key, ("", ""))[1])
        if toml_value(value) != recorded_value:
            when = f"when the record was made: {recorded_value or 'not set'}"
            ours[key] = (toml_value(value), f"{meaning}; {when}" if meaning else when)
    return base, [
        Setting(key, ours.get(key, ("", ""))[0], theirs.get(key, ("", ""))[0], (ours.get(key) or theirs[key])[1])
        for key in (*ours, *(key for key in theirs if key not in ours))
        if ours.get(key, ("",))[0] != theirs.get(key, ("",))[0]
    ]


def _settings(text: str) -> dict[str, tuple[str, str]]:
    """Value and meaning of each setting of a scenario as `to_toml` writes it, by dotted key."""
    found, section = {}, ""
    for line in text.splitlines():
        if line.startswith("["):
            section = line.partition("]")[0].strip("[ ") + "."
        elif " = " in line:
            key, _, rest = line.partition(" = ")
            value, _, meaning = rest.partition(" # ")
            found[section + key.strip()] = (value.strip(), meaning.strip())
    return found
