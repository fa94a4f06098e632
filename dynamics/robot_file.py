"""Robot files: TOML with a geometry and parameter sets. Some are built in; others have a path."""

from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import resources
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field, ValidationError, field_validator, model_validator

from dynamics.body_mesh import BodyMesh
from dynamics.checks import Acceleration, Place, Travel, check_inertia_forms, shown
from dynamics.errors import DynamicsError, RobotFileError
from dynamics.files import Name, check_name, is_file, parse_toml, read_text
from dynamics.geometry import RobotGeometry
from dynamics.kinematics.platform import FREEDOMS, Chart
from dynamics.legs import KINDS, AnyLeg
from dynamics.parameter_set import Parameters, ParameterSet, Strict, Unstated, parameter_set

MOST_MESHES = 100  # largest number of meshes of a robot
MOST_FAULTS = 24  # largest number of faults in a message: four for each of six legs


class Family(NamedTuple):
    """Family of robots with legs of one kind: the kind, the number of legs, and the chart."""

    kind: str
    legs: int
    chart: str


FAMILIES = {
    "rss6": Family("rss", 6, "free"),
    "rus6": Family("rus", 6, "free"),
    "ups6": Family("ups", 6, "free"),
    "pss6": Family("pss", 6, "free"),
    "pus6": Family("pus", 6, "free"),
    "delta3": Family("parallelogram", 3, "translation"),
    "rrr3": Family("rrr", 3, "planar"),
}


class RobotFile(Strict):
    """A parallel robot. Lengths are in m, angles in rad, masses in kg.

    A pose is [x y z alpha beta gamma].
    """

    name: Name = Field(description="name of the robot in records and reports")
    family: str | None = Field(
        None, description=f"one of {', '.join(FAMILIES)}; determines the kind of legs and the chart"
    )
    chart: str | None = Field(
        None, description=f"freedoms of the platform, if there is no family: {', '.join(FREEDOMS)}"
    )
    home_pose: list[Place] = Field(
        min_length=6, max_length=6, description="pose of the platform at home, m and rad"
    )
    travel_limit: Travel = Field(description="largest magnitude of a joint coordinate, rad or m")
    gravity: list[Acceleration] = Field(
        [0.0, 0.0, -9.81], min_length=3, max_length=3, description="m/s^2, base axes"
    )
    inertia: Literal["centred", "full"] | dict[str, Literal["centred", "full"]] = Field(
        "centred",
        description="full: bodies have ten inertial parameters instead of four; for all bodies, or "
        'a table by body or kind of body, such as { platform = "full", link3 = "full" }',
    )
    unstated: Unstated = Field(
        Unstated(),
        description="standard deviations of the differences between the model and real bodies and "
        "passive joints; 0 if they are exact",
    )
    legs: list[Annotated[AnyLeg, Field(discriminator="type")]] = Field(
        description="a table for each leg or, with a family, a single table in which each key has "
        "one value or a list with one value per leg"
    )
    meshes: list[BodyMesh] = Field(
        [],
        max_length=MOST_MESHES,
        description="meshes in place of the drawn rods of bodies of the legs; they hide stickers",
    )
    parameters: dict[str, Parameters] = Field(
        description="named sets: `guess` is the initial guess of an identification, and `truth` "
        "is the robot that an experiment simulates by default"
    )

    @field_validator("inertia", mode="before")
    @classmethod
    def _forms_are_known(cls, value: object) -> object:
        return check_inertia_forms(value)

    @model_validator(mode="before")
    @classmethod
    def _by_family(cls, values: Any) -> Any:
        """Complete the types of the legs, and the chart, from the family, which must be known."""
        if not isinstance(values, dict) or "legs" not in values:
            return values
        name = values.get("family")
        if name is None:
            if isinstance(values["legs"], dict):
                raise ValueError(
                    "legs: a file without family needs one table [[legs]] for each leg, with its "
                    "type"
                )
            _check_types(values["legs"])
            return values
        if name not in FAMILIES:
            raise ValueError(f"family: unknown `{name}`; valid: {', '.join(FAMILIES)}")
        family = FAMILIES[name]
        legs = values["legs"]
        if isinstance(legs, dict):
            legs = _legs_of_columns(legs, family)
        if isinstance(legs, list):
            legs = [{"type": family.kind} | leg if isinstance(leg, dict) else leg for leg in legs]
        _check_types(legs)
        return values | {"legs": legs, "chart": values.get("chart") or family.chart}


