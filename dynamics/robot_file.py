"""Robot files: TOML with geometry and named parameter sets, built in by name or given as a path."""

import tomllib
from dataclasses import dataclass
from importlib import resources
from os import PathLike
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from dynamics.checks import shown
from dynamics.errors import DynamicsError, RobotFileError
from dynamics.legs.rss_geometry import LEGS, Rss6Geometry
from dynamics.legs.rss_inverse_kinematics import home_angles
from dynamics.parameters import check_parameters

_PerLeg = float | list[float]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _know_every_key(cls, values: object) -> object:
        unknown = sorted(set(values) - set(cls.model_fields)) if isinstance(values, dict) else []
        if unknown:
            raise ValueError(f"unknown key {', '.join(unknown)}; valid: {', '.join(cls.model_fields)}")
        return values


class _Legs(_Strict):
    crank_length: float
    link_length: float
    base_joints: list[list[float]]
    platform_joints: list[list[float]]
    crank_axes: list[list[float]]
    crank_zero_directions: list[list[float]]


class _Inertia(_Strict):
    mass: _PerLeg
    Ixx: _PerLeg
    Iyy: _PerLeg
    Izz: _PerLeg


class _Friction(_Strict):
    coulomb: _PerLeg
    viscous: _PerLeg


class _JointPid(_Strict):
    lp: float
    li: float
    ld: float


class _ParameterSet(_Strict):
    platform: _Inertia
    crank: _Inertia
    link: _Inertia
    joint: _Friction
    joint_pid: _JointPid


class _RobotFile(_Strict):
    name: str
    family: Literal["rss6"]
    home_pose: list[float]
    travel_limit: float
    gravity: list[float]
    legs: _Legs
    parameters: dict[str, _ParameterSet]


@dataclass(frozen=True)
class ParameterSet:
    """One named set: dynamic parameters (64,) in the order of `PARAMETER_NAMES`, and joint PID [lp, li, ld] (3,)."""

    dynamic: np.ndarray
    joint_pid: np.ndarray

    @property
    def vector(self) -> np.ndarray:
        """All 67 values: the dynamic parameters, then lp, li, ld."""
        return np.concatenate([self.dynamic, self.joint_pid])


@dataclass(frozen=True)
class RobotDescription:
    """What a robot file holds: name, geometry and named parameter sets."""

    name: str
    geometry: Rss6Geometry
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
        content = _RobotFile.model_validate(tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise RobotFileError(f"robot file {source} is not valid TOML: {error}") from error
    except ValidationError as error:
        raise RobotFileError(f"robot file {source}: {_one_line(error)}") from error
    try:
        geometry = _geometry(content)
        sets = {name: _parameter_set(name, values) for name, values in content.parameters.items()}
    except DynamicsError as error:
        raise RobotFileError(f"robot file {source}: {error}") from error
    if "initial" not in sets:
        raise RobotFileError(f"robot file {source} needs a parameter set `initial`; it has {sorted(sets) or 'none'}")
    return RobotDescription(content.name, geometry, sets)


def _geometry(content: _RobotFile) -> Rss6Geometry:
    geometry = Rss6Geometry(
        **{name: _vectors(name, value) for name, value in content.legs.model_dump().items() if isinstance(value, list)},
        crank_length=content.legs.crank_length,
        link_length=content.legs.link_length,
        home_pose=np.array(content.home_pose),
        travel_limit=content.travel_limit,
        gravity=np.array(content.gravity),
    )
    home_angles(geometry)  # refuses a home pose out of reach
    return geometry


def _vectors(name: str, rows: list[list[float]]) -> np.ndarray:
    for leg, row in enumerate(rows):
        if len(row) != 3:
            raise RobotFileError(f"legs.{name} of leg {leg + 1} needs 3 numbers, got {len(row)}")
    return np.array(rows)


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
    lines = []
    for item in error.errors():
        place = ".".join(map(str, item["loc"]))
        lines.append(f"{place}: {item['msg']}" if place else item["msg"])
    return "; ".join(lines)


def _parameter_set(name: str, values: _ParameterSet) -> ParameterSet:
    def per_leg(key: str, value: _PerLeg) -> list[float]:
        expanded = value if isinstance(value, list) else [value] * LEGS
        if len(expanded) != LEGS:
            raise RobotFileError(f"parameters.{name}.{key} needs one value or {LEGS} values, got {len(expanded)}")
        return expanded

    platform = [float(value) for value in values.platform.model_dump().values()]
    bodies: list[float] = []
    for body in ("crank", "link"):
        columns = [per_leg(f"{body}.{key}", value) for key, value in getattr(values, body).model_dump().items()]
        bodies += np.array(columns).T.ravel().tolist()
    friction = per_leg("joint.coulomb", values.joint.coulomb) + per_leg("joint.viscous", values.joint.viscous)
    dynamic = check_parameters(np.array(platform + bodies + friction))
    joint_pid = np.array([values.joint_pid.lp, values.joint_pid.li, values.joint_pid.ld])
    for array in (dynamic, joint_pid):
        array.setflags(write=False)
    return ParameterSet(dynamic, joint_pid)
