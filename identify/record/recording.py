"""Records of runs as xarray datasets in netCDF.

A record holds the data of a run that an experimenter has. It is the main group of its file. The
truth is a separate group (`identify.experiment.truth`), so that an estimator that reads a record
cannot see it. Several runs share a file as the groups ``run01``, ``run01/truth``, ``run02``, ...
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from dynamics.closed_loop import Reference
from identify.arrays import Array
from identify.errors import RecordError
from identify.files.dataset import (
    Variables,
    check_variables,
    described_dataset,
    group_names,
    joint_numbers,
    pose_parts,
    read_group,
    with_joint_units,
    write_groups,
)
from identify.files.versions import versions
from identify.filtering import without_gaps
from identify.record.conditions import COMMAND_TIME, OPTIONAL, check_command_times

TRUTH_GROUP = "truth"

CONVENTIONS = (
    "SI units. Pose [x y z alpha beta gamma] of the platform frame in the base frame, R = "
    "Rx(alpha) Ry(beta) Rz(gamma). Rates are time derivatives of the pose components, not the "
    "angular velocity. time is the instant of exposure."
)

VARIABLES: Variables = {
    "reference_position": (("time", "axis"), "m", "desired position of the platform"),
    "reference_orientation": (("time", "angle"), "rad", "desired orientation of the platform"),
    "reference_velocity": (("time", "axis"), "m/s", "time derivative of the desired position"),
    "reference_orientation_rate": (
        ("time", "angle"),
        "rad/s",
        "time derivative of the desired Euler angles",
    ),
    "measured_position": (
        ("time", "axis"),
        "m",
        "position measured by the sensor, NaN where it was lost",
    ),
    "measured_orientation": (
        ("time", "angle"),
        "rad",
        "orientation measured by the sensor, NaN where it was lost",
    ),
    "measured_covariance": (
        ("time", "pose_component", "pose_component_2"),
        "m2, m rad and rad2",
        "covariance of the noise of the measured pose, as the sensor states it for this frame",
    ),
    "measured_ok": (("time",), "1", "1 where the sensor measured the pose, 0 where it was lost"),
    "command": (("time", "joint"), "rad", "joint command of the visual servo from this frame on"),
}

STRETCH = "stretch"  # variable of a record with the number of the stretch that each pose belongs to

# Variables of a record whose commands have times of their own. Such a record needs no reference.
TIMED: Variables = {
    STRETCH: (
        ("time",),
        "1",
        "number of the part of the record; between two parts, commands are missing",
    ),
    **{name: own for name, own in VARIABLES.items() if name.startswith("measured")},
    "command": (("acting", "joint"), "rad", "joint command from this time on"),
}

# Variables that are NaN in frames in which the pose was lost.
MAY_BE_LOST = ("measured_position", "measured_orientation", "measured_covariance")


def build_record(
    *,
    time: ArrayLike,
    reference_pose: ArrayLike,
    reference_rate: ArrayLike,
    measured_pose: ArrayLike,
    measured_covariance: ArrayLike,
    measured_ok: ArrayLike,
    command: ArrayLike,
    command_time: ArrayLike | None = None,
    scenario_toml: str,
    robot: str,
    frame_rate_hz: float,
    seed: int | None = None,
    prismatic: bool = False,
) -> xr.Dataset:
    """Build the record of one run, in SI units and the conventions of CONVENTIONS.

    Parameters
    ----------
    time : array_like, shape (N,)
        Times of the frames, s.
    reference_pose, reference_rate : array_like, shape (N, 6)
        Desired poses and their rates.
    measured_pose : array_like, shape (N, 6)
        Measured poses. Lost poses are NaN.
    measured_covariance : array_like, shape (N, 6, 6)
        Covariances of the measured poses.
    measured_ok : array_like, shape (N,)
        1 where the pose was measured, 0 where it was lost.
    command : array_like, shape (N, n)
        Commands of the n joints, each valid from its frame on: rad, or m for prismatic joints.
    command_time : array_like, shape (N,), optional
        Times at which the commands were written to the drives, s. A command acts from this time
        on. See `identify.record.conditions`.
    scenario_toml : str
        TOML text with the timing and servo of the run, as `Scenario.to_toml` returns it.
    robot : str
        Name of the robot.
    frame_rate_hz : float
        Frame rate.
    seed : int, optional
        Seed of a simulated run. The record of a real robot has none.
    prismatic : bool
        True if the joints are prismatic.

    Returns
    -------
    xarray.Dataset
        The record.

    Raises
    ------
    RecordError
        A shape is wrong, a number is not finite (other than of a lost pose), times do not increase,
        a time of a command is impossible, or an entry of `measured_ok` is neither 1 nor 0.
    """
    logged = {} if command_time is None else {COMMAND_TIME: np.asarray(command_time, dtype=float)}
    record = described_dataset(
        {
            **logged,
            **pose_parts(
                reference_pose, "reference_pose", "reference_position", "reference_orientation"
            ),
            **pose_parts(
                reference_rate, "reference_rate", "reference_velocity", "reference_orientation_rate"
            ),
            **pose_parts(
                measured_pose, "measured_pose", "measured_position", "measured_orientation"
            ),
            "measured_covariance": np.asarray(measured_covariance, dtype=float),
            "measured_ok": np.asarray(measured_ok, dtype=np.int8),
            "command": np.asarray(command, dtype=float),
        },
        time,
        with_joint_units(VARIABLES | (OPTIONAL if logged else {}), prismatic),
        joint=joint_numbers(command),
    )
    record.attrs = described_attributes(robot, frame_rate_hz, scenario_toml)
    if seed is not None:
        record.attrs["seed"] = np.int64(seed)
    return check_record(record, "new record")


def described_attributes(robot: str, frame_rate_hz: float, scenario_toml: str) -> dict[str, object]:
    """Return the attributes that every record has."""
    return {
        "title": "Visual closed-loop experiment",
        "conventions_text": CONVENTIONS,
        "robot": robot,
        "frame_rate_hz": float(frame_rate_hz),
        "scenario": scenario_toml,
        "software": "; ".join(f"{name} {version}" for name, version in versions().items()),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def write(path: Path | str, record: xr.Dataset, truth: xr.Dataset | None = None) -> None:
    """Write one run: the record as the main group and the truth as the group ``truth``."""
    write_groups(path, record_groups(record, truth))


def record_groups(record: xr.Dataset, truth: xr.Dataset | None = None) -> dict[str, xr.Dataset]:
    """Return the groups of one run's file, which `write` writes."""
    return {"": record} if truth is None else {"": record, TRUTH_GROUP: truth}


