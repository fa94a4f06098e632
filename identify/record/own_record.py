"""Records of users, from netCDF or logs, with the scenario for their identification.

A netCDF record contains its scenario and its scale anchor. A log is a CSV table, an export of
motion capture or a bag of ROS 2, and has a TOML file of the same name beside it. That file is a
scenario, of which only the sections robot, timing, servo, model, filter, identification and payload
are used. Its additional table `[record]` holds further measurements, and `[columns]` states the
names of the columns of a log.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import xarray as xr
from pydantic import Field, ValidationError

from dynamics import Robot, load_robot
from dynamics.files import is_file, is_name, parse_toml, read_text
from identify.arrays import Array
from identify.errors import RecordError
from identify.record.columns import EULER_ORDERS, Columns
from identify.record.csv_record import read_table
from identify.record.from_telemetry import record_of
from identify.record.load import store_load
from identify.record.provenance import recorded_scenario
from identify.record.readers.bags import is_bag
from identify.record.readers.mapped import read_mapped, read_otherwise
from identify.record.recording import read
from identify.record.suspicions import (
    EQUAL,
    EXPLAINED,
    better_order,
    fits,
    lag_of,
    suspicions,
    unexplained,
)
from identify.record.telemetry import Telemetry
from identify.scenario import Scenario
from identify.scenario.payload import Payload
from identify.scenario.scenario import SCENARIOS, scenario_schema
from identify.scenario.section import Section, quantity
from identify.scenario.sections import Excitation, Identification, Validation
from identify.scenario.settings_file import one_line

DESCRIPTION = "record"  # name of the table of a log's TOML file with further measurements
COLUMNS = "columns"  # name of the table of a log's TOML file with the columns of the log
# Frame rate, Hz, from which planned runs are not adapted. A scenario refuses such a rate later.
MOST_HZ = 1e6
TABLES = (".csv", ".tsv", ".txt")  # suffixes of tables


class Measured(Section):
    """Measurements in addition to the poses: the scale anchor, and the accuracy of poses."""

    anchor_value: float | None = quantity(
        None,
        "kg, N m/rad or N/m",
        "measured value of the quantity that identification.scale_anchor names: platform_mass or "
        "joint_gain",
        gt=0,
    )
    position_std_m: float | None = quantity(
        None,
        "m",
        "standard deviation of a measured position, needed if the table has no covariance columns",
        gt=0,
    )
    orientation_std_rad: float | None = quantity(
        None,
        "rad",
        "standard deviation of a measured angle, needed if the table has no covariance columns",
        gt=0,
    )
    under_payload: bool = Field(
        False, description="whether the platform carried the load of [payload]"
    )


def read_own_records(paths: list[Path]) -> tuple[list[xr.Dataset], Scenario]:
    """Read records from files, and return them with the scenario of the first record.

    Further records are of the same robot: other motions, days, settings or loads.

    Raises RecordError if a file cannot be read, or violates a rule of records (`csv_record.RULES`).
    The message names the line. Raises ScenarioError if robot, timing or servo are not valid. Raises
    dynamics.RobotFileError if there is no such robot.
    """
    pairs = [_of_log(path) if is_log(path) else _of_netcdf(path) for path in paths]
    return [record for record, _ in pairs], pairs[0][1]


def is_log(path: Path) -> bool:
    """Return whether a path is a log or the description of one, by its suffix or as a bag."""
    return path.suffix.lower() in (*TABLES, ".toml") or is_bag(path)


def is_record(path: Path) -> bool:
    """Return whether a path is a record: netCDF, a log, or a description of a log."""
    if path.suffix.lower() == ".toml":
        if not is_file(path):
            return False
        content = parse_toml(read_text(path, str(path), RecordError), str(path), RecordError)
        return DESCRIPTION in content or COLUMNS in content
    return path.suffix.lower() == ".nc" or is_log(path)


def description_file(path: Path) -> Path:
    """Return the path of the TOML file that describes a log, which can be that path itself."""
    # The name of a folder can have dots.
    return path.with_name(f"{path.name}.toml") if path.is_dir() else path.with_suffix(".toml")


@dataclass(frozen=True)
class Description:
    """Content of the TOML file that describes a log."""

    scenario: Scenario
    measured: Measured
    columns: Columns | None


def read_telemetry(path: Path, about: Description, robot: Robot) -> Telemetry:
    """Read a log and the files that its description names.

    Raises RecordError if a file cannot be read, the description lacks needed columns, or a row is
    wrong. The message names the row.
    """
    columns = about.columns
    if columns is not None and (path.suffix != ".toml" or columns.measured.file is not None):
        return read_mapped(columns, path, robot, about.scenario.timing.frame_rate_hz)
    if path.suffix == ".toml" or is_bag(path):
        raise RecordError(
            f"{description_file(path)} must name the columns of its log in [{COLUMNS}], and for "
            "another file columns.measured.file; cmmsim new record --from FILE proposes them; a "
            "log beside its TOML file is given by its own name"
        )
    return read_table(path, robot).telemetry()


def _of_netcdf(path: Path) -> tuple[xr.Dataset, Scenario]:
    record = read(path)
    return record, recorded_scenario(record)


def log_suspicions(path: Path, about: Description, telemetry: Telemetry, robot: Robot) -> list[str]:
    """Return what is likely wrong with a log, as sentences.

    They name the unit of angles or the convention of rotations with which the log would fit, if
    there is one.
    """
    columns = about.columns
    lag = lag_of(telemetry, robot).seconds
    found = suspicions(telemetry, robot, columns, lag)
    if columns is None:
        return found

    # A wrong order also changes signs and correlations of joints, so the order is judged first.
    if columns.measured.convention in EULER_ORDERS:
        fraction = unexplained(telemetry, robot, lag)
        if fraction > EXPLAINED:
            # Poses out of reach have no lag.
            own = lag if fraction < 1 else None
            names = columns.measured.other_conventions
            others = _tried(path, about, telemetry, robot, "convention", names)
            fractions = {convention: unexplained(one, robot, own) for convention, one in others}
            if said := better_order(fraction, fractions):
                return [said]
    # If the poses fit as stated, the commands are wrong, and no other units of poses are tried.
    if found and not fits(telemetry, robot, lag):
        units = [unit for unit in ("rad", "deg") if unit != columns.measured.angle_unit]
        for key, values in (
            ("angle_unit", units if len(columns.measured.orientation) == 3 else []),
            ("convention", columns.measured.other_conventions),
        ):
            tried = _tried(path, about, telemetry, robot, key, values)
            fitting = (value for value, one in tried if fits(one, robot))
            if value := next(fitting, ""):
                found[-1] += f"; with {key} = {value!r} of the poses it would fit"
                break
    return found


def equal_orders(path: Path, about: Description, telemetry: Telemetry, robot: Robot) -> list[str]:
    """Return other orders of Euler angles with which a log fits as well as with the stated one."""
    columns = about.columns
    if columns is None or columns.measured.convention not in EULER_ORDERS:
        return []
    names = [name for name in EULER_ORDERS if name != columns.measured.convention]
    # The lag of a wrong order, which fits nowhere, would be searched over the whole record.
    lag = lag_of(telemetry, robot).seconds
    most = EQUAL * unexplained(telemetry, robot, lag)
    others = _tried(path, about, telemetry, robot, "convention", names)
    return [name for name, one in others if unexplained(one, robot, lag) <= most]


def _tried(
    path: Path,
    about: Description,
    telemetry: Telemetry,
    robot: Robot,
    key: str,
    values: Iterable[str],
) -> Iterator[tuple[str, Telemetry]]:
    """Yield values of a key of the measured columns with which the log can be read, and the log."""
    columns = about.columns
    assert columns is not None
    others = [columns.measured.model_copy(update={key: value}) for value in values]
    rate_hz = about.scenario.timing.frame_rate_hz
    for other, log in read_otherwise(columns, path, robot, rate_hz, telemetry.poses, others):
        yield getattr(other, key), replace(telemetry, poses=log)


def _of_log(path: Path) -> tuple[xr.Dataset, Scenario]:
    about = read_description(description_file(path), path)
    scenario, measured = about.scenario, about.measured
    robot = load_robot(scenario.robot)
    telemetry = read_telemetry(path, about, robot)
    if about.columns is not None and (found := log_suspicions(path, about, telemetry, robot)):
        raise RecordError("; ".join(found))
    # Covariances in the log itself take precedence.
    stated = np.eye(6) if telemetry.poses.covariance is not None else _stated(measured, path)
    record = record_of(telemetry, robot, scenario.timing, scenario.to_toml(), stated)
    record.attrs["title"] = f"Record of {path.name}"
    _state_anchor(record, scenario.identification, measured, description_file(path))
    if measured.under_payload:
        _state_payload(record, scenario.payload)
    return record, scenario


def read_description(path: Path, log: Path) -> Description:
    """Read the description of a log.

    Raises RecordError or ScenarioError if there is no such file, it is not TOML, or its content is
    not valid.
    """
    if not is_file(path):
        # The description may name other files in place of the table beside it.
        if log.suffix.lower() in TABLES and not log.exists():
            raise RecordError(f"there is no record {log}")
        raise RecordError(
            f"there is no file {path}, which must describe the record {log.name}; cmmsim new "
            "record writes both"
        )
    content = parse_toml(read_text(path, str(path), RecordError), str(path), RecordError)
    measured = _section(Measured, content.pop(DESCRIPTION, {}), f"{path}: [{DESCRIPTION}]")
    named = content.pop(COLUMNS, None)
    columns = None if named is None else _section(Columns, named, f"{path}: [{COLUMNS}]")
    # A scenario needs a name, but this file does not have to state it.
    name = path.stem if is_name(path.stem) else DESCRIPTION
    whole = with_whole_frames({"name": name} | content)
    scenario = SCENARIOS.from_dict(whole, str(path), path.parent)
    return Description(scenario, measured, columns)


def with_whole_frames(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return a scenario whose planned runs last a whole number of frames at a record's rate.

    A scenario must have such durations. An identification does not read them, and the record can
    have any rate. Durations that the content states remain.
    """
    timing = content.get("timing")
    rate = timing.get("frame_rate_hz") if isinstance(timing, Mapping) else None
    whole = dict(content)
    if isinstance(rate, int | float) and 0 < rate < MOST_HZ:
        for section, planned in (("excitation", Excitation()), ("validation", Validation())):
            frames = round(planned.duration_s * rate)
            if frames != planned.duration_s * rate and section not in content:
                whole[section] = {"duration_s": frames / rate}
    return whole