def robot_schema() -> dict[str, Any]:
    """JSON schema of robot files, for editors.

    It is saved in `dynamics/robots/robot.schema.json`.
    """
    schema = RobotFile.model_json_schema()
    leg_tables = schema["properties"]["legs"]
    columns = {
        "type": "object",
        "description": "with a family: each key has one value, or a list with one value per leg",
    }
    schema["properties"]["legs"] = {
        "anyOf": [leg_tables, columns],
        "description": leg_tables.pop("description"),
    }
    return schema


def _check_types(legs: Any) -> None:
    """Raise ValueError for a leg of an unknown kind, or with a key in the plural."""
    for number, leg in enumerate(legs if isinstance(legs, list) else (), 1):
        if isinstance(leg, dict) and leg.get("type") not in KINDS:
            raise ValueError(
                f"leg {number}: its type is {leg.get('type')!r}; valid: {', '.join(KINDS)}"
            )
        if isinstance(leg, dict):
            _check_singular(leg, number)


def _check_singular(leg: dict[str, Any], number: int) -> None:
    """Raise ValueError for a key of one leg in the plural, which is for all legs."""
    names = KINDS[leg["type"]].model_fields
    for name in names:
        if plural(name) in leg and plural(name) not in names:
            raise ValueError(
                f"leg {number}: {plural(name)} is a key of all legs, in the table [legs]; in a "
                f"table [[legs]] of one leg it is {name}"
            )


def _legs_of_columns(columns: dict[str, Any], family: Family) -> list[dict[str, Any]]:
    """Tables of the legs, from one table with columns.

    A column is one value for all legs, or a list with one value per leg.
    """
    fields = {plural(name): name for name in KINDS[family.kind].model_fields}
    missing = [
        key
        for key, name in fields.items()
        if key not in columns and KINDS[family.kind].model_fields[name].is_required()
    ]
    legs: list[dict[str, Any]] = [{} for _ in range(family.legs)]
    for key, value in columns.items():
        name = fields.get(key)
        if name is None and key in fields.values():
            raise ValueError(
                f"legs: {key} is a key of one leg, in a table [[legs]]; in the table [legs] of all "
                f"legs it is {plural(key)}"
            )
        if name is None:
            raise ValueError(f"legs: unknown key {key}; valid: {', '.join(fields)}")
        vector = KINDS[family.kind].model_fields[name].annotation is np.ndarray
        per_leg = isinstance(value, list) and (
            not vector or (bool(value) and isinstance(value[0], list))
        )
        if per_leg and len(value) != family.legs:
            raise ValueError(
                f"legs.{key} needs one value, or a list of {family.legs} values, got {len(value)}"
            )
        for number, leg in enumerate(legs):
            leg[name] = value[number] if per_leg else value
    if missing and columns.get("type", family.kind) == family.kind:
        raise ValueError(f"legs: {', '.join(missing)}: Field required")
    return legs


def plural(name: str) -> str:
    """Key of the column of a field: `slider_axes` for `slider_axis`. A length keeps its name."""
    if name.endswith("axis"):
        return name.removesuffix("axis") + "axes"
    return name + "s" if name.endswith(("joint", "direction")) else name


@dataclass(frozen=True)
class RobotDescription:
    """Content of a robot file. Raises RobotFileError for a name that cannot be a file name."""

    name: str
    geometry: RobotGeometry
    parameter_sets: dict[str, ParameterSet]

    def __post_init__(self) -> None:
        try:
            check_name(self.name)
        except ValueError as error:
            raise RobotFileError(f"the robot's name {error}") from None


