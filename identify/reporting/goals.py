"""Goals of a run, and the check whether its result meets them.

The limits on accuracy, and on the correctness of stated uncertainties, are the same on every
machine.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from identify.estimation.explanation import MISFIT, SIGNIFICANT, SUSPICIOUS
from identify.files.run_folder import rms_row
from identify.loop_parameters import is_gain

# Limits of the goals: RMS in µm and µrad, a share of the truth, and standard deviations.
VALIDATION_UM = 2.0
VALIDATION_URAD = 10.0
SENSOR_UM = 20.0
SENSOR_URAD = 100.0
PARAMETER_FRACTION = 0.05
PARAMETER_STDS = 3.0

UNSEEN_POSITION = "validation motion, position"
UNSEEN_ORIENTATION = "validation motion, orientation"
SENSOR_POSITION = "cameras, position"
SENSOR_ORIENTATION = "cameras, orientation"
LOST = "lost frames"
RESIDUALS = "residual variance / noise variance"
CHANCE = "p value of the residuals"
FAR_OFF = "friction and gains far off"


@dataclass(frozen=True)
class Goal:
    """Goal of a run: a value that must keep a limit, both in ``unit``.

    ``relation`` is ``<=`` or ``>=``. ``detail`` explains the value in words that follow the name of
    the goal.
    """

    name: str
    value: float
    relation: str
    limit: float
    unit: str
    detail: str = ""

    @property
    def passed(self) -> bool:
        """True if the value meets the limit. A value that is NaN does not."""
        return self.value <= self.limit if self.relation == "<=" else self.value >= self.limit


def check_goals(result: dict[str, Any]) -> list[Goal]:
    """Judge every goal for which the result has the necessary entries.

    The accuracy of the worst axis in the worst run counts.
    """
    parts = (_validation, _sensor, explanation_goals, _parameters)
    return [goal for part in parts for goal in part(result)]


def explanation_goals(result: dict[str, Any]) -> list[Goal]:
    """Judge whether the model explains the record.

    It does if the residuals are no larger than noise alone makes them, and are white.
    """
    identification = result.get("identification", {})
    goals = []
    if "noise_ratio_std" in identification:
        ratio, expected, std = (
            math.nan if identification[key] is None else identification[key] for key in MISFIT
        )
        text = (
            "mean square of measured minus identified pose, over the variance that the cameras "
            f"state; noise alone gives {expected:.3f} ± {std:.3f}"
        )
        goals.append(Goal(RESIDUALS, ratio, "<=", expected + SIGNIFICANT * std, "", text))
    if "whiteness" in identification:
        chance = identification["whiteness"]["p_value"]
        percent = math.nan if chance is None else 100 * chance
        text = "probability that noise alone makes residuals as correlated from frame to frame"
        goals.append(Goal(CHANCE, percent, ">=", 100 * SUSPICIOUS, "%", text))
    return goals


def _validation(result: dict[str, Any]) -> list[Goal]:
    # One row (6,) per run, in µm and µrad, so that the maximum is over axes and runs.
    rows = np.array([rms_row(run["true"]) for run in result.get("validation", [])])
    if not len(rows):
        return []
    text = (
        "identified model against the true robot, RMS of the worst axis in the worst of "
        f"{len(rows)} validation runs"
    )
    return [
        Goal(UNSEEN_POSITION, float(rows[:, :3].max()), "<=", VALIDATION_UM, "µm", text),
        Goal(UNSEEN_ORIENTATION, float(rows[:, 3:].max()), "<=", VALIDATION_URAD, "µrad", text),
    ]


def _sensor(result: dict[str, Any]) -> list[Goal]:
    sensor = result.get("sensor")
    if not sensor:
        return []
    row = np.array(rms_row(sensor))
    text = f"measured against true pose, RMS of the worst axis over {sensor['frames']} frames"
    lost = f"of {sensor['frames']}: the cameras did not find the platform"
    return [
        Goal(SENSOR_POSITION, float(row[:3].max()), "<=", SENSOR_UM, "µm", text),
        Goal(SENSOR_ORIENTATION, float(row[3:].max()), "<=", SENSOR_URAD, "µrad", text),
        Goal(LOST, float(sensor["lost_frames"]), "<=", 0.0, "", lost),
    ]


def _parameters(result: dict[str, Any]) -> list[Goal]:
    parameters = result.get("identification", {}).get("parameters", {})
    judged = {
        name: p
        for name, p in parameters.items()
        if is_friction_or_pid(name) and p["true"] is not None
    }
    if not judged:
        return []
    # A small friction may be off by more than 5 %, if that is within its stated uncertainty.
    outside = [name for name, p in judged.items() if not within_tolerance(p)]
    text = (
        f"of {len(judged)}: estimates off the truth by more than 5 % and more than 3 standard "
        "deviations"
    )
    text += f", {', '.join(outside)}" if outside else ""
    return [Goal(FAR_OFF, float(len(outside)), "<=", 0.0, "", text)]


def is_friction_or_pid(name: str) -> bool:
    """Tell whether a parameter is a joint friction or a gain of the joint controller."""
    return is_gain(name) or name.endswith((".coulomb", ".viscous"))


def within_tolerance(parameter: dict[str, Any]) -> bool:
    """Tell whether an estimate is within 5 % of the truth or within 3 standard deviations of it."""
    if parameter["estimate"] is None or parameter["true"] is None:
        return False
    error = abs(parameter["estimate"] - parameter["true"])
    std = parameter["std"]
    return error <= PARAMETER_FRACTION * abs(parameter["true"]) or (
        std is not None and error <= PARAMETER_STDS * std
    )
