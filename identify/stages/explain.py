"""Stages that explain an identified run: causes of its misfit, and sources of its uncertainty."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from dynamics import load_robot
from dynamics.closed_loop import LoopFailure
from identify.arrays import Array
from identify.diagnosis.cause import Cause
from identify.diagnosis.diagnose import diagnosis_from
from identify.diagnosis.diagnosis import Diagnosis
from identify.estimation.budget import Budget, budget_of, joined_budget, parameter_budget
from identify.estimation.covariance import NOISE
from identify.estimation.explanation import LITTLE, MISFIT, SUSPICIOUS, Misfit, needs_cause
from identify.estimation.identification import output_error_problem
from identify.files.dataset import POSE, read_sources
from identify.files.run_folder import RunFolder, check_entries, load_result, save_result
from identify.loop_parameters import settled_drive
from identify.model.from_record import predicting_model
from identify.model.model_side import ModelSide, model_side
from identify.record.checks import TooFewFramesError
from identify.record.conditions import DRIFT
from identify.record.known_geometry import known_geometry
from identify.record.provenance import RECORDS, RunFiles
from identify.record.stored_common_errors import CHANGES, kind_of, read_common_errors
from identify.reporting.run_result import parameter_vector
from identify.scenario import Scenario, load_scenario
from identify.stages.plan import identified_files
from identify.trajectory import load_trajectories
from identify.validation.pose_prediction import predicted_variances

ENTRY = "diagnosis"  # name of the entry of result.json that holds the diagnosis


def diagnose(folder: Path, own: Sequence[Cause] = ()) -> Diagnosis:
    """Diagnose the identified model of a run folder, and store the diagnosis in result.json.

    own: the user's own causes, which are tried as well. Raises RecordError if the result is
    incomplete or was made of another record, and the errors of `identify.diagnose`.
    """
    files, result, scenario, side = _identified(folder)
    identification = result["identification"]
    names = identified_files(files.folder, scenario.identification)
    records = [files.content(name) for name in names]
    problem = output_error_problem(records, side, scenario.identification)
    estimate = parameter_vector(side.robot, identification, "estimate")
    diagnosis = diagnosis_from(problem, estimate, own, identification["nuisance_estimates"])
    diagnosis = replace(diagnosis, not_needed=not_needed(result, diagnosis))
    save_result(files.folder.result, with_diagnosis(result, diagnosis))
    return diagnosis


def _identified(
    folder: Path, *further: str
) -> tuple[RunFiles, dict[str, Any], Scenario, ModelSide]:
    """Return files, result, scenario and model's side of an identified run.

    ``further`` names files that must be those of the result, besides the records.
    """
    run_folder = RunFolder(folder)
    run_folder.require("scenario.toml", "experiment.nc", *further, "result.json")
    files = RunFiles(run_folder)
    result = load_result(run_folder.result)
    check_entries(run_folder.result, result, "identify")
    files.check_made_of(*RECORDS, *further, result=result)
    scenario = load_scenario(run_folder.whole_scenario)
    robot = known_geometry(load_robot(scenario.robot), scenario.geometry, run_folder.path).robot
    side = model_side(robot, scenario).with_drive(settled_drive(result["identification"]))
    return files, result, scenario, side


def not_needed(result: dict[str, Any], found: Diagnosis) -> str:
    """Return why the result of a run needs no cause in the robot, or an empty string."""
    if warning := (result.get(DRIFT) or {}).get("warning"):
        return f"{warning}: this makes residuals of its own, and no cause in the robot is needed"
    identification = result["identification"]
    numbers = [identification[key] for key in MISFIT]
    chance = identification["whiteness"]["p_value"]
    if None in (*numbers, chance):
        return ""
    if needs_cause(Misfit(*numbers), found.misfit, chance < SUSPICIOUS):
        return ""
    return (
        "noise explains the record, and no cause is needed for an excess below "
        f"{LITTLE:.0%} of it: of the model that the logged commands drive, {found.misfit}"
    )


def with_diagnosis(result: dict[str, Any], found: Diagnosis) -> dict[str, Any]:
    """Return a result with a diagnosis, whose warnings replace those of an earlier diagnosis."""
    identification = result["identification"]
    earlier = (result.get(ENTRY) or {}).get("warnings", [])
    kept = [text for text in identification["warnings"] if text not in earlier]
    warned = identification | {"warnings": [*kept, *found.warnings()]}
    return result | {"identification": warned, ENTRY: found.to_dict()}


UNITS = 3 * ("m",) + 3 * ("rad",)


def error_budget(folder: Path | str) -> Budget:
    """Return the error budget of an identified run.

    Parameters
    ----------
    folder : str or Path
        Folder of the run.

    Returns
    -------
    Budget
        Variances by source of each entry of the measured pose (`pose.x`, ...), of each parameter,
        and of each entry of the predicted pose on the validation trajectories
        (`prediction.x`, ...). Variances of poses are means over all frames. There are no
        predictions before the run is validated, or for a validation run that the model fails to
        predict.

    Raises
    ------
    OutputFolderError, RecordError
        The run was identified by an older version, is incomplete, or its files do not belong
        together.

    Examples
    --------
    >>> error_budget("runs/quick-0").to_dataframe()  # doctest: +SKIP
    """
    files, result, _, side = _identified(Path(folder), "covariance.nc")
    run_folder = files.folder
    identification = result["identification"]
    covariance = files.covariance_of(side.robot)
    sources = read_sources(run_folder.covariance, covariance)
    budgets = [
        pose_budget(files.experiment, side),
        parameter_budget(side.robot.layout, covariance, sources),
    ]
    if run_folder.validation.is_file():
        learned = identification.get("nuisance_estimates", {})
        seed = load_trajectories(run_folder.trajectories).seed
        values = parameter_vector(side.robot, identification, "estimate")
        runs = []
        for number, record in enumerate(files.validation, start=1):
            try:
                runs.append(
                    predicted_variances(side, record, number, values, sources, seed, learned)
                )
            except (LoopFailure, TooFewFramesError):
                continue
        if runs:
            budgets.insert(1, _prediction_budget(runs))
    return joined_budget(budgets)


def pose_budget(record: xr.Dataset, side: ModelSide) -> Budget:
    """Return the budget of the measured poses of a record, as means over its frames.

    The budget includes all common errors that the record states, even those that the identification
    takes as exact.
    """
    noise = predicting_model(record, side).covariance
    parts = {NOISE: np.diag(noise)}
    total = np.diag(noise)
    if CHANGES in record:
        kinds = {kind_of(str(name)) for name in record["common_error_name"].values}
        errors = read_common_errors(record, tuple(kinds))
        modes = errors.modes
        parts |= {kind: _mean_square(part) for kind, part in errors.by_kind(modes).items()}
        total = total + _mean_square(modes)
    return budget_of([f"pose.{name}" for name in POSE], UNITS, parts, total)


def _mean_square(modes: Array) -> Array:
    """Return the mean variance (6,) over the frames of modes (N, 6, k) of unit variance."""
    return np.asarray(np.mean(np.sum(modes**2, axis=2), axis=0))


def _prediction_budget(runs: list[dict[str, Array]]) -> Budget:
    """Return the mean budget of predictions, from their variances (N, 6) by source."""
    parts = {key: np.mean(np.concatenate([run[key] for run in runs]), axis=0) for key in runs[0]}
    total = np.asarray(sum(parts.values()))
    return budget_of([f"prediction.{name}" for name in POSE], UNITS, parts, total)