def built_in_robots() -> list[str]:
    """Names of the built-in robots.

    Returns
    -------
    list of str
        Names that `load_robot` accepts.

    Raises
    ------
    OSError
        If the folder of the robots cannot be read.

    Examples
    --------
    >>> import dynamics
    >>> "rss6" in dynamics.built_in_robots()
    True
    """
    folder = resources.files("dynamics") / "robots"
    return sorted(
        Path(entry.name).stem for entry in folder.iterdir() if entry.name.endswith(".toml")
    )


def read_robot_file(name_or_path: str | Path) -> RobotDescription:
    """Read a built-in robot by its name, or a TOML robot file by its path.

    Raises RobotFileError for an unknown name, with the valid names; for a file that cannot be read;
    for an unknown or missing key, with the tables that it is in; and for geometry or parameters
    that are not valid.
    """
    source, text = _read_text(name_or_path)
    return parsed_robot(text, f"robot file {source}", Path(source).absolute().parent)


def parsed_robot(text: str, source: str, folder: Path = Path()) -> RobotDescription:
    """Robot from the text of a robot file. `source` is the name of the file in messages.

    Paths of meshes are relative to `folder`. Raises the same errors as `read_robot_file`.
    """
    found = _parsed_robot(text, source, folder)
    # a caller may change the table of its sets; all else is read-only
    return replace(found, parameter_sets=dict(found.parameter_sets))


@lru_cache(maxsize=32)
def _parsed_robot(text: str, source: str, folder: Path) -> RobotDescription:
    """Robot from a text, which a process parses once: assembling six legs takes 20 ms."""
    try:
        content = RobotFile.model_validate(parse_toml(text, source, RobotFileError))
    except ValidationError as error:
        raise RobotFileError(f"{source}: {_one_line(error)}") from error
    try:
        geometry = _geometry(content, folder)
        sets = {
            name: parameter_set(name, values, geometry.layout)
            for name, values in content.parameters.items()
        }
    except DynamicsError as error:
        raise RobotFileError(f"{source}: {error}") from error
    if "guess" not in sets:
        raise RobotFileError(
            f"{source} needs a parameter set `guess` (what is known beforehand); it has "
            f"{sorted(sets) or 'none'}"
        )
    return RobotDescription(content.name, geometry, sets)


def _geometry(content: RobotFile, folder: Path) -> RobotGeometry:
    """Geometry of a robot file in a folder. Raises RobotFileError or ParameterError for faults."""
    if content.chart is None:
        raise RobotFileError(f"a file without family needs a chart; valid: {', '.join(FREEDOMS)}")
    if content.chart not in FREEDOMS:
        raise RobotFileError(f"unknown chart `{content.chart}`; valid: {', '.join(FREEDOMS)}")
    _check_units(content)
    chart = Chart(content.chart, tuple(content.home_pose))
    forms = {"all": content.inertia} if isinstance(content.inertia, str) else content.inertia
    full = tuple(name for name, form in forms.items() if form == "full")
    passive = dict.fromkeys(
        name for values in content.parameters.values() for name in values.passive_values
    )
    meshes = [mesh.model_copy(update={"file": str(folder / mesh.file)}) for mesh in content.meshes]
    return RobotGeometry(
        tuple(content.legs),
        chart,
        content.travel_limit,
        np.array(content.gravity),
        full,
        own_gains=any(values.own_gains for values in content.parameters.values()),
        passive_friction=tuple(passive),
        unstated=content.unstated,
        meshes=tuple(meshes),
    )


# Largest ratio of a position of home, of the travel of sliders, or of the length of a leg at
# coordinate zero, to the size of the robot. A larger number is likely in mm.
MOST_SIZES = 50.0
# Largest travel of joints that turn, and angle of home, rad. Larger ones are likely in degrees.
MOST_TRAVEL = 4 * np.pi
MOST_ANGLE = 2 * np.pi


