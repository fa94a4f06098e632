"""Provenance of records and results: scenario, seed, robot, and digests of the files read.

If a stage is repeated, the files of later stages stay in the folder. The later stages use the
digests to detect files that no longer belong together.
"""

import json
from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from dynamics import Robot
from identify.arrays import Array
from identify.errors import EstimationError, RecordError, ScenarioError
from identify.files.dataset import plain, read_covariance, shown
from identify.files.run_folder import RunFolder, load_result
from identify.record.conditions import OPTIONAL
from identify.record.load import ADDED
from identify.record.model_runs import read_model_runs
from identify.record.recording import read, read_runs, variables_of
from identify.scenario import Scenario, scenario_from_toml

# Attribute with the geometry of the robot file. The name of a robot alone does not identify the
# file.
ROBOT = "robot_geometry"
ROUNDING = 1e-9  # largest difference of a geometric number, SI units, that counts as rounding
# Numbers of a geometry that do not depend on the kind of its legs.
SHARED = ("base_joints", "platform_joints", "home_pose", "travel_limit", "gravity")

# Attributes that an identification reads, in addition to the scenario's timing and servo.
STATED = (
    "robot",
    ROBOT,
    "seed",
    "frame_rate_hz",
    "scale_anchor",
    "scale_anchor_value",
    "scale_anchor_std",
    *ADDED,
    *(f"{name}_std" for name in ADDED),
)

# Entry of a result with the digest of each file, by file name. Results of older versions do not
# have this entry, and are not checked.
ENTRY = "made_of"
RECORDS = ("experiment.nc", "payload.nc")  # files with records for an identification
# Stage that must be repeated after a change of a file. For other files it is `identify`.
_AGAIN = {"validation.nc": "validate", "model.nc": "validate"}


def recorded_scenario(record: xr.Dataset) -> Scenario:
    """Return the scenario that a record was made with.

    Raises RecordError if the record does not state a scenario, or if the scenario is not valid.
    """
    text = record.attrs.get("scenario")
    if text is None:
        raise RecordError(
            "the record has no attribute scenario, which states its timing and servo: "
            "set record.attrs['scenario'] = scenario.to_toml(), or make the record by "
            "identify.build_record"
        )
    if not isinstance(text, str):
        raise RecordError(
            f"the record's attribute scenario is {shown(text)}, must be TOML text: "
            "scenario.to_toml()"
        )
    try:
        return _scenario_of(text, Path.cwd())
    except ScenarioError as error:
        raise RecordError(str(error)) from error


@lru_cache(maxsize=8)
def _scenario_of(text: str, folder: Path) -> Scenario:
    """Read the scenario of records, from a cache.

    Records of one experiment share a scenario, and are checked several times. Paths in it are
    relative to the current folder, so this `folder` is part of the key of the cache.
    """
    return scenario_from_toml(text, "the record's attribute scenario")


def recorded_seed(record: xr.Dataset) -> int:
    """Return the seed of a record, or zero if it has none, like the record of a real robot.

    Raises RecordError unless the seed is a whole number >= 0.
    """
    seed = record.attrs.get("seed", 0)
    if isinstance(seed, bool | np.bool_) or not isinstance(seed, int | np.integer) or seed < 0:
        raise RecordError(
            f"the record's attribute seed is {shown(seed)}, must be a whole number >= 0"
        )
    return int(seed)


def store_robot(record: xr.Dataset, robot: Robot) -> None:
    """Store the geometry of the robot file with the record, as JSON."""
    record.attrs[ROBOT] = json.dumps(_numbers(robot))


def check_robot(record: xr.Dataset, robot: Robot) -> None:
    """Check that a record is of a robot with this name and, if stated, with this geometry.

    Raises EstimationError if the name or a number of the geometry differs. The message names the
    number. Raises RecordError if the geometry cannot be read, or its numbers have other shapes.
    """
    if record.attrs.get("robot") != robot.name:
        raise EstimationError(
            f"the record is of robot {shown(record.attrs.get('robot'))}, not of {robot.name!r}"
        )
    if ROBOT not in record.attrs:
        return
    recorded = _read(record.attrs[ROBOT])
    for name, ours in _numbers(robot).items():
        theirs = recorded.get(name, np.zeros(0))
        known = np.asarray(ours)
        if theirs.shape != known.shape:
            raise RecordError(
                f"{name} in the record's {ROBOT} has shape {theirs.shape}, expected {known.shape}"
            )
        error = np.abs(theirs - known)
        if not error.max() <= ROUNDING:
            worst = np.unravel_index(int(np.argmax(error)), error.shape)
            indices = "".join(f"[{k + 1}]" for k in worst)
            raise EstimationError(
                f"the record is of another robot {robot.name!r}: {name}{indices} was "
                f"{theirs[worst]:.9g} when it was made, but is {known[worst]:.9g} in the robot file"
            )


def _numbers(robot: Robot) -> dict[str, Any]:
    """Return all numbers of a geometry by name. A number of a leg is named `leg2.crank_length`."""
    geometry = robot.geometry
    numbers: dict[str, Any] = {
        **{name: np.asarray(getattr(geometry, name)).tolist() for name in SHARED},
        "freedoms": list(geometry.chart.freedoms),
    }
    for number, leg in enumerate(geometry.legs, start=1):
        own = leg.model_dump(exclude={"base_joint", "platform_joint", "type"})
        numbers |= {
            f"leg{number}.{name}": np.asarray(value).tolist() for name, value in own.items()
        }
    return numbers


