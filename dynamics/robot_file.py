"""Robot files: TOML with geometry and named parameter sets, built in by name or given as a path."""

import tomllib
from dataclasses import dataclass
from importlib import resources
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from dynamics.checks import shown
from dynamics.errors import DynamicsError, RobotFileError
from dynamics.geometry import RobotGeometry
from dynamics.kinematics.chart import FREEDOMS, Chart
from dynamics.legs import KINDS, AnyLeg
from dynamics.legs.leg import INERTIAL
from dynamics.parameters import JOINT_PID, ParameterLayout, parameter_layout

_PerLeg = float | list[float]


class Family(NamedTuple):
    """Robots whose legs are all of one kind: that, their number, and the chart of the platform."""

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


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _know_every_key(cls, values: object) -> object:
        unknown = sorted(set(values) - set(cls.model_fields)) if isinstance(values, dict) else []
        if unknown:
            raise ValueError(f"unknown key {', '.join(unknown)}; valid: {', '.join(cls.model_fields)}")
        return values


class Inertia(_Strict):
    """Mass, kg, and moments about the body's own axes through its centre of mass, kg m^2: one value, or one a leg."""

    mass: _PerLeg
    Ixx: _PerLeg
    Iyy: _PerLeg
    Izz: _PerLeg


class Friction(_Strict):
    """Dry friction, N m or N, and viscous friction, N m s/rad or N s/m, of the joints: one value, or one a leg."""

    coulomb: _PerLeg
    viscous: _PerLeg


class JointPid(_Strict):
    """Gains of the joint PID, which all joints share; `unit` is that of lp, to be stated where actuators slide."""

    lp: float
    li: float
    ld: float
    unit: Literal["N m/rad", "N/m"] | None = None


class Parameters(BaseModel):
    """A set of parameters: platform, joints and gains, and a table for each kind of body that the legs have."""

    model_config = ConfigDict(extra="allow", frozen=True)
    __pydantic_extra__: dict[str, Inertia] = Field(init=False)

    platform: Inertia
    joint: Friction
    joint_pid: JointPid


class RobotFile(_Strict):
    """A parallel robot. Lengths in m, angles in rad, masses in kg; poses are [x y z alpha beta gamma]."""

    name: str = Field(description="its name, in records and reports")
    family: str | None = Field(None, description=f"one of {', '.join(FAMILIES)}: names kind of legs and chart")
    chart: str | None = Field(
        None, description=f"freedoms of the platform, where no family says: {', '.join(FREEDOMS)}"
    )
    home_pose: list[float] = Field(min_length=6, max_length=6, description="pose of the platform at home, m and rad")
    travel_limit: float = Field(description="largest magnitude of a joint coordinate, rad or m")
    gravity: list[float] = Field([0.0, 0.0, -9.81], min_length=3, max_length=3, description="m/s^2, base axes")
    legs: list[Annotated[AnyLeg, Field(discriminator="type")]] = Field(
        description="a table for each leg; with a family also one table with a value, or a list with one a leg, a key"
    )
    parameters: dict[str, Parameters] = Field(description="named sets; `initial` is what identification starts from")

    @model_validator(mode="before")
    @classmethod
    def _by_family(cls, values: Any) -> Any:
        """Legs one by one, each with its kind, where the file names a family."""
        if not isinstance(values, dict) or "legs" not in values:
            return values
        name = values.get("family")
        if name is None:
            if isinstance(values["legs"], dict):
                raise ValueError("legs: a file without family needs one table [[legs]] for each leg, with its type")
            _check_types(values["legs"])
            return values
        if name not in FAMILIES:
            raise ValueError(f"family: unknown `{name}`; valid: {', '.join(FAMILIES)}")
        family, legs = FAMILIES[name], values["legs"]
        if isinstance(legs, dict):
            legs = _legs_of_columns(legs, family)
        if isinstance(legs, list):
            legs = [{"type": family.kind} | leg if isinstance(leg, dict) else leg for leg in legs]
        _check_types(legs)
        return values | {"legs": legs, "chart": values.get("chart") or family.chart}