def read(path: Path | str, run: str = "") -> xr.Dataset:
    """Read and check the record of a file, or of one of its runs (``"run01"``), without the truth.

    Raises RecordError if the file is truncated, or if `check_record` finds a fault.
    """
    return check_record(read_group(path, run), f"{path}{':' + run if run else ''}")


def run_groups(
    runs: Sequence[tuple[xr.Dataset, xr.Dataset | None]],
) -> dict[str, xr.Dataset]:
    """Return several (record, truth) pairs as the groups ``run01``, ``run01/truth``, ..."""
    groups = {}
    for number, (record, truth) in enumerate(runs, start=1):
        groups[run_name(number)] = record
        if truth is not None:
            groups[f"{run_name(number)}/{TRUTH_GROUP}"] = truth
    return groups


def read_runs(path: Path | str) -> list[xr.Dataset]:
    """Read and check the records of all runs of a file, in their order.

    Raises RecordError as `read` does, or if there are no runs in the file.
    """
    return [read(path, name) for name in run_names(path)]


def run_names(path: Path | str) -> list[str]:
    """Return the names of the runs in a file, ``["run01", "run02", ...]``.

    Raises RecordError if the file is truncated, or there are no runs in it.
    """
    names = [name for name in group_names(path) if name.startswith("run") and "/" not in name]
    if not names:
        raise RecordError(f"{path} holds no runs (groups run01, run02, ...)")
    # Sorting by text would put run100 before run11.
    return sorted(names, key=lambda name: int(name.removeprefix("run")))


