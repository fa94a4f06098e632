"""Goals of a run, and the check whether its result meets them.

The limits on accuracy, and on the correctness of stated uncertainties, are the same on every
machine.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from identify.arrays import Array
from identify.estimation.explanation import MISFIT, SIGNIFICANT, SUSPICIOUS
from identify.files.run_folder import predicted_row, rms_row
from identify.loop_parameters import is_gain
from identify.record.stored_common_errors import kind_of

# Limits of the goals: RMS in µm and µrad, a fraction of the truth, and standard deviations.
VALIDATION_UM = 2.0
VALIDATION_URAD = 10.0
SENSOR_UM = 20.0
SENSOR_URAD = 100.0
PARAMETER_FRACTION = 0.05
PARAMETER_STDS = 3.0
# Number of standard deviations up to which a declared error does not count as a missed goal.
DECLARED_STDS = 3.0
# Kinds of common errors that the cameras declare, beside those of teaching.
OF_CAMERAS = ("rig", "exposure")
TEACHING = "teaching"  # kind of the errors of teaching, too small to count as declared errors

# Words for kinds of common errors whose names need an explanation.
KINDS = {
    "rig": "cameras",
    "teaching": "taught frames",
    "exposure": "delay between exposures",
    "zeros": "joint zeros",
    "centres": "centres of mass",
    "products": "products of inertia",
    "passive_friction": "friction of passive joints",
}

# Names of the goals.
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
    the goal. ``widened`` says what the limit is if it is not the usual one, and otherwise is empty.
    """

    name: str
    value: float
    relation: str
    limit: float
    unit: str
    detail: str = ""
    widened: str = ""

    @property
    def passed(self) -> bool:
        """True if the value meets the limit. A value that is NaN does not."""
        return self.value <= self.limit if self.relation == "<=" else self.value >= self.limit