def robot_schema() -> dict[str, Any]:
    """JSON schema of robot files, for editors; `dynamics/robots/robot.schema.json` holds it."""
    schema = RobotFile.model_json_schema()
    one_a_leg = schema["properties"]["legs"]
    columns = {"type": "object", "description": "with a family: for each key one value, or a list with one a leg"}
    schema["properties"]["legs"] = {"anyOf": [one_a_leg, columns], "description": one_a_leg.pop("description")}
    return schema


def _check_types(legs: Any) -> None:
    for number, leg in enumerate(legs if isinstance(legs, list) else (), 1):
        if isinstance(leg, dict) and leg.get("type") not in KINDS:
            raise ValueError(f"leg {number}: its type is {leg.get('type')!r}; valid: {', '.join(KINDS)}")


def _legs_of_columns(columns: dict[str, Any], family: Family) -> list[dict[str, Any]]:
    """One table a leg of one table with columns: a value for all legs, or a list with one a leg."""
    fields = {_plural(name): name for name in KINDS[family.kind].model_fields}
    legs: list[dict[str, Any]] = [{} for _ in range(family.legs)]
    for key, value in columns.items():
        name = key if key in fields.values() else fields.get(key)
        if name is None:
            raise ValueError(f"legs: unknown key {key}; valid: {', '.join(fields)}")
        vector = KINDS[family.kind].model_fields[name].annotation is np.ndarray
        each = isinstance(value, list) and (not vector or (bool(value) and isinstance(value[0], list)))
        if each and len(value) != family.legs:
            raise ValueError(f"legs.{key} needs one value, or one for each of {family.legs} legs, got {len(value)}")
        for number, leg in enumerate(legs):
            leg[name] = value[number] if each else value
    return legs


def _plural(name: str) -> str:
    if name.endswith("axis"):
        return name.removesuffix("axis") + "axes"
    return name + "s" if name.endswith(("joint", "direction")) else name


@dataclass(frozen=True)
class ParameterSet:
    """One named set: dynamic parameters (p,) in the order of the robot's `parameter_names`, and joint PID [lp, li, ld]
    (3,)."""

    dynamic: np.ndarray
    joint_pid: np.ndarray

    @property
    def vector(self) -> np.ndarray:
        """All values: the dynamic parameters, then lp, li, ld."""
        return np.concatenate([self.dynamic, self.joint_pid])


@dataclass(frozen=True)
class RobotDescription:
    """What a robot file holds: name, geometry and named parameter sets."""

    name: str
    geometry: RobotGeometry
    parameter_sets: dict[str, ParameterSet]


def built_in_robots() -> list[str]:
    """Names of the robot files that ship with the package."""
    folder = resources.files("dynamics") / "robots"
    return sorted(Path(entry.name).stem for entry in folder.iterdir() if entry.name.endswith(".toml"))


