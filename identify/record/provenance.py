"""Where a record comes from: its scenario, seed and robot, and the digests of the files that a result was made of.

Which files a result was made of, by their digests: a file that was changed or replaced since is refused.
A stage that is repeated leaves the files of later ones where they are, and these stages tell what is no longer theirs.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import fields
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from dynamics import Robot
from identify.arrays import Array
from identify.errors import EstimationError, RecordError, ScenarioError
from identify.files.dataset import read_covariance, shown
from identify.files.run_folder import RunFolder, load_result
from identify.loop_parameters import NAMES
from identify.record.payload import ADDED
from identify.record.recording import VARIABLES, read, read_model_runs, read_runs
from identify.scenario import Scenario, scenario_from_toml

# What a record states of its own making: the scenario it was made with, and the seed of what was drawn for it.


def recorded_scenario(record: xr.Dataset) -> Scenario:
    """The scenario that a record was made with.

    Raises:
        RecordError: the record states none, with what to set; or one that is no scenario.
    """
    text = record.attrs.get("scenario")
    if text is None:
        raise RecordError(
            "the record has no attribute scenario, which says with what timing and servo it was made: set "
            "record.attrs['scenario'] = scenario.to_toml(), or make the record by identify.build_record"
        )
    if not isinstance(text, str):
        raise RecordError(f"the record's attribute scenario is {shown(text)}, must be TOML text: scenario.to_toml()")
    try:
        return scenario_from_toml(text, "the record's attribute scenario")
    except ScenarioError as error:
        raise RecordError(str(error)) from error


def recorded_seed(record: xr.Dataset) -> int:
    """The seed of a record; zero where it states none, as the record of a real robot.

    Raises:
        RecordError: one that is no whole number >= 0.
    """
    seed = record.attrs.get("seed", 0)
    if isinstance(seed, bool | np.bool_) or not isinstance(seed, int | np.integer) or seed < 0:
        raise RecordError(f"the record's attribute seed is {shown(seed)}, must be a whole number >= 0")
    return int(seed)


# The geometry of the robot that a record is of, kept with it: a name alone does not say which robot file was meant.


ATTRIBUTE = "robot_geometry"

ROUNDING = 1e-9
"""Largest difference of any number [SI] that another computer's arithmetic may make."""


def store_robot(record: xr.Dataset, robot: Robot) -> None:
    """Keep the geometry of the robot file with the record, as JSON."""
    record.attrs[ATTRIBUTE] = json.dumps(_numbers(robot))


def check_robot(record: xr.Dataset, robot: Robot) -> None:
    """The record must be of a robot of this name and, where it states one, of this geometry.

    Raises:
        EstimationError: another name, or the first number of the geometry that differs.
        RecordError: a geometry that cannot be read.
    """
    if record.attrs.get("robot") != robot.name:
        raise EstimationError(f"the record is of robot {shown(record.attrs.get('robot'))}, not of {robot.name!r}")
    if ATTRIBUTE not in record.attrs:
        return
    recorded = _read(record.attrs[ATTRIBUTE])
    for name, ours in _numbers(robot).items():
        theirs, known = recorded.get(name, np.zeros(0)), np.asarray(ours)
        if theirs.shape != known.shape:
            raise RecordError(f"{name} in the record's {ATTRIBUTE} has shape {theirs.shape}, expected {known.shape}")
        gap = np.abs(theirs - known)
        if not gap.max() <= ROUNDING:
            worst = np.unravel_index(int(np.argmax(gap)), gap.shape)
            place = "".join(f"[{k + 1}]" for k in worst)
            raise EstimationError(
                f"the record is of another robot {robot.name!r}: {name}{place} was {theirs[worst]:.9g} when it was "
                f"made, the robot file says {known[worst]:.9g}"
            )


def _numbers(robot: Robot) -> dict[str, Any]:
    geometry = robot.geometry
    return {field.name: np.asarray(getattr(geometry, field.name)).tolist() for field in fields(geometry)}


