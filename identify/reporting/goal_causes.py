"""Likeliest cause of each missed goal of a run, and the command to type next.

Both follow from `result.json` alone. Each goal has a list of rules, and the first rule that finds a
cause is used.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cmmsim.uncertainty.drift_evidence import MOSTLY_MOVED
from identify.files.run_folder import predicted_row, rms_row
from identify.reporting import goals
from identify.reporting.goals import Goal, explanation_goals, far_off, unseen
from identify.reporting.number_format import number

STDS = 3.0  # number of stated standard deviations within which an error counts as stated
# Ratio of the model's error against the measured poses to that against the true poses, below which
# the measured poses count as agreeing with the model.
AGREES = 0.5
# Fraction of a variance due to the initial guess, from which on an estimate rests on the guess.
MOSTLY_GUESS = 0.5
ALIKE = 0.99  # absolute correlation from which on two parameters act almost alike
# Beginning of the reason why a search stopped before it had converged.
STOPPED = "stopped after max_iterations"


@dataclass(frozen=True)
class Advice:
    """Likeliest cause of a missed goal in one sentence, and the command to type next."""

    cause: str
    command: str


@dataclass(frozen=True)
class _Run:
    """Result of a run, its folder, and the goal that it misses."""

    result: dict[str, Any]
    folder: Path
    goal: Goal

    @property
    def identification(self) -> dict[str, Any]:
        return dict(self.result.get("identification", {}))

    @property
    def part(self) -> slice:
        """Slice of the position in a pose for a goal in µm, otherwise of the orientation."""
        return slice(3) if self.goal.unit == "µm" else slice(3, 6)

    @property
    def explained(self) -> bool:
        """True if the model explains the record to within the cameras' noise."""
        return all(goal.passed for goal in explanation_goals(self.result))

    def again(self, setting: str) -> str:
        """Return the command that identifies with one changed setting."""
        return f"cmmsim identify --out {self.folder} --set {setting}"

    def repeated(self, setting: str, name: str) -> str:
        """Return the command that repeats the whole run with one changed setting."""
        return (
            f"cmmsim run {self.folder / 'scenario.toml'} --seed {self.result.get('seed') or 0} "
            f"--set {setting} --out {self.folder}-{name}"
        )


def advice(goal: Goal, result: dict[str, Any], folder: Path | str) -> Advice:
    """Return the likeliest cause of a goal that the run in a folder misses."""
    run = _Run(result, Path(folder), goal)
    return next(found for rule in _RULES[goal.name] if (found := rule(run)) is not None)


def advices(
    missed: Sequence[Goal], result: dict[str, Any], folder: Path | str
) -> list[tuple[Advice, list[str]]]:
    """Return each different advice for missed goals, with the names of these goals."""
    found: dict[Advice, list[str]] = {}
    for goal in missed:
        found.setdefault(advice(goal, result, folder), []).append(goal.name)
    return list(found.items())


def _moved_cameras(run: _Run) -> Advice | None:
    watch = run.result.get("drift_watch") or {}
    warning = watch.get("warning")
    if not warning:
        return None
    # Movements that explain little are fitted to an error of another kind.
    if watch.get("explained", 1.0) < MOSTLY_MOVED:
        return Advice(
            "Stickers are not where the cameras should see them, and no movement of the cameras "
            f"explains it ({100 * watch['explained']:.2g} % at most): their detection or their "
            "known positions are wrong.",
            f"cmmsim replay {run.folder}",
        )
    return Advice(
        f"The cameras have lost their calibration: {warning}.",
        "cmmsim calibrate LEFT RIGHT --board board.toml",
    )


def _unfinished_search(run: _Run) -> Advice | None:
    reason = str(run.identification.get("stop_reason", ""))
    if not reason.startswith(STOPPED):
        return None
    most = int(run.result.get("settings", {}).get("identification.max_iterations", 30))
    return Advice(
        f"The search for the parameters did not converge in {most} iterations.",
        run.again(f"identification.max_iterations={2 * most}"),
    )


def _unsure_drive(run: _Run) -> Advice | None:
    drive = run.identification.get("drive") or {}
    if drive.get("sure", True):
        return None
    ranked = sorted(drive["probabilities"].items(), key=lambda item: -item[1])
    other = next(law for law, _ in ranked if law != drive["law"])
    return Advice(
        "The record cannot tell whether the law of the drives is "
        f"{drive['law']}, which was used, or {other}.",
        run.again(f"model.drive={other}"),
    )


def _known_cause(run: _Run) -> Advice | None:
    """Return the first cause of the diagnosis, or say that no known cause explains the misfit."""
    diagnosis = run.result.get("diagnosis")
    if run.explained or not diagnosis:
        return None
    if diagnosis["none_of_these"] or not diagnosis["findings"]:
        return Advice(
            f"The model lacks something of the robot that is none of {len(diagnosis['candidates'])}"
            " known causes.",
            f"cmmsim diagnose {run.folder} --add my_module:my_cause",
        )
    first = diagnosis["findings"][0]
    much = f"{100 * first['share']:.3g} % of the misfit"
    remedy = first["remedies"][0]
    # A remedy of several settings, or with a choice of two, is left to the reader.
    if remedy.startswith("--set ") and " or " not in remedy and remedy.count("--set ") == 1:
        return Advice(
            f"{first['name']} explains {much}.", f"cmmsim identify --out {run.folder} {remedy}"
        )
    return Advice(f"{first['name']} explains {much}: {remedy}.", f"cmmsim diagnose {run.folder}")