def read_robot_file(name_or_path: str | Path) -> RobotDescription:
    """Read a built-in robot (by name) or a TOML robot file (by path).

    Raises RobotFileError for an unknown name (with the valid ones), an unreadable file, an unknown or missing key
    (with its place), and for geometry or parameters that make no robot.
    """
    source, text = _read_text(name_or_path)
    try:
        content = RobotFile.model_validate(tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise RobotFileError(f"robot file {source} is not valid TOML: {error}") from error
    except ValidationError as error:
        raise RobotFileError(f"robot file {source}: {_one_line(error)}") from error
    try:
        geometry = _geometry(content)
        layout = parameter_layout(geometry.legs)
        sets = {name: _parameter_set(name, values, layout) for name, values in content.parameters.items()}
    except DynamicsError as error:
        raise RobotFileError(f"robot file {source}: {error}") from error
    if "initial" not in sets:
        raise RobotFileError(f"robot file {source} needs a parameter set `initial`; it has {sorted(sets) or 'none'}")
    return RobotDescription(content.name, geometry, sets)


def _geometry(content: RobotFile) -> RobotGeometry:
    if content.chart is None:
        raise RobotFileError(f"a file without family needs a chart; valid: {', '.join(FREEDOMS)}")
    if content.chart not in FREEDOMS:
        raise RobotFileError(f"unknown chart `{content.chart}`; valid: {', '.join(FREEDOMS)}")
    chart = Chart(content.chart, tuple(content.home_pose))
    return RobotGeometry(tuple(content.legs), chart, content.travel_limit, np.array(content.gravity))


def _read_text(name_or_path: str | Path) -> tuple[str, str]:
    if not isinstance(name_or_path, str | PathLike):
        raise RobotFileError(f"a robot is given by its name or the path of its file, got {shown(name_or_path)}")
    path = Path(name_or_path)
    if path.suffix == ".toml" or (path.is_file() and str(name_or_path) not in built_in_robots()):
        try:
            return str(path), path.read_text(encoding="utf-8")
        except (OSError, ValueError) as error:
            raise RobotFileError(f"cannot read robot file {path}: {error}") from error
    if str(name_or_path) not in built_in_robots():
        valid = f"built-in robots: {', '.join(built_in_robots())}; or give the path of a .toml file"
        raise RobotFileError(f"unknown robot `{name_or_path}`; {valid}")
    entry = resources.files("dynamics") / "robots" / f"{name_or_path}.toml"
    return str(name_or_path), entry.read_text(encoding="utf-8")


def _one_line(error: ValidationError) -> str:
    """What is wrong, with the place; what is wrong with several legs alike is said once."""
    legs: dict[str, list[str]] = {}
    for item in error.errors():
        place, who = list(item["loc"]), ""
        if len(place) > 1 and place[0] == "legs":
            who, place = f"leg {int(place[1]) + 1}", place[3:]  # behind the leg's number stands its type
        said = [".".join(map(str, place)), item["msg"].removeprefix("Value error, ")]
        got = "" if item["type"] in ("value_error", "missing") else f", got {shown(item['input'])}"
        legs.setdefault(": ".join(filter(None, said)) + got, []).append(who)
    return "; ".join(": ".join(filter(None, [", ".join(who), text])) for text, who in legs.items())


def _parameter_set(name: str, values: Parameters, layout: ParameterLayout) -> ParameterSet:
    def per_leg(key: str, value: _PerLeg, count: int) -> list[float]:
        expanded = value if isinstance(value, list) else [value] * count
        if len(expanded) != count:
            raise RobotFileError(f"parameters.{name}.{key} needs one value or {count} values, got {len(expanded)}")
        return expanded

    kinds = [kind.name for kind in layout.kinds]
    given = {"platform": values.platform, **(values.model_extra or {})}
    if set(given) != set(kinds):
        wrong = sorted(set(given) ^ set(kinds))
        valid = ", ".join([*dict.fromkeys(kinds), "joint", "joint_pid"])
        raise RobotFileError(f"parameters.{name}: {', '.join(wrong)} unknown or missing; it needs {valid}")
    rigid = np.empty((len(kinds), len(INERTIAL)))
    for kind, inertia in given.items():
        rows = [row for row, name_of in enumerate(kinds) if name_of == kind]
        rigid[rows] = np.transpose([per_leg(f"{kind}.{k}", v, len(rows)) for k, v in inertia.model_dump().items()])
    friction = [per_leg(f"joint.{key}", value, layout.joints) for key, value in values.joint.model_dump().items()]
    dynamic = layout.check(np.concatenate([rigid.ravel(), *friction]))
    stated, unit = values.joint_pid.unit, layout.unit("joint_pid.lp")
    if stated != unit and (stated or layout.prismatic):
        raise RobotFileError(
            f"parameters.{name}.joint_pid.lp = {values.joint_pid.lp:g} {f'is in {stated}' if stated else 'has no unit'}"
            f", but the actuators {'slide' if layout.prismatic else 'turn'}: their gains are in {unit}, which "
            f'joint_pid says by unit = "{unit}"'
        )
    joint_pid = np.array([getattr(values.joint_pid, gain) for gain in JOINT_PID])
    for array in (dynamic, joint_pid):
        array.setflags(write=False)
    return ParameterSet(dynamic, joint_pid)
