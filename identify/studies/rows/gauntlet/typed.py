"""Remedies that are typed: the settings in the lines of a finding."""

import re
import tomllib
from typing import Any

from identify.diagnosis.diagnosis import Finding
from identify.studies.rows.gauntlet.trouble import Remedied

SETTING = re.compile(r"--set (?:'([^']+)'|(\S+))")
"""Setting in a remedy, as it would be typed, with or without quotes."""

STATED = re.compile(r"\b([a-z_]+\.\w+) = ([-+.\de]*\d)")
"""Setting in a remedy that is stated with the record."""


def typed(finding: Finding) -> Remedied:
    """Set what the remedies of a finding say. Where one line names an alternative, the first.

    A later remedy replaces an earlier one. A finding without settings names the trouble only as one
    that cannot be told from its own cause, and the trouble is mended.
    """
    settings: dict[str, Any] = {}
    for remedy in finding.remedies:
        line, *_ = remedy.partition(", or ")
        for quoted, plain in SETTING.findall(line):
            key, _, value = (quoted or plain).partition("=")
            settings = settings | with_table(settings, key, _value(value))
    return Remedied(settings, mended=not settings)


def stated(finding: Finding) -> Remedied:
    """Set what the remedies of a finding want to have stated with the record."""
    return Remedied(
        {key: float(value) for text in finding.remedies for key, value in STATED.findall(text)}
    )


def with_table(settings: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    """Return one setting. A table is merged with that of the same key among other settings."""
    earlier = settings.get(key)
    if isinstance(value, dict) and isinstance(earlier, dict):
        return {key: earlier | value}
    return {key: value}


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text.rstrip(',;')}")["value"]
    except tomllib.TOMLDecodeError:
        return text.rstrip(",;")
