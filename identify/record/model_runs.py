"""Poses of the initial and the identified model in the runs of a folder, as netCDF (`model.nc`).

The groups of the file are ``excitation``, ``run01``, ``run02``, ...
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from identify.files.dataset import (
    Variables,
    check_variables,
    described_dataset,
    group_names,
    pose_parts,
    read_group,
)
from identify.record.recording import run_name

EXCITATION = "excitation"

MODEL_VARIABLES: Variables = {
    "initial_position": (
        ("time", "axis"),
        "m",
        "position of the model with the initial guess of the parameters",
    ),
    "initial_orientation": (
        ("time", "angle"),
        "rad",
        "orientation of the model with the initial guess of the parameters",
    ),
    "identified_position": (
        ("time", "axis"),
        "m",
        "position of the model with the identified parameters",
    ),
    "identified_orientation": (
        ("time", "angle"),
        "rad",
        "orientation of the model with the identified parameters",
    ),
}

# Additional variables of runs of validation trajectories.
PREDICTED: Variables = {
    "predicted_position": (
        ("time", "axis"),
        "m",
        "position of the identified model together with the estimated common errors",
    ),
    "predicted_orientation": (
        ("time", "angle"),
        "rad",
        "orientation of the identified model together with the estimated common errors",
    ),
    "std_position": (
        ("time", "axis"),
        "m",
        "expected standard deviation of the plant about the predicted pose, position",
    ),
    "std_orientation": (
        ("time", "angle"),
        "rad",
        "expected standard deviation of the plant about the predicted pose, orientation",
    ),
}


def build_model_run(
    time: ArrayLike,
    initial_pose: ArrayLike,
    identified_pose: ArrayLike,
    prediction: tuple[ArrayLike, ArrayLike] | None = None,
) -> xr.Dataset:
    """Build the dataset of the poses of the initial and the identified model in a run.

    time (N,)                       Times of the frames, s.
    initial_pose, identified_pose (N, 6)
                                    Poses of the models, m and rad. Poses of a diverged model that
                                    are not finite become NaN.
    prediction 2 (N, 6)             Predicted poses of the plant, m and rad, and expected standard
                                    deviations of the plant about them.

    Raises RecordError if a shape is wrong.
    """
    values = pose_parts(initial_pose, "initial_pose", "initial_position", "initial_orientation")
    values |= pose_parts(
        identified_pose, "identified_pose", "identified_position", "identified_orientation"
    )
    variables = MODEL_VARIABLES
    if prediction is not None:
        predicted, std = prediction
        values |= pose_parts(predicted, "predicted", "predicted_position", "predicted_orientation")
        values |= pose_parts(std, "std", "std_position", "std_orientation")
        variables = MODEL_VARIABLES | PREDICTED
    # Poses of a diverged model can be infinite.
    finite = {name: np.where(np.isfinite(v), v, np.nan) for name, v in values.items()}
    return described_dataset(finite, time, variables)


def model_groups(
    excitation: xr.Dataset, validation: Sequence[xr.Dataset] = ()
) -> dict[str, xr.Dataset]:
    """Return the groups ``excitation``, ``run01``, ``run02``, ... of a file of model runs."""
    named = {run_name(number): run for number, run in enumerate(validation, start=1)}
    return {EXCITATION: excitation} | named


def read_model_runs(path: Path | str) -> Mapping[str, xr.Dataset]:
    """Read all model runs by group name, including ``excitation``.

    Raises RecordError if the file is truncated, a variable is missing, or a shape is wrong.
    """
    runs = {}
    for name in group_names(path):
        run = read_group(path, name)
        check_variables(run, MODEL_VARIABLES, f"{path}:{name}")
        runs[name] = run
    return runs
