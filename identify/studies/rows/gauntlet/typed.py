"""Remedies that are typed: the settings in the lines of a finding."""

import re
import tomllib
from typing import Any

from identify.diagnosis.diagnosis import Finding
from identify.studies.rows.gauntlet.trouble import Remedied

SETTING = re.compile(r"--set (?:'([^']+)'|(\S+))")
"""Setting in a remedy, as it would be typed, with or without quotes."""


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
            settings[key] = _value(value)
    return Remedied(settings, mended=not settings)


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text.rstrip(',;')}")["value"]
    except tomllib.TOMLDecodeError:
        return text.rstrip(",;")