Model = TypeVar("Model", bound=Section)


def _section(model: type[Model], content: object, source: str) -> Model:
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise RecordError(f"{source} {one_line(error, model)}") from error


def record_schema() -> dict[str, Any]:
    """Return the JSON schema of the TOML files beside CSV records.

    Editors read it from the file `record.schema.json`.
    """
    schema = scenario_schema()
    schema["required"].remove("name")
    for table, model in ((DESCRIPTION, Measured), (COLUMNS, Columns)):
        own = model.model_json_schema()
        schema["properties"][table] = {"$ref": f"#/$defs/{model.__name__}"}
        schema["$defs"] |= own.pop("$defs", {}) | {model.__name__: own}
    return schema


def _stated(measured: Measured, path: Path) -> Array:
    """Return the covariance (6, 6) of a measured pose that the description states."""
    if measured.position_std_m is None or measured.orientation_std_rad is None:
        raise RecordError(
            f"{path} has no covariance columns, so {description_file(path)} must state "
            f"position_std_m and orientation_std_rad in [{DESCRIPTION}], the standard deviations "
            "of a measured pose"
        )
    return np.diag(np.repeat([measured.position_std_m, measured.orientation_std_rad], 3) ** 2)


def _state_anchor(
    record: xr.Dataset, settings: Identification, measured: Measured, source: Path
) -> None:
    """Store with a record its scale anchor. Raises RecordError if the measured value is missing."""
    record.attrs["scale_anchor"] = settings.scale_anchor
    # These two anchors have no measured value.
    if settings.scale_anchor in ("payload", "prior"):
        return
    if measured.anchor_value is None or settings.anchor_std is None:
        raise RecordError(
            f"{source}: the scale anchor {settings.scale_anchor} needs the measured value, "
            f"anchor_value in [{DESCRIPTION}], and its standard deviation, anchor_std in "
            "[identification]"
        )
    record.attrs |= {
        "scale_anchor_value": measured.anchor_value,
        "scale_anchor_std": settings.anchor_std,
    }


def _state_payload(record: xr.Dataset, payload: Payload) -> None:
    """Store with a record the load on the platform and its standard deviations."""
    store_load(record, np.array(payload.figures), np.array(payload.figures_std))