def _read(text: object) -> dict[str, Array]:
    try:
        return {name: np.asarray(values, dtype=float) for name, values in json.loads(str(text)).items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise RecordError(f"the record's attribute {ATTRIBUTE} is no JSON object of numbers: {error}") from error


# A digest of records: equal where an identification reads the same, in whatever file and whenever it was written.


STATED = (
    "robot", ATTRIBUTE, "seed", "frame_rate_hz", "scale_anchor", "scale_anchor_value", "scale_anchor_std",
    *ADDED, *(f"{name}_std" for name in ADDED),
)  # fmt: skip
"""Attributes that an identification reads; beside them timing and servo of the scenario."""


def array_digest(arrays: Mapping[str, ArrayLike]) -> str:
    """Digest of named arrays of numbers, hexadecimal; their order and their type do not matter."""
    whole = sha256()
    for name in sorted(arrays):
        values = np.ascontiguousarray(arrays[name], dtype="<f8")
        whole.update(f"{name} {values.shape}\n".encode())
        whole.update(np.where(np.isnan(values), np.nan, values).tobytes())  # one of the many bit patterns of NaN
    return whole.hexdigest()


def record_digest(*records: xr.Dataset) -> str:
    """Digest of one or several records in their order, hexadecimal.

    Raises RecordError for a record that does not state its scenario.
    """
    whole = sha256()
    for record in records:
        arrays = {name: record[name].values for name in ("time", *VARIABLES)}
        stated = {name: _plain(record.attrs[name]) for name in STATED if name in record.attrs}
        scenario = recorded_scenario(record)
        stated |= {section: getattr(scenario, section).model_dump(mode="json") for section in ("timing", "servo")}
        whole.update(f"{array_digest(arrays)} {json.dumps(stated, sort_keys=True, default=str)}\n".encode())
    return whole.hexdigest()


def _plain(value: object) -> object:
    return value.item() if isinstance(value, np.generic) else value


ENTRY = "made_of"
"""Of a result: digests by the file's name. Results of older versions have none, and nothing is asked of them."""

RECORDS = ("experiment.nc", "payload.nc")
"""What an identification may have read."""


def _of_models(path: Path) -> str:
    runs = read_model_runs(path)
    return array_digest({f"{run}/{name}": runs[run][name].values for run in runs for name in runs[run].data_vars})


_DIGESTS: Mapping[str, Callable[[Path], str]] = {
    "experiment.nc": lambda path: record_digest(read(path)),
    "payload.nc": lambda path: record_digest(read(path)),
    "covariance.nc": lambda path: array_digest({"covariance": read_covariance(path, NAMES)}),
    "validation.nc": lambda path: record_digest(*read_runs(path)),
    "model.nc": _of_models,
}

_AGAIN = {"validation.nc": "validate", "model.nc": "validate"}
"""The stage that makes a result of the file as it now is, where it is not `identify`."""


def file_digests(run: RunFolder, *names: str) -> dict[str, str]:
    """Digests of the content of files of a run, by name. Raises RecordError for one that is damaged."""
    return {name: _DIGESTS[name](run.path / name) for name in names}


def check_made_of(run: RunFolder, result: Mapping[str, Any], *names: str) -> None:
    """Refuse files of these names that are not those that the result was made of, as far as it states them.

    Raises:
        OutputFolderError: one of them is gone.
        RecordError: one of them is another, with the stage to repeat; or damaged; or digests that are none.
    """
    known = result.get(ENTRY, {})
    if not isinstance(known, dict):
        raise RecordError(f"{run.result}: {ENTRY} must be digests by the file's name")
    for name in names:
        if name not in known:
            continue
        run.require(name)
        if file_digests(run, name)[name] != known[name]:
            what = f"another record than {name}" if name in RECORDS else f"another {name}"
            stage = _AGAIN.get(name, "identify")
            raise RecordError(f"{run.result} is of {what}: run `cmmsim {stage} --out {run.path}` again")


def check_folder(run: RunFolder, *names: str) -> None:
    """As `check_made_of`, by the result of the folder where it has one."""
    if run.result.is_file():
        check_made_of(run, load_result(run.result), *names)