def _check_units(content: RobotFile) -> None:
    """Raise RobotFileError for a home, a travel or a leg that is likely in mm or in degrees.

    The size of the robot is the largest coordinate of a joint on base or platform.
    """
    size = max(np.abs([*leg.base_joint, *leg.platform_joint]).max() for leg in content.legs)
    far = max(content.home_pose[:3], key=abs)
    angle = max(content.home_pose[3:], key=abs)
    travel = content.travel_limit
    slides = content.legs[0].prismatic
    longest = max(getattr(leg, "zero_length", 0.0) for leg in content.legs)
    inside = f"all joints on base and platform lie within {size:.3g} m of their frames"
    if abs(far) > MOST_SIZES * size > 0:
        found = f"home_pose has a position of {far:g} m, and {inside}", "mm", 1e-3 * far, "m"
    elif longest > MOST_SIZES * size > 0:
        found = f"zero_length is {longest:g} m, and {inside}", "mm", 1e-3 * longest, "m"
    elif abs(angle) > MOST_ANGLE:
        found = f"home_pose has an angle of {angle:g} rad", "degrees", np.radians(angle), "rad"
    elif slides and travel > MOST_SIZES * size > 0:
        found = f"travel_limit is {travel:g} m, and {inside}", "mm", 1e-3 * travel, "m"
    elif not slides and travel > MOST_TRAVEL:
        turns = travel / (2 * np.pi)
        text = f"travel_limit is {travel:g} rad, {turns:.3g} turns"
        found = text, "degrees", np.radians(travel), "rad"
    else:
        return
    text, other, value, unit = found
    raise RobotFileError(f"{text}; if it is in {other}, it is {value:.6g} in {unit}")


def _read_text(name_or_path: str | Path) -> tuple[str, str]:
    """Name and text of a robot file. Raises RobotFileError if there is no such file."""
    if not isinstance(name_or_path, str | PathLike):
        raise RobotFileError(
            f"a robot is given by its name or the path of its file, got {shown(name_or_path)}"
        )
    path = Path(name_or_path)
    if path.suffix == ".toml" or (is_file(path) and str(name_or_path) not in built_in_robots()):
        return str(path), read_text(path, f"robot file {path}", RobotFileError)
    if str(name_or_path) not in built_in_robots():
        valid = f"built-in robots: {', '.join(built_in_robots())}; or give the path of a .toml file"
        raise RobotFileError(f"unknown robot `{name_or_path}`; {valid}")
    entry = resources.files("dynamics") / "robots" / f"{name_or_path}.toml"
    return str(name_or_path), entry.read_text(encoding="utf-8")


def _one_line(error: ValidationError) -> str:
    """Faults and their keys in one line. A fault of several legs is stated once."""
    owners: dict[str, list[str]] = {}
    faults = error.errors()
    for item in faults[:MOST_FAULTS]:
        location = list(item["loc"])
        who = ""
        if len(location) > 1 and location[0] == "legs":
            who = f"leg {int(location[1]) + 1}"
            # the type of the leg is after its number
            location = location[3:]
        last_part = str(location[-1]) if location else ""
        if last_part.startswith("list[" if not isinstance(item["input"], list) else "function-"):
            continue  # pydantic also reports the alternative that the value was not meant for
        location = [part for part in location if not str(part).startswith(("list[", "function-"))]
        parts = [".".join(map(str, location)), item["msg"].removeprefix("Value error, ")]
        got = "" if item["type"] in ("value_error", "missing") else f", got {shown(item['input'])}"
        owners.setdefault(": ".join(filter(None, parts)) + got, []).append(who)
    fault_lines = [": ".join(filter(None, [", ".join(who), text])) for text, who in owners.items()]
    more = len(faults) - MOST_FAULTS
    return "; ".join(fault_lines + ([f"and {more} more"] if more > 0 else []))
