"""Truth of a simulated run, in its own netCDF group. The estimator never reads the truth."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from identify.arrays import Array
from identify.errors import RecordError
from identify.files.dataset import (
    Variables,
    check_finite,
    check_variables,
    described_dataset,
    joint_numbers,
    pose_parts,
    read_group,
    with_joint_units,
)
from identify.loop_parameters import known_value
from identify.record.provenance import digest
from identify.record.recording import TRUTH_GROUP, read, run_names

VARIABLES: Variables = {
    "position": (("time", "axis"), "m", "true position of the platform"),
    "orientation": (("time", "angle"), "rad", "true orientation of the platform"),
    "joint_angle": (("time", "joint"), "rad", "true joint coordinate"),
    "joint_velocity": (("time", "joint"), "rad/s", "true joint velocity"),
    "joint_torque": (("time", "joint"), "N m", "torque or force of the joint controller"),
    "parameter_value": (
        ("parameter",),
        "SI",
        "true parameter of the plant and its joint controller",
    ),
}

# Additional variables of a plant that differs from the nominal robot with rigid joints.
MISMATCH: Variables = {
    "base_joint_error": (
        ("joint", "axis"),
        "m",
        "true minus nominal joint centre B on the base",
    ),
    "platform_joint_error": (
        ("joint", "axis"),
        "m",
        "true minus nominal joint centre A on the platform",
    ),
    "joint_zero_error": (("joint",), "rad", "what each joint reads too little"),
    "motor_angle": (
        ("time", "joint"),
        "rad",
        "motor coordinate of an elastic joint, which the encoder measures",
    ),
}


def build_truth(
    *,
    time: ArrayLike,
    pose: ArrayLike,
    joint_angle: ArrayLike,
    joint_velocity: ArrayLike,
    joint_torque: ArrayLike,
    parameter_names: list[str],
    parameters: ArrayLike,
    mismatch: Mapping[str, ArrayLike] | None = None,
    prismatic: bool = False,
) -> xr.Dataset:
    """Build the truth of one run.

    time (N,)                       Times of the frames, s.
    pose (N, 6)                     True poses, m and rad.
    joint_angle, joint_velocity, joint_torque (N, n)
                                    True joint coordinates, velocities, and torques or forces.
    parameter_names                 Names of the parameters.
    parameters (p,)                 True parameters, SI.
    mismatch                        Values of some of the variables of `MISMATCH`.
    prismatic                       True if the joints slide.

    Raises RecordError if a shape is wrong or a number is not finite.
    """
    truth = described_dataset(
        {
            **pose_parts(pose, "pose", "position", "orientation"),
            "joint_angle": np.asarray(joint_angle, dtype=float),
            "joint_velocity": np.asarray(joint_velocity, dtype=float),
            "joint_torque": np.asarray(joint_torque, dtype=float),
            "parameter_value": np.asarray(parameters, dtype=float),
            **{name: np.asarray(values, dtype=float) for name, values in (mismatch or {}).items()},
        },
        time,
        with_joint_units(VARIABLES | {name: MISMATCH[name] for name in mismatch or {}}, prismatic),
        parameter=list(parameter_names),
        joint=joint_numbers(joint_angle),
    )
    truth.attrs["title"] = "Truth of the simulated experiment, not known to the estimator"
    return check_truth(truth, "new truth")


def read_truth(path: Path | str, run: str = "") -> xr.Dataset:
    """Read and check the truth of a file, or of one of its runs (``"run01"``).

    Raises RecordError if the file is truncated or holds no truth, or if a variable is missing, has
    a wrong shape or is not finite.
    """
    group = f"{run}/{TRUTH_GROUP}" if run else TRUTH_GROUP
    return check_truth(read_group(path, group), f"{path}:{group}")


def read_truth_runs(path: Path | str) -> list[xr.Dataset]:
    """Read the truth of all runs of a file, in their order.

    Raises the RecordError of `read_truth`, or RecordError if there are no runs.
    """
    return [read_truth(path, name) for name in run_names(path)]


def true_poses(truth: xr.Dataset) -> Array:
    """Return the true poses (N, 6) [m, rad] at the frames."""
    return np.hstack([truth["position"].values, truth["orientation"].values])


def true_values(truth: Mapping[str, float], names: Iterable[str]) -> list[float]:
    """Return the true values of parameters by name.

    For parameters that the plant has in another form see `known_value`. Raises RecordError if a
    parameter is missing.
    """
    values = []
    for name in names:
        value = known_value(truth, name)
        if value is None:
            raise RecordError(f"the truth has no {name}")
        values.append(value)
    return values


def true_parameters(truth: xr.Dataset) -> dict[str, float]:
    """Return the true parameters by name."""
    return dict(
        zip(
            map(str, truth["parameter"].values),
            map(float, truth["parameter_value"].values),
            strict=True,
        )
    )


def check_truth(truth: xr.Dataset, source: str) -> xr.Dataset:
    """Return the truth if it is complete and finite, or raise RecordError for the first fault."""
    expected = VARIABLES | {name: entry for name, entry in MISMATCH.items() if name in truth}
    check_variables(truth, expected, source)
    for name in expected:
        check_finite(truth[name].values, name, source)
    if truth.sizes["parameter"] == 0:
        raise RecordError(f"{source} has no parameters")
    return truth


@xr.register_dataset_accessor("truth")
def truth_of(record: xr.Dataset) -> xr.Dataset:
    """Return the truth of a record, ``record.truth``, from the file in its attribute ``path``.

    Raises RecordError if there is no such file, or if it holds the truth of another record.
    """
    path = record.attrs.get("path")
    if path is None:
        file = record.encoding.get("source", "experiment.nc")
        raise RecordError(
            "the record has no attribute path, which setup.run() adds and which names the file "
            f'with its truth; xarray.open_dataset("{file}", group="{TRUTH_GROUP}") is the truth of '
            "a simulated run, and a record of a real robot has none"
        )
    if digest(read(path)) != digest(record):
        raise RecordError(
            f"{path} now holds another record and its truth; "
            "use setup.run(path=...) to store each record in a separate file"
        )
    return read_truth(path)
