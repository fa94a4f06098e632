"""Stage that states what each source of uncertainty adds to poses, parameters and predictions."""

from pathlib import Path

import numpy as np
import xarray as xr

from dynamics import load_robot
from dynamics.closed_loop import LoopFailure
from identify.arrays import Array
from identify.estimation.budget import Budget, budget_of, parameter_budget, together
from identify.estimation.covariance import NOISE
from identify.files.dataset import POSE, read_sources
from identify.files.run_folder import RunFolder, check_entries, load_result
from identify.loop_parameters import settled_drive
from identify.model.from_record import predicting_model
from identify.model.model_side import ModelSide, model_side
from identify.record.checks import TooFewFramesError
from identify.record.known_geometry import known_geometry
from identify.record.provenance import RECORDS, RunFiles
from identify.record.stored_common_errors import CHANGES, kind_of, read_common_errors
from identify.reporting.run_result import parameter_vector
from identify.scenario import load_scenario
from identify.trajectory import load_trajectories
from identify.validation.pose_prediction import predicted_variances

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
        predictions before the run is validated.

    Raises
    ------
    RecordError
        The run was identified by an older version, is incomplete, or its files do not belong
        together.

    Examples
    --------
    >>> error_budget("runs/quick-0").to_dataframe()  # doctest: +SKIP
    """
    run_folder = RunFolder(Path(folder))
    run_folder.require("scenario.toml", "experiment.nc", "covariance.nc", "result.json")
    files = RunFiles(run_folder)
    result = load_result(run_folder.result)
    check_entries(run_folder.result, result, "identify")
    files.check_made_of(*RECORDS, run_folder.covariance.name, result=result)
    scenario = load_scenario(run_folder.whole_scenario)
    robot = known_geometry(load_robot(scenario.robot), scenario.geometry, run_folder.path).robot
    identification = result["identification"]
    side = model_side(robot, scenario).with_drive(settled_drive(identification))
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
    return together(budgets)


def pose_budget(record: xr.Dataset, side: ModelSide) -> Budget:
    """Return the budget of the measured poses of a record, as means over its frames.

    It includes all common errors that the record states, even those that the identification takes
    as exact.
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
