"""Verdict on a run in whole sentences.

The verdict states what is right, what is not, the possible causes, and what cannot be known. The
model is called wrong only if the cameras cannot be the cause. For this, the truth must be known,
and the errors of the cameras must agree with their stated noise and be independent from frame to
frame.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from cmmsim.uncertainty.drift_evidence import MOSTLY_MOVED
from identify.arrays import Array
from identify.errors import EstimationError
from identify.estimation.explanation import whiteness
from identify.experiment.truth import true_poses
from identify.files.run_folder import rms_row
from identify.record.recording import poses
from identify.record.stored_common_errors import Marginal
from identify.reporting import goals
from identify.reporting.goals import check_goals, explanation_goals
from identify.reporting.number_format import number, share
from identify.reporting.run_result import common_modes

# Limit of the mean squared error of the measured poses, relative to the stated covariance. Beyond
# the limit, the cameras can be the cause of the model's residuals.
CAMERAS_MISS = 1.5


@dataclass(frozen=True)
class KeyNumber:
    """Number of the summary, with its unit and its meaning."""

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


def cameras_consistent(record: xr.Dataset, truth: xr.Dataset | None) -> bool | None:
    """Tell whether the errors of the cameras are consistent with what the cameras state.

    The cameras state their noise, and errors that all frames share. Returns None if the truth is
    not known, or if the record is too short to judge.
    """
    if truth is None:
        return None
    ok = record["measured_ok"].values.astype(bool)
    errors = true_poses(truth) - poses(record, "measured")
    roots = np.linalg.cholesky(record["measured_covariance"].values[ok])
    # Whitened errors have unit covariance if the cameras state their noise correctly.
    white = np.full_like(errors, np.nan)
    white[ok] = np.linalg.solve(roots, errors[ok][..., None])[..., 0]
    shared = np.linalg.solve(roots, common_modes(record)[ok])
    if shared.size:
        whitener = Marginal.of(shared.reshape(-1, shared.shape[2]))
        white[ok] = whitener.whiten(white[ok].ravel()).reshape(-1, 6)
    try:
        coloured = whiteness(white, ok).suspicious
    except EstimationError:
        return None
    return bool(np.mean(white[ok] ** 2) < CAMERAS_MISS and not coloured)


def verdict(result: dict[str, Any], consistent: bool | None) -> Verdict:
    """Return the verdict on a result.

    ``consistent`` is the result of `cameras_consistent`: True if the cameras cannot be the cause of
    the residuals, None if this is unknown.
    """
    judged = check_goals(result)
    unseen = bool(result.get("validation"))
    missed = [goal for goal in judged if not goal.passed]
    explained = all(goal.passed for goal in explanation_goals(result))
    sentences = [_residual_sentence(result, explained, consistent)]
    if unseen:
        # If the model does not explain its record, it is wrong, and this is stated first.
        sentences.insert(0 if explained else 1, _unseen_sentence(result))
    sentences += [
        f"Not met: {sentence(goal)}"
        for goal in missed
        if goal.name not in (goals.RESIDUALS, goals.CHANCE)
    ]
    if said := intervals_sentence(result["identification"]):
        sentences.append(said)
    # Without validation runs, the truth is not known, and only the residuals can be judged.
    if not unseen:
        headline = EXPLAINED if explained else _disagreement(None, result)
        return Verdict(explained, headline, (*sentences, NO_TRUTH))
    if not missed:
        estimated = goals.unseen(result).estimated
        once = f", once {estimated} are added to it" if estimated else ""
        headline = f"The identified model moves as the true robot does{once}."
        return Verdict(True, headline, tuple(sentences))
    if not explained:
        return Verdict(False, _disagreement(consistent, result), tuple(sentences))
    counted = f"{len(missed)} of {len(judged)} goals {'is' if len(missed) == 1 else 'are'} not met."
    return Verdict(False, f"The model explains the record, but {counted}", tuple(sentences))


NO_TRUTH = (
    "The truth is not known for this record. Hence the errors of the measured poses, the estimates "
    "and the predictions cannot be determined here: an error of the cameras that is the same in "
    "every frame, and an error of the model that the parameters compensate, leave no trace in the "
    "residuals."
)


def sentence(goal: goals.Goal) -> str:
    """Return a sentence with the value and the limit of a goal."""
    relation = "at most" if goal.relation == "<=" else "at least"
    limit = f"{relation} {number(goal.limit)} {goal.unit}".strip()
    value = f"{number(goal.value)} {goal.unit}".strip()
    return f"{goal.name} {value}, required {limit} ({goal.detail})."


def intervals_sentence(identification: Mapping[str, Any]) -> str:
    """Say how many intervals of identified parameters contain the truth, or return "".

    Intervals that miss it can share one cause, the error of the common scale.
    """
    judged = {
        name: entry
        for name, entry in identification["parameters"].items()
        if entry["identifiable"] and entry["true"] is not None
    }
    missed = [
        name
        for name, entry in judged.items()
        if not entry["interval"][0] <= entry["true"] <= entry["interval"][1]
    ]
    if not judged:
        return ""
    if not missed:
        every = f"{len(judged)} of {len(judged)}"
        return f"All intervals of identified parameters contain the truth, {every}."
    scale = identification.get("common_scale") or {"gain": None, "shared": {}}
    alike = sum(name == scale["gain"] or name in scale["shared"] for name in missed)
    said = (
        f"{len(judged) - len(missed)} of the {len(judged)} intervals of identified parameters "
        "contain the truth"
    )
    if alike < 2:
        return f"{said}."
    return f"{said}; {alike} of the {len(missed)} others share the error of the common scale."


def key_numbers(result: dict[str, Any]) -> list[KeyNumber]:
    """Return two RMS position errors of the worst axis, and the number of identified parameters.

    With validation runs, the errors are those of model and measured poses against the truth,
    otherwise those of both models against the measured poses.
    """
    identification = result["identification"]
    parameters = identification["parameters"]
    validation = result.get("validation")
    known = sum(bool(p["identifiable"]) for p in parameters.values())
    meaning = (
        "parameters are identified, each with an interval."
        if known
        else "parameters are identified."
    )
    identified = KeyNumber(f"{known}", f"of {len(parameters)}", meaning)
    if validation:
        found = goals.unseen(result)
        predicted = KeyNumber(
            number(float(found.rows[:, :3].max()), 2),
            "µm",
            f"RMS of the worst axis: {found.what} against the true robot, on validation "
            "trajectories.",
        )
        measured = max(rms_row(result["sensor"])[:3])
        measurement = KeyNumber(
            number(measured, 2), "µm", "RMS of the worst axis: measured against true poses."
        )
        return [predicted, measurement, identified]
    before = max(rms_row(result.get("before"))[:3])
    after = max(rms_row(result.get("after"))[:3])
    fitted = KeyNumber(
        number(after, 2), "µm", "between the identified model and the measured poses of the record."
    )
    if np.isfinite(before):
        meaning = "between the initial model and the same poses."
        initial = KeyNumber(number(before, 2), "µm", meaning)
    else:
        initial = KeyNumber("–", "", "The initial model is unstable.")
    return [fitted, initial, identified]


def _unseen_sentence(result: dict[str, Any]) -> str:
    """State the errors of both models against the true robot on validation trajectories."""
    runs = result["validation"]
    found = goals.unseen(result)
    identified = found.rows
    initial = np.array([rms_row(run.get("initial_true")) for run in runs])
    turns = bool((identified[:, 3:] != 0).any())
    text = f"On {len(runs)} validation trajectories, the {found.what} "
    if np.isfinite(identified).all():
        text += (
            f"is off by {_distance(identified, turns)} from the true robot (RMS of the worst axis)"
        )
    else:
        text += "is unstable"
    if not all("initial_true" in run for run in runs):
        return f"{text}."
    if np.isfinite(initial).all():
        return f"{text}; the initial model is off by {_distance(initial, turns)}."
    return f"{text}; the initial model is unstable."


def _distance(rows: Array, turns: bool) -> str:
    """Format the largest of errors (n, 6) [µm, µrad]. Without ``turns``, angles are left out."""
    position = float(rows[:, :3].max())
    orientation = float(rows[:, 3:].max())
    return f"{number(position, 2)} µm" + (f" and {number(orientation, 2)} µrad" if turns else "")


def _residual_sentence(result: dict[str, Any], explained: bool, consistent: bool | None) -> str:
    """State whether the residuals are only noise and, if not, their possible cause."""
    found = {goal.name: goal for goal in explanation_goals(result)}
    if not found:
        return "How well the model explains the record was not tested."
    said = []
    if goals.RESIDUALS in found:
        size = number(found[goals.RESIDUALS].value, 3)
        limit = number(found[goals.RESIDUALS].limit, 3)
        # In the loop of the servo, noise also moves the robot, and gives more than its variance.
        expected = result["identification"]["expected_noise_ratio"] or 0.0
        moving = ", more than 1 because noise also moves the robot" if expected > 1.0 else ""
        said.append(
            f"Their mean square is {size} times that which the cameras state. Noise alone gives up "
            f"to {limit}{moving}."
        )
    if goals.CHANCE in found:
        chance = share(found[goals.CHANCE].value / 100)
        said.append(
            "With noise alone, residuals would be at least as correlated from frame to frame in "
            f"{chance} of experiments."
        )
    if explained:
        return " ".join(["The residuals are the noise of the cameras.", *said])
    cause = _cause(consistent, result)
    return " ".join(["The residuals are more than the noise of the cameras.", *said, cause])


def _drift_warning(result: dict[str, Any]) -> str | None:
    """Return the warning of the run's drift watch.

    Returns None if the cameras kept their calibration, or if there was no drift watch.
    """
    return (result.get("drift_watch") or {}).get("warning")


def _moved(result: dict[str, Any]) -> bool:
    """Tell whether a movement of the cameras explains what the drift watch has noticed."""
    return bool(result["drift_watch"].get("explained", 1.0) >= MOSTLY_MOVED)


def _cause(consistent: bool | None, result: dict[str, Any]) -> str:
    """State the possible cause of residuals that are more than noise."""
    # If the cameras have moved, the measurement is wrong for any model.
    if warning := _drift_warning(result):
        again = "Calibrate them again; the" if _moved(result) else "The"
        return (
            f"{warning[0].upper()}{warning[1:]}. {again} record cannot tell whether the model is "
            "right."
        )
    if consistent:
        return (
            "The cameras are not the cause, because their errors agree with their stated noise: "
            "the geometry, the joints or the friction of the model are not those of the robot."
        )
    if consistent is None:
        return (
            "The cause is the model, or cameras with errors beyond their stated noise; the record "
            "alone cannot tell."
        )
    return (
        "The errors of the cameras are larger than the cameras state, or not random: the cause can "
        "be the cameras or the model."
    )


EXPLAINED = "The identified model explains the record to within the cameras' noise."


def _disagreement(consistent: bool | None, result: dict[str, Any]) -> str:
    """Return the headline for a model that does not explain the record."""
    if _drift_warning(result):
        found = (
            "the cameras have lost their calibration"
            if _moved(result)
            else "stickers are not where the cameras should see them"
        )
        return f"Model and measurement disagree, and {found}."
    if consistent:
        return "The model does not describe the robot."
    return "Model and measurement disagree, because of an error of the model or of the cameras."
