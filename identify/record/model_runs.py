"""What the starting and the identified model do on the trajectories of a run, for figures and reports (``model.nc``).

Groups ``excitation``, ``run01``, ``run02``, ...; a starting model may be unstable, so its poses may be NaN.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from identify.files.dataset import Variables, check_variables, described_dataset, pose_array
from identify.files.netcdf import group_names, read_group, write_groups
from identify.record.recording import run_name

EXCITATION = "excitation"

VARIABLES: Variables = {
    "initial_position": (("time", "axis"), "m", "position of the model with the starting parameters"),
    "initial_orientation": (("time", "angle"), "rad", "orientation of the model with the starting parameters"),
    "identified_position": (("time", "axis"), "m", "position of the model with the identified parameters"),
    "identified_orientation": (("time", "angle"), "rad", "orientation of the model with the identified parameters"),
}

PREDICTED: Variables = {
    "std_position": (("time", "axis"), "m", "predicted deviation of the plant from the identified model"),
    "std_orientation": (("time", "angle"), "rad", "predicted deviation of the plant from the identified model"),
}
"""Of unseen trajectories only: elsewhere nothing is predicted."""


def build_model_run(
    time: ArrayLike, initial_pose: ArrayLike, identified_pose: ArrayLike, std: ArrayLike | None = None
) -> xr.Dataset:
    """Poses (N, 6) [m, rad] of both models at the frames ``time`` (N,) [s] of a run; NaN after a model has diverged.

    std (N, 6): predicted deviations of the plant from the identified model, where they were predicted.
    Raises:
        RecordError: wrong shapes.
    """
    initial, identified = pose_array(initial_pose, "initial_pose"), pose_array(identified_pose, "identified_pose")
    values = {
        "initial_position": initial[:, :3],
        "initial_orientation": initial[:, 3:],
        "identified_position": identified[:, :3],
        "identified_orientation": identified[:, 3:],
    }
    variables = VARIABLES
    if std is not None:
        predicted = pose_array(std, "std")
        values |= {"std_position": predicted[:, :3], "std_orientation": predicted[:, 3:]}
        variables = VARIABLES | PREDICTED
    finite = {name: np.where(np.isfinite(v), v, np.nan) for name, v in values.items()}
    return described_dataset(finite, time, variables)


def write_model_runs(path: Path | str, excitation: xr.Dataset, validation: Sequence[xr.Dataset] = ()) -> None:
    """Write the model runs as the groups ``excitation``, ``run01``, ``run02``, ..."""
    runs = {run_name(number): run for number, run in enumerate(validation, start=1)}
    write_groups(path, {EXCITATION: excitation, **runs})


def read_model_runs(path: Path | str) -> Mapping[str, xr.Dataset]:
    """Read all model runs by group name, ``excitation`` among them.

    Raises:
        RecordError: truncated file, missing variables or wrong shapes.
    """
    runs = {}
    for name in group_names(path):
        run = read_group(path, name)
        check_variables(run, VARIABLES, f"{path}:{name}")
        runs[name] = run
    return runs
