"""Verdict on a run in whole sentences.

It says what is right, what is not, what may be the cause, and what cannot be known. The model is
called wrong only where the cameras cannot be the cause. For that the truth must be known, and the
cameras' errors must be no larger than the noise that they state, without dependence from frame to
frame.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from identify.arrays import Array
from identify.errors import EstimationError
from identify.estimation.explanation import whiteness
from identify.experiment.truth import true_poses
from identify.files.run_folder import rms_row
from identify.record.recording import poses
from identify.reporting import goals
from identify.reporting.goals import check_goals, explanation_goals
from identify.reporting.number_format import number, share

CAMERAS_MISS = 1.5
"""Limit of the mean squared error of the measured poses, in units of the stated covariance.

Beyond it, the cameras may be the cause.
"""


@dataclass(frozen=True)
class KeyNumber:
    """Number of the first look, with its unit and its meaning."""

    value: str
    unit: str
    meaning: str


@dataclass(frozen=True)
class Verdict:
    """Verdict on a run.

    ``good`` is true if nothing speaks against the result. The sentences are the reasons for the
    headline.
    """

    good: bool
    headline: str
    sentences: tuple[str, ...]


def cameras_acquitted(record: xr.Dataset, truth: xr.Dataset | None) -> bool | None:
    """Tell whether the cameras' errors are only the noise that they state.

    None if no truth is known, or if the record is too short to judge.
    """
    if truth is None:
        return None
    ok = record["measured_ok"].values.astype(bool)
    errors = true_poses(truth) - poses(record, "measured")
    roots = np.linalg.cholesky(record["measured_covariance"].values[ok])
    # Whitened errors have unit covariance where the cameras state their noise correctly.
    white = np.full_like(errors, np.nan)
    white[ok] = np.linalg.solve(roots, errors[ok][..., None])[..., 0]
    try:
        coloured = whiteness(white, ok).suspicious
    except EstimationError:
        return None
    return bool(np.mean(white[ok] ** 2) < CAMERAS_MISS and not coloured)


def verdict(result: dict[str, Any], acquitted: bool | None) -> Verdict:
    """Return the verdict on a result.

    ``acquitted`` is true if the cameras cannot be the cause of the residuals, as
    `cameras_acquitted` returns it.
    """
    every = check_goals(result)
    unseen = bool(result.get("validation"))
    missed = [goal for goal in every if not goal.passed]
    explained = all(goal.passed for goal in explanation_goals(result))
    sentences = [_residual_sentence(result, explained, acquitted)]
    if unseen:
        # What weighs most stands first: a model that does not explain its record is no model.
        sentences.insert(0 if explained else 1, _unseen_sentence(result, explained))
    sentences += [
        f"Not met: {sentence(goal)}"
        for goal in missed
        if goal.name not in (goals.RESIDUALS, goals.CHANCE)
    ]
    # Without unseen runs no truth is known, and only the residuals can be judged.
    if not unseen:
        headline = EXPLAINED if explained else _blame(None, result)
        return Verdict(explained, headline, (*sentences, NO_TRUTH))
    if not missed:
        return Verdict(True, "The identified model moves as the true robot does.", tuple(sentences))
    if not explained:
        return Verdict(False, _blame(acquitted, result), tuple(sentences))
    counted = f"{len(missed)} of {len(every)} goals {'is' if len(missed) == 1 else 'are'} not met."
    return Verdict(False, f"The model explains the record, but {counted}", tuple(sentences))


NO_TRUTH = (
    "No truth is known of this record. So nobody can tell here how far the measured poses, the "
    "estimates and the model's predictions are from the real robot: an error that the cameras "
    "repeat in every frame, and an error of the model that the parameters take up, leave no trace "
    "in the residuals."
)


def sentence(goal: goals.Goal) -> str:
    """Return a sentence with the value and the limit of a goal."""
    relation = "at most" if goal.relation == "<=" else "at least"
    limit = f"{relation} {number(goal.limit)} {goal.unit}".strip()
    value = f"{number(goal.value)} {goal.unit}".strip()
    return f"{goal.name} {value} where {limit} is wanted ({goal.detail})."


def key_numbers(result: dict[str, Any]) -> list[KeyNumber]:
    """Return three numbers for the first look."""
    identification = result["identification"]
    parameters = identification["parameters"]
    validation = result.get("validation")
    known = sum(bool(p["identifiable"]) for p in parameters.values())
    meaning = (
        "parameters are identified, each with an interval."
        if known
        else "parameters are identified."
    )
    shown = KeyNumber(f"{known}", f"of {len(parameters)}", meaning)
    if validation:
        rows = np.array([rms_row(run["true"])[:3] for run in validation])
        worst = KeyNumber(
            number(float(rows.max()), 2),
            "µm",
            "from the true robot: the identified model, on motion that it never saw.",
        )
        measured = max(rms_row(result["sensor"])[:3])
        seen = KeyNumber(
            number(measured, 2), "µm", "from the true pose: one pose as the cameras measure it."
        )
        return [worst, seen, shown]
    before = max(rms_row(result.get("before"))[:3])
    after = max(rms_row(result.get("after"))[:3])
    left = KeyNumber(
        number(after, 2), "µm", "between the identified model and the measured poses of the record."
    )
    if np.isfinite(before):
        meaning = "between the starting model and the same poses."
        began = KeyNumber(number(before, 2), "µm", meaning)
    else:
        began = KeyNumber("–", "", "The starting model is unstable.")
    return [left, began, shown]


def _unseen_sentence(result: dict[str, Any], explained: bool) -> str:
    """Tell how far both models are from the true robot on unseen trajectories."""
    runs = result["validation"]
    identified = np.array([rms_row(run.get("true")) for run in runs])
    started = np.array([rms_row(run.get("initial_true")) for run in runs])
    turns = bool((identified[:, 3:] != 0).any())
    text = f"On {len(runs)} trajectories that it never saw, the identified model "
    if np.isfinite(identified).all():
        text += (
            f"stays within {_distance(identified, turns)} of the true robot (RMS of the worst axis)"
        )
    else:
        text += "is unstable"
    if not all("initial_true" in run for run in runs):
        return f"{text}."
    if np.isfinite(started).all():
        return f"{text}; the model that it started from misses by {_distance(started, turns)}."
    return f"{text}; the model that it started from is unstable."


def _distance(rows: Array, turns: bool) -> str:
    """Format the largest of errors (n, 6) [µm, µrad], without the angles if none turns."""
    position = float(rows[:, :3].max())
    orientation = float(rows[:, 3:].max())
    return f"{number(position, 2)} µm" + (f" and {number(orientation, 2)} µrad" if turns else "")


def _residual_sentence(result: dict[str, Any], explained: bool, acquitted: bool | None) -> str:
    """Tell whether the residuals are only noise and, where they are not, what may be the cause."""
    found = {goal.name: goal for goal in explanation_goals(result)}
    if not found:
        return "How well the model explains the record was not tested."
    parts = []
    if goals.RESIDUALS in found:
        size = number(found[goals.RESIDUALS].value, 3)
        limit = number(found[goals.RESIDUALS].limit, 3)
        parts.append(
            f"its mean square is {size} times what they state, where noise alone makes up to "
            f"{limit}"
        )
    if goals.CHANCE in found:
        chance = share(found[goals.CHANCE].value / 100)
        parts.append(f"noise alone would look as regular in {chance} of cases")
    said = "; ".join(parts)
    if explained:
        return f"What it leaves of the record is the cameras' noise: {said}."
    return (
        f"What it leaves of the record is more than the cameras' noise: {said}. "
        f"{_cause(acquitted, result)}"
    )


def _drift_warning(result: dict[str, Any]) -> str | None:
    """Return the warning of the run's drift watch.

    None where the cameras still fitted their calibration, or nobody watched.
    """
    return (result.get("drift_watch") or {}).get("warning")


def _cause(acquitted: bool | None, result: dict[str, Any]) -> str:
    # Cameras that have moved spoil the measurement, whatever the model is.
    if warning := _drift_warning(result):
        return (
            f"{warning[0].upper()}{warning[1:]}. Calibrate them again; whether the model is "
            "right cannot be told."
        )
    if acquitted:
        return (
            "The cameras are not the cause, for they miss the truth only by the noise that they "
            "state: the model's geometry, joints or friction are not those of the robot."
        )
    if acquitted is None:
        return (
            "The cause may be the model, or cameras with errors that they do not state; the "
            "record alone cannot tell."
        )
    return (
        "The cameras miss the truth by more than they state, or not by chance: they may be the "
        "cause, or the model."
    )


EXPLAINED = "The identified model explains the record to within the cameras' noise."


def _blame(acquitted: bool | None, result: dict[str, Any]) -> str:
    if _drift_warning(result):
        return "Model and measurement disagree, and the cameras are not as they were calibrated."
    if acquitted:
        return "The model is not that of the robot."
    return "Model and measurement disagree, by an error of the model or of the cameras."
