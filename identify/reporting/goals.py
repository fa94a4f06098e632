"""The goals of a run and whether its result meets them: accuracy and honesty, the same on every machine."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from identify.estimation.explanation import SIGNIFICANT, SUSPICIOUS
from identify.files.run_folder import rms_row

VALIDATION_UM, VALIDATION_URAD = 2.0, 10.0
SENSOR_UM, SENSOR_URAD = 20.0, 100.0
PARAMETER_FRACTION, PARAMETER_STDS = 0.05, 3.0


@dataclass(frozen=True)
class Goal:
    """One goal: ``value`` against ``limit`` in ``unit``; ``relation`` is ``<=`` or ``>=``."""

    name: str
    value: float
    relation: str
    limit: float
    unit: str
    detail: str = ""

    @property
    def passed(self) -> bool:
        """Whether the value meets the limit; a value that is NaN does not."""
        return self.value <= self.limit if self.relation == "<=" else self.value >= self.limit


def check_goals(result: dict[str, Any]) -> list[Goal]:
    """The goals that the parts of a result allow to judge; accuracy is that of the worst axis of the worst run."""
    parts = (_validation, _sensor, explanation_goals, _parameters)
    return [goal for part in parts for goal in part(result)]


def explanation_goals(result: dict[str, Any]) -> list[Goal]:
    """Whether the model explains the record: what it leaves is no larger than noise alone makes it, and is white."""
    found, goals = result.get("identification", {}), []
    if "noise_ratio_std" in found:
        keys = ("noise_ratio", "expected_noise_ratio", "noise_ratio_std")
        ratio, expected, std = (math.nan if found[key] is None else found[key] for key in keys)
        text = f"residuals {ratio:.3f} times the noise variance, noise alone gives {expected:.3f} ± {std:.3f}"
        goals.append(Goal("misfit of the record", (ratio - expected) / std, "<=", SIGNIFICANT, "std", text))
    if "whiteness" in found:
        chance = found["whiteness"]["p_value"]
        text = "probability that chance correlates the residuals as much, of the model driven by the logged commands"
        goals.append(Goal("white residuals", math.nan if chance is None else chance, ">=", SUSPICIOUS, "", text))
    return goals


def _validation(result: dict[str, Any]) -> list[Goal]:
    rows = np.array([rms_row(run["true"]) for run in result.get("validation", [])])
    if not len(rows):
        return []
    text = f"identified model against the true plant, {len(rows)} unseen trajectories"
    return [
        Goal("unseen position", float(rows[:, :3].max()), "<=", VALIDATION_UM, "um", text),
        Goal("unseen orientation", float(rows[:, 3:].max()), "<=", VALIDATION_URAD, "urad", text),
    ]


def _sensor(result: dict[str, Any]) -> list[Goal]:
    sensor = result.get("sensor")
    if not sensor:
        return []
    row = np.array(rms_row(sensor))
    text = f"measured pose against truth, {sensor['frames']} frames"
    return [
        Goal("sensor position", float(row[:3].max()), "<=", SENSOR_UM, "um", text),
        Goal("sensor orientation", float(row[3:].max()), "<=", SENSOR_URAD, "urad", text),
        Goal("lost frames", float(sensor["lost_frames"]), "<=", 0.0, "", text),
    ]


def _parameters(result: dict[str, Any]) -> list[Goal]:
    parameters = result.get("identification", {}).get("parameters", {})
    judged = {name: p for name, p in parameters.items() if is_friction_or_pid(name)}
    if not judged:
        return []
    outside = [name for name, p in judged.items() if not within_tolerance(p)]
    text = f"of {len(judged)} within 5 % of truth or 3 std" + (f"; outside: {', '.join(outside)}" if outside else "")
    return [Goal("friction and PID outside", float(len(outside)), "<=", 0.0, "", text)]


def is_friction_or_pid(name: str) -> bool:
    """Whether the goals judge the parameter: friction of the joints and gains of the joint controller."""
    return name.startswith("joint_pid.") or name.endswith((".coulomb", ".viscous"))


def within_tolerance(parameter: dict[str, Any]) -> bool:
    """Whether an estimate lies within 5 % of the truth or within 3 of its reported standard deviations."""
    if parameter["estimate"] is None or parameter["true"] is None:
        return False
    error, std = abs(parameter["estimate"] - parameter["true"]), parameter["std"]
    return error <= PARAMETER_FRACTION * abs(parameter["true"]) or (std is not None and error <= PARAMETER_STDS * std)