def check_goals(result: dict[str, Any]) -> list[Goal]:
    """Judge every goal for which the result has the necessary entries.

    An accuracy is that of the worst axis, and on validation motions that of the worst run.
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
        # Residuals of a model that the logged commands drive are the noise itself.
        if expected > 1.0:
            text += ", more than 1 as it also moves the robot through the servo"
        goals.append(Goal(RESIDUALS, ratio, "<=", expected + SIGNIFICANT * std, "", text))
    if "whiteness" in identification:
        chance = identification["whiteness"]["p_value"]
        percent = math.nan if chance is None else 100 * chance
        text = "probability that noise alone makes residuals as correlated from frame to frame"
        goals.append(Goal(CHANCE, percent, ">=", 100 * SUSPICIOUS, "%", text))
    return goals


@dataclass(frozen=True)
class Unseen:
    """Errors of the model on validation runs.

    rows (n, 6): RMS of each run, µm and µrad. predicted (n, 6): their stated standard deviations.
    estimated: words for the declared errors beyond teaching, such as those of cameras or of centres
    of mass. If there are such errors and estimates of them, `rows` are the errors of the poses that
    the model predicts together with these estimates.
    """

    rows: Array
    predicted: Array
    estimated: str

    @property
    def what(self) -> str:
        """Words for the model whose errors these are."""
        return f"identified model with {self.estimated}" if self.estimated else "identified model"


def unseen(result: dict[str, Any]) -> Unseen:
    """Return the errors of the model on the validation runs against the true robot."""
    runs = result.get("validation", [])
    names = result["identification"].get("nuisance_prior_std", {})
    declared = [kind for kind in dict.fromkeys(map(kind_of, names)) if kind != TEACHING]
    predicts = all("position_rms_um" in run.get("predicted", {}) for run in runs)
    # The model alone lacks the declared errors, which move the robot: the servo follows an error
    # of the cameras, and an error of a centre of mass changes the torques.
    estimated = ""
    if predicts and declared:
        words = [KINDS.get(kind, kind) for kind in declared]
        if set(declared) <= set(OF_CAMERAS):
            words = ["the cameras"]
        listed = " and ".join(filter(None, [", ".join(words[:-1]), words[-1]]))
        estimated = f"the estimated errors of {listed}"
    rows = [rms_row(run["predicted"] if estimated else run["true"]) for run in runs]
    return Unseen(np.array(rows), np.array([predicted_row(run) for run in runs]), estimated)


def _validation(result: dict[str, Any]) -> list[Goal]:
    if not result.get("validation"):
        return []
    # The maximum is over axes and runs.
    found = unseen(result)
    text = (
        f"{found.what} against the true robot, RMS of the worst axis in the worst of "
        f"{len(found.rows)} validation runs"
    )
    declared = DECLARED_STDS * found.predicted if found.estimated else np.zeros((1, 6))
    goals = []
    for name, part, limit, unit in (
        (UNSEEN_POSITION, slice(3), VALIDATION_UM, "µm"),
        (UNSEEN_ORIENTATION, slice(3, 6), VALIDATION_URAD, "µrad"),
    ):
        largest = float(found.rows[:, part].max())
        goals.append(_within(name, largest, limit, declared[:, part], unit, text, "the prediction"))
    return goals


def _sensor(result: dict[str, Any]) -> list[Goal]:
    sensor = result.get("sensor")
    if not sensor:
        return []
    row = np.array(rms_row(sensor))
    # Results of older versions do not have the declared errors.
    known = "position_common_um" in sensor
    common = np.array(rms_row(sensor, "common")) if known else np.zeros(6)
    text = f"measured against true pose, RMS of the worst axis over {sensor['frames']} frames"
    lost = f"of {sensor['frames']}: the cameras did not find the platform"
    goals = []
    for name, part, limit, unit in (
        (SENSOR_POSITION, slice(3), SENSOR_UM, "µm"),
        (SENSOR_ORIENTATION, slice(3, 6), SENSOR_URAD, "µrad"),
    ):
        declared = DECLARED_STDS * common[part]
        largest = float(row[part].max())
        what = "the declared camera errors"
        goals.append(_within(name, largest, limit, declared, unit, text, what))
    return [*goals, Goal(LOST, float(sensor["lost_frames"]), "<=", 0.0, "", lost)]


def _within(
    name: str, value: float, limit: float, declared: Array, unit: str, text: str, what: str
) -> Goal:
    """Return a goal whose limit is raised to the largest declared error, if that is larger.

    declared: three standard deviations of declared errors. what: words for these errors.
    """
    widest = max(limit, float(np.nanmax(declared, initial=0.0)))
    said = f"the limit is three standard deviations of {what}, {limit:g} {unit} without them"
    if widest == limit:
        return Goal(name, value, "<=", limit, unit, text)
    return Goal(name, value, "<=", widest, unit, f"{text}; {said}", said)


def _parameters(result: dict[str, Any]) -> list[Goal]:
    parameters = result.get("identification", {}).get("parameters", {})
    judged = _judged(parameters)
    if not judged:
        return []
    outside = far_off(parameters)
    text = (
        f"of {len(judged)}: estimates off the truth by more than {100 * PARAMETER_FRACTION:g} % "
        f"and more than {PARAMETER_STDS:g} standard deviations"
    )
    text += f", {', '.join(outside)}" if outside else ""
    return [Goal(FAR_OFF, float(len(outside)), "<=", 0.0, "", text)]


def far_off(parameters: Mapping[str, dict[str, Any]]) -> list[str]:
    """Return the names of frictions and gains that are not `within_tolerance` of the truth."""
    # A small friction may be off by more than 5 %, if that is within its stated uncertainty.
    return [name for name, p in _judged(parameters).items() if not within_tolerance(p)]


def _judged(parameters: Mapping[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the entries of frictions and gains whose truth is known."""
    return {
        name: p
        for name, p in parameters.items()
        if is_friction_or_pid(name) and p["true"] is not None
    }


def is_friction_or_pid(name: str) -> bool:
    """Tell whether a parameter is a joint friction or a gain of the joint controller."""
    return is_gain(name) or name.endswith((".coulomb", ".viscous"))


def within_tolerance(parameter: dict[str, Any]) -> bool:
    """Tell whether an estimate is known, and within 5 % or 3 standard deviations of the truth."""
    if parameter["estimate"] is None or parameter["true"] is None:
        return False
    error = abs(parameter["estimate"] - parameter["true"])
    std = parameter["std"]
    return error <= PARAMETER_FRACTION * abs(parameter["true"]) or (
        std is not None and error <= PARAMETER_STDS * std
    )