def _read(text: object) -> dict[str, Array]:
    try:
        return {
            name: np.asarray(values, dtype=float) for name, values in json.loads(str(text)).items()
        }
    except (ValueError, TypeError, AttributeError) as error:
        raise RecordError(
            f"the record's attribute {ROBOT} is not a JSON object of numbers: {error}"
        ) from error


class RunFiles:
    """Contents of the files of a run. Each file is read once, at its first use.

    Reading a damaged file raises RecordError.
    """

    def __init__(self, folder: RunFolder) -> None:
        self.folder = folder

    experiment = cached_property(lambda self: read(self.folder.experiment))
    # Record of the same motion under a known load.
    payload = cached_property(lambda self: read(self.folder.payload))
    validation = cached_property(lambda self: read_runs(self.folder.validation))
    model = cached_property(lambda self: read_model_runs(self.folder.model))

    # Names of the estimates, and their covariance.
    named_covariance = cached_property(lambda self: read_covariance(self.folder.covariance))

    @property
    def covariance(self) -> Array:
        """Covariance (p + k, p + k) of the p estimates and the k common errors of the poses.

        For a result without common errors, k = 0.
        """
        return self.named_covariance[1]

    def covariance_of(self, robot: Robot) -> Array:
        """Return `covariance` after a check that it belongs to the parameters of a robot.

        Raises RecordError if the file has other parameters.
        """
        names = robot.layout.names
        found = self.named_covariance[0][: len(names)]
        if found != names:
            said = ", ".join(sorted(set(found) ^ set(names))) or "another order"
            raise RecordError(
                f"{self.folder.covariance} has other parameters than the result: {said}"
            )
        return self.covariance

    def content(self, name: str) -> Any:
        """Return the content of a file by its name, such as ``experiment.nc``."""
        stem = name.removesuffix(".nc")
        # Further records have numbered names, and no property of their own.
        return getattr(self, stem) if hasattr(type(self), stem) else read(self.folder.path / name)

    def digests(self, *names: str) -> dict[str, str]:
        """Return digests of files by their names."""
        return {name: digest(self.content(name)) for name in names}

    def check_made_of(self, *names: str, result: Mapping[str, Any] | None = None) -> None:
        """Check that a result was made from the present files of these names.

        Files without a digest in the result are not checked. With `experiment.nc`, its further
        records are checked, too. The default result is that in the folder, if there is one.

        Raises OutputFolderError if a file is missing. Raises RecordError if a file has changed (the
        message names the stage to repeat), a file is damaged, or the digests of the result are not
        valid.
        """
        run = self.folder
        if result is None:
            result = load_result(run.result) if run.result.is_file() else {}
        known = result.get(ENTRY, {})
        if not isinstance(known, dict):
            raise RecordError(f"{run.result}: {ENTRY} must be digests by file name")
        further = [name for name in known if name.startswith("experiment")]
        names = (*names, *(further if RECORDS[0] in names else ()))
        for name in dict.fromkeys(name for name in names if name in known):
            run.require(name)
            if self.digests(name)[name] != known[name]:
                is_record = name in RECORDS or name in further
                what = f"another record than {name}" if is_record else f"another {name}"
                stage = _AGAIN.get(name, "identify")
                raise RecordError(
                    f"{run.result} is of {what}: run `cmmsim {stage} --out {run.path}` again"
                )


def digest(content: xr.Dataset | Sequence[xr.Dataset] | Mapping[str, xr.Dataset] | Array) -> str:
    """Return the hexadecimal digest of one or several records, of model runs, or of a covariance.

    The digest depends on the order of records, and on the names of model runs. It depends only on
    data that later stages read, and not on the file or the time of writing. Raises RecordError for
    a record that does not state its scenario.
    """
    if isinstance(content, np.ndarray):
        return array_digest({"covariance": content})
    if isinstance(content, xr.Dataset):
        return _record_digest([content])
    if isinstance(content, Mapping):
        variables = {
            f"{run}/{name}": one[name].values
            for run, one in content.items()
            for name in one.data_vars
        }
        return array_digest(variables)
    return _record_digest(content)


def array_digest(arrays: Mapping[str, ArrayLike]) -> str:
    """Return the hexadecimal digest of named arrays of numbers, whatever their order and type.

    A digest of the bytes of a file would differ each time the file is written.
    """
    whole = sha256()
    for name in sorted(arrays):
        values = np.ascontiguousarray(arrays[name], dtype="<f8")
        whole.update(f"{name} {values.shape}\n".encode())
        # NaN has many bit patterns, and np.where replaces them by one.
        whole.update(np.where(np.isnan(values), np.nan, values).tobytes())
    return whole.hexdigest()


def _record_digest(records: Sequence[xr.Dataset]) -> str:
    whole = sha256()
    for record in records:
        # A new title or date does not make another record.
        optional = (*OPTIONAL, "acting")
        held = ("time", *variables_of(record), *(name for name in optional if name in record))
        arrays = {name: record[name].values for name in held}
        stated = {name: plain(record.attrs[name]) for name in STATED if name in record.attrs}
        scenario = recorded_scenario(record)
        stated |= {
            section: getattr(scenario, section).model_dump(mode="json")
            for section in ("timing", "servo")
        }
        whole.update(
            f"{array_digest(arrays)} {json.dumps(stated, sort_keys=True, default=str)}\n".encode()
        )
    return whole.hexdigest()
