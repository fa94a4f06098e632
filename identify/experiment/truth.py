"""The truth of a simulated run, in its own netCDF group; only validation and reports open it."""

from collections.abc import Mapping
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
from identify.record.recording import TRUTH_GROUP, run_names

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

MISMATCH: Variables = {
    "base_joint_error": (
        ("joint", "axis"),
        "m",
        "true joint centre B on the base less the nominal one",
    ),
    "platform_joint_error": (
        ("joint", "axis"),
        "m",
        "true joint centre A on the platform less the nominal one",
    ),
    "motor_angle": (
        ("time", "joint"),
        "rad",
        "place of the motor of an elastic joint, which its encoder reads",
    ),
}
"""What is recorded of a plant only where it is not the nominal robot with rigid joints."""


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
    """Truth of one run at the frames: ``time`` (N,) [s], pose (N, 6), joint arrays (N, n),
    parameters (p,) with names; ``mismatch``: values of some of `MISMATCH`; ``prismatic``: whether
    the joints slide.

    Raises RecordError: wrong shapes, or numbers that are not finite.
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
    """Read the truth of a file, or of one of its runs (``"run01"``), checked.

    Raises RecordError: truncated file, no truth in it, missing variables or wrong shapes.
    """
    group = f"{run}/{TRUTH_GROUP}" if run else TRUTH_GROUP
    return check_truth(read_group(path, group), f"{path}:{group}")


def read_truth_runs(path: Path | str) -> list[xr.Dataset]:
    """Read the truth of all runs of a file in their order. Raises RecordError: as `read_truth`, or
    no runs in it.
    """
    return [read_truth(path, name) for name in run_names(path)]


def true_poses(truth: xr.Dataset) -> Array:
    """True poses (N, 6) [m, rad] at the frames."""
    return np.hstack([truth["position"].values, truth["orientation"].values])


def true_parameters(truth: xr.Dataset) -> dict[str, float]:
    """True parameters by name."""
    return dict(
        zip(
            map(str, truth["parameter"].values),
            map(float, truth["parameter_value"].values),
            strict=True,
        )
    )


def check_truth(truth: xr.Dataset, source: str) -> xr.Dataset:
    """Return the truth when it is complete and finite. Raises RecordError: the first thing that is
    not so.
    """
    expected = VARIABLES | {name: entry for name, entry in MISMATCH.items() if name in truth}
    check_variables(truth, expected, source)
    for name in expected:
        check_finite(truth[name].values, name, source)
    if truth.sizes["parameter"] == 0:
        raise RecordError(f"{source} has no parameters")
    return truth