def run_name(number: int) -> str:
    """Return the name of the group of the run with this number, counted from 1."""
    return f"run{number:02d}"


def poses(record: xr.Dataset, kind: str) -> Array:
    """Return the poses (N, 6), m and rad, of one kind.

    A record has the kinds ``measured``, NaN where lost, and ``reference``. A model run has the
    kinds ``initial`` and ``identified``. Raises RecordError if the dataset has no such poses.
    """
    missing = [name for name in (f"{kind}_position", f"{kind}_orientation") if name not in record]
    if missing:
        raise RecordError(
            f"the record has no {' and '.join(missing)}; it has "
            f"{', '.join(map(str, record.data_vars))}"
        )
    return np.hstack([record[f"{kind}_position"].values, record[f"{kind}_orientation"].values])


def is_timed(record: xr.Dataset) -> bool:
    """Return whether the commands of a record have times of their own."""
    return "command" in record and "acting" in record["command"].dims


def variables_of(record: xr.Dataset) -> Variables:
    """Return the variables that a record of this kind has."""
    return TIMED if is_timed(record) else VARIABLES


def check_record(record: xr.Dataset, source: str) -> xr.Dataset:
    """Return a record after a check of its variables, their shapes and numbers, and its times.

    Only numbers of lost poses can be NaN. Raises RecordError with the first fault.
    """
    variables = variables_of(record)
    check_variables(record, variables, source)
    stated = record["measured_ok"].values
    strange = np.flatnonzero((stated != 0) & (stated != 1))
    if len(strange):
        raise RecordError(
            f"{source}: measured_ok must be 1 or 0, but is {stated[strange[0]]} in frame "
            f"{strange[0]}" + (f" and wrong in {len(strange) - 1} more" if len(strange) > 1 else "")
        )
    ok = stated.astype(bool)
    for name in variables:
        values = record[name].values
        rows = values.reshape(len(values), -1)
        bad = np.flatnonzero(~np.isfinite(rows).all(axis=1) & (ok if name in MAY_BE_LOST else True))
        if len(bad):
            which = "frames that count as measured" if name in MAY_BE_LOST else "frames"
            raise RecordError(
                f"{source}: {name} is not finite in {len(bad)} {which}, first in frame {bad[0]} "
                f"({record[name].dims[0]} = {record[record[name].dims[0]].values[bad[0]]:.7g} s)"
            )
    steps = np.diff(record["time"].values)
    if not (steps > 0).all():
        raise RecordError(f"{source}: time does not increase after frame {np.argmin(steps > 0)}")
    if is_timed(record):
        _check_acting(record, source)
    else:
        check_command_times(record, source)
    return record


def _check_acting(record: xr.Dataset, source: str) -> None:
    """Check that the times of commands do not decrease, and overlap those of the poses."""
    acting = record["acting"].values
    if not np.isfinite(acting).all() or not (np.diff(acting) >= 0).all():
        row = int(np.argmin(np.append(np.diff(acting) >= 0, False)))
        raise RecordError(
            f"{source}: the times of commands must be finite and not decrease; command {row} is "
            f"at {acting[row]:.9g} s"
        )
    time = record["time"].values
    if acting[0] > time[-1] or acting[-1] < time[0]:
        raise RecordError(
            f"{source}: the commands are from {acting[0]:.6g} to {acting[-1]:.6g} s and the poses "
            f"from {time[0]:.6g} to {time[-1]:.6g} s: their clocks do not overlap"
        )


def intended_motion(record: xr.Dataset) -> Array:
    """Return the desired poses (N, 6) of a record, m and rad.

    If it holds no reference, the measured poses are returned, with lost ones interpolated.
    """
    if "reference_position" in record:
        return poses(record, "reference")
    return without_gaps(poses(record, "measured"), record["measured_ok"].values.astype(bool))


def recorded_reference(record: xr.Dataset) -> Reference:
    """Return the reference motion of a record."""
    rates = np.hstack(
        [record["reference_velocity"].values, record["reference_orientation_rate"].values]
    )
    return Reference(poses(record, "reference"), rates)