def _model_or_cameras(run: _Run) -> Advice | None:
    if run.explained:
        return None
    chances = run.identification.get("whiteness", {}).get("p_values") or {}
    known = {axis: chance for axis, chance in chances.items() if chance is not None}
    where = f", most along {min(known, key=lambda axis: known[axis])}" if known else ""
    return Advice(
        "The model moves differently from the robot, or the cameras have errors beyond their "
        f"stated noise{where}.",
        f"cmmsim diagnose {run.folder}",
    )


def _held_gains(run: _Run) -> Advice | None:
    drive = run.identification.get("drive") or {}
    if drive.get("in_loop", True):
        return None
    return Advice(
        "The exciting motion was not driven by the servo, so that the record does not show the "
        "gains of the drives, with which the validation motions are driven.",
        run.repeated("excitation.law=pid", "servo"),
    )


def _unstable(run: _Run) -> Advice | None:
    if not math.isnan(run.goal.value):
        return None
    return Advice(
        "The identified model is unstable: a sum of parameters that the record shows can be right "
        "while single bodies have masses or inertias that no body has.",
        run.again("identification.physical_consistency=true"),
    )


def _in_common(run: _Run) -> Advice | None:
    """Find an error of all measured poses, if the model follows these poses and not the robot."""
    true = np.array([rms_row(one["true"])[run.part] for one in run.result["validation"]])
    worst = np.unravel_index(int(np.argmax(true)), true.shape)
    measured = rms_row(run.result["validation"][worst[0]].get("measured"))[run.part][worst[1]]
    if unseen(run.result).estimated or not measured < AGREES * true[worst]:
        return None
    return Advice(
        f"All measured poses share an error that the cameras do not state: the model is off by "
        f"{number(measured, 2)} {run.goal.unit} from the measured poses, and by "
        f"{number(true[worst], 2)} {run.goal.unit} from the true ones.",
        run.repeated("rig.known=calibrated", "calibrated"),
    )


def _stated(run: _Run) -> Advice | None:
    std = max(max(predicted_row(one)[run.part]) for one in run.result["validation"])
    if not run.goal.value <= STDS * std:
        return None
    return Advice(
        f"The record leaves this much open: the run states a standard deviation of "
        f"{number(std, 2)} {run.goal.unit} for these poses.",
        f"cmmsim budget {run.folder}",
    )


def _intervals_fail(run: _Run) -> Advice:
    return Advice(
        "The errors of the parameters are larger than their stated uncertainty, although the "
        "record is explained: something that is held fixed, such as the geometry, is wrong.",
        f"cmmsim diagnose {run.folder}",
    )


def _wrong_guess(run: _Run) -> Advice | None:
    entries = run.identification["parameters"]
    shares = {name: entries[name].get("prior_share") or 0.0 for name in far_off(entries)}
    name = max(shares, key=lambda one: shares[one])
    if shares[name] < MOSTLY_GUESS:
        return None
    stated = float(run.result.get("settings", {}).get("identification.start_std", 1.0))
    return Advice(
        f"{name} rests on the initial guess ({100 * shares[name]:.2g} % of its variance), and the "
        "guess is worse than it states.",
        run.again(f"identification.start_std={2 * stated:g}"),
    )


def _alike(run: _Run) -> Advice | None:
    names = far_off(run.identification["parameters"])
    for pair in run.identification.get("strongest_correlations", []):
        inside = [name for name in (pair["first"], pair["second"]) if name in names]
        if inside and abs(pair["correlation"]) >= ALIKE:
            return Advice(
                f"{pair['first']} and {pair['second']} act almost alike in this motion "
                f"(correlation {pair['correlation']:.4f}), so that their errors come together.",
                f"cmmsim budget {run.folder}",
            )
    return None


def _noise(run: _Run) -> Advice | None:
    sensor = run.result["sensor"]
    if "position_noise_um" not in sensor:
        return None
    noise = max(rms_row(sensor, "noise")[run.part])
    if not run.goal.value <= STDS * noise:
        return None
    return Advice(
        f"The images are this noisy: the cameras state a noise of {number(noise, 2)} "
        f"{run.goal.unit}.",
        f"cmmsim budget {run.folder}",
    )


def _unstated_error(run: _Run) -> Advice:
    return Advice(
        "The cameras have errors that they do not state, such as those of an inexact calibration.",
        run.repeated("rig.known=calibrated", "calibrated"),
    )


def _lost(run: _Run) -> Advice:
    sensor = run.result["sensor"]
    why = sensor.get("lost_because")
    percent = number(100 * sensor["lost_frames"] / sensor["frames"], 2)
    said = f"In {percent} % of the frames the cameras did not find the platform"
    return Advice(f"{said}{f': {why}' if why else ''}.", f"cmmsim replay {run.folder}")


_OF_THE_MODEL = (_moved_cameras, _unfinished_search, _unsure_drive, _known_cause, _model_or_cameras)
_OF_CAMERAS = (_moved_cameras, _noise, _unstated_error)
_OF_PREDICTIONS = (*_OF_THE_MODEL, _held_gains, _unstable, _in_common, _stated, _intervals_fail)

# Rules of each goal, in the order in which they are tried. The final one always finds a cause.
_RULES: dict[str, tuple[Callable[[_Run], Advice | None], ...]] = {
    goals.RESIDUALS: _OF_THE_MODEL,
    goals.CHANCE: _OF_THE_MODEL,
    goals.UNSEEN_POSITION: _OF_PREDICTIONS,
    goals.UNSEEN_ORIENTATION: _OF_PREDICTIONS,
    goals.SENSOR_POSITION: _OF_CAMERAS,
    goals.SENSOR_ORIENTATION: _OF_CAMERAS,
    goals.LOST: (_moved_cameras, _lost),
    goals.FAR_OFF: (*_OF_THE_MODEL, _wrong_guess, _alike, _intervals_fail),
}
