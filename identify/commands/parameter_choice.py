"""Dynamic parameters named on the command line: a set of the robot file, or the estimates in a run's result.json."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dynamics import Robot
from dynamics.errors import ParameterError
from dynamics.parameters import PARAMETER_NAMES, check_parameters
from identify.arrays import Array
from identify.errors import RecordError, ScenarioError
from identify.files.result_file import load_result

NOMINAL = "initial"


@dataclass(frozen=True)
class ParameterChoice:
    """Dynamic parameters (64,) [SI] and, in words, where they come from."""

    values: Array
    source: str


def choose_parameters(robot: Robot, choice: str | None = None) -> ParameterChoice:
    """Parameters by the name of a set, or the estimates of a result file; the nominal set when nothing is named.

    Raises:
        ScenarioError: neither a set of the robot (with the valid names) nor a file.
        RecordError: a result file without a complete set of estimates, or one that is no number in its range.
    """
    name = NOMINAL if choice is None else choice
    if name in robot.parameter_sets:
        return ParameterChoice(robot.parameter_sets[name].dynamic, f"parameter set {name}")
    if not Path(name).is_file():
        valid = ", ".join(sorted(robot.parameter_sets))
        raise ScenarioError(f"{name!r} is neither a parameter set of robot {robot.name} ({valid}) nor a result.json")
    return ParameterChoice(_estimates(name, load_result(name)), f"estimates of {name}")


def _estimates(path: str, result: dict[str, Any]) -> Array:
    entries = result.get("identification")
    entries = entries.get("parameters") if isinstance(entries, dict) else None
    if not isinstance(entries, dict):
        raise RecordError(f"{path} has no identification.parameters; write it with: cmmsim identify")
    found = {name: _estimate(entries.get(name)) for name in PARAMETER_NAMES}
    absent = [name for name, value in found.items() if value is None]
    if absent:
        more = f" and {len(absent) - 3} more" if len(absent) > 3 else ""
        raise RecordError(f"{path} has no estimate of {', '.join(absent[:3])}{more}")
    for name, value in found.items():
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not (number and abs(value) <= sys.float_info.max):
            raise RecordError(f"{path}: estimate of {name} is {json.dumps(value):.60}, must be a finite number")
    try:
        return check_parameters(list(found.values()))
    except ParameterError as error:
        raise RecordError(f"{path}: {error}") from None


def _estimate(entry: Any) -> Any:
    return entry.get("estimate") if isinstance(entry, dict) else None
