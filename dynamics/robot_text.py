"""Text of a robot file in the format of `robot_file`, with all digits.

Legs of a family are columns of one table. Other legs have one table each.
"""

import json
import re
import textwrap
from collections.abc import Mapping, Sequence

import numpy as np

from dynamics.legs.leg import Leg
from dynamics.parameter_set import ParameterSet
from dynamics.parameters import JOINT_PID, ParameterLayout
from dynamics.robot_file import FAMILIES, RobotDescription, plural
from dynamics.spatial_inertia import FULL_INERTIAL, INERTIAL


def robot_text(robot: RobotDescription, comments: Sequence[str] = ()) -> str:
    """TOML text of a robot, with comments in separate lines at the beginning.

    A robot that is read from this text is the same, to the last digit.
    """
    geometry = robot.geometry
    layout = robot.geometry.layout
    units = "m and N" if layout.prismatic else "rad and N m"
    lines = [
        line
        for comment in comments
        for line in textwrap.wrap(
            " ".join(comment.split()), 98, initial_indent="# ", subsequent_indent="# "
        )
    ]
    lines += [
        f"# Lengths in m, angles in rad, masses in kg, inertias in kg m^2; joints in {units}.",
        "",
    ]
    kinds = [type(leg).model_fields["type"].default for leg in geometry.legs]
    own_form = (kinds[0], len(kinds), geometry.chart.name) if len(set(kinds)) == 1 else None
    family = next((name for name, form in FAMILIES.items() if form == own_form), None)
    lines.append(f"name = {json.dumps(robot.name)}")
    lines.append(
        f"family = {json.dumps(family)}" if family else f"chart = {json.dumps(geometry.chart.name)}"
    )
    lines += [
        f"home_pose = {_value(geometry.home_pose)}",
        f"travel_limit = {_value(geometry.travel_limit)}",
    ]
    lines += [f"gravity = {_value(geometry.gravity)}"]
    if any(layout.full):
        table = ", ".join(f'{body} = "full"' for body in layout.full_bodies)
        lines += ['inertia = "full"' if all(layout.full) else f"inertia = {{ {table} }}"]
    lines += ["", "[unstated]"]
    lines += [f"{name} = {_value(value)}" for name, value in geometry.unstated]
    if family:
        lines += ["", "[legs]", *_columns(geometry.legs)]
    else:
        for number, leg in enumerate(geometry.legs, 1):
            lines += ["", f"# Leg {number}", "[[legs]]", *_fields(leg)]
    for mesh in geometry.meshes:
        pose = _value(np.array(mesh.pose))
        lines += ["", "[[meshes]]", f"body = {_value(mesh.body)}", f"file = {_value(mesh.file)}"]
        lines += [f"scale = {_value(mesh.scale)}", f"pose = {pose}"]
    for name, values in robot.parameter_sets.items():
        lines += ["", f"[parameters.{_key(name)}]", *_parameters(values, layout)]
    return "\n".join(lines) + "\n"


def _columns(legs: Sequence[Leg]) -> list[str]:
    """Lines with the fields of all legs, described by comments. Equal values are written once."""
    lines = []
    for name in type(legs[0]).model_fields:
        column = [getattr(leg, name) for leg in legs]
        if name == "type" or all(value is None for value in column):
            continue
        meaning = type(legs[0]).model_fields[name].description
        lines += [f"# {meaning}"] if meaning else []
        if all(np.array_equal(value, column[0]) for value in column):
            lines.append(f"{plural(name)} = {_value(column[0])}")
        elif isinstance(column[0], np.ndarray):
            rows = [f"    {_value(value)}," for value in column]
            lines += [f"{plural(name)} = [", *rows, "]"]
        else:
            lines.append(f"{name} = [{', '.join(map(_value, column))}]")
    return lines


def _fields(leg: Leg) -> list[str]:
    """Lines with the fields of a leg."""
    fields = [(name, getattr(leg, name)) for name in type(leg).model_fields]
    fields.sort(key=lambda field: field[0] != "type")
    return [f"{name} = {_value(value)}" for name, value in fields if value is not None]


def _parameters(values: ParameterSet, layout: ParameterLayout) -> list[str]:
    """Lines of a parameter set."""
    bodies = layout.bodies_of(values.dynamic)
    kinds = [kind.name for kind in layout.kinds]
    lines = []
    for kind in dict.fromkeys(kinds):
        rows = [row for row, name in enumerate(kinds) if name == kind]
        names = FULL_INERTIAL if any(layout.full[row] for row in rows) else INERTIAL
        columns = {name: bodies[rows, FULL_INERTIAL.index(name)] for name in names}
        lines.append(_table(kind, columns))
    passive: dict[str, list[str]] = {}
    for name, value in zip(layout.passive_names, values.dynamic[layout.passive], strict=True):
        joint, law = name.split(".")
        passive.setdefault(joint, []).append(f"{law} = {_value(float(value))}")
    if passive:
        tables = (f"{joint} = {{ {', '.join(laws)} }}" for joint, laws in passive.items())
        lines.append(f"passive = {{ {', '.join(tables)} }}")
    friction = {
        "coulomb": values.dynamic[layout.coulomb],
        "viscous": values.dynamic[layout.viscous],
    }
    lines.append(_table("joint", friction))
    each = layout.each_gains(values.joint_pid)
    # a list, even of equal values, states that each joint has its own gains
    gains = dict(zip(JOINT_PID, each.T if layout.own_gains else each[0], strict=True))
    unit = layout.unit(layout.joint_pid_names[0])
    return [*lines, _line("joint_pid", {**gains, "unit": unit})]


def _table(name: str, columns: dict[str, np.ndarray]) -> str:
    """Line with a table. A column of equal values is written as one value."""
    return _line(
        name,
        {
            key: column[0] if np.all(column == column[0]) else column
            for key, column in columns.items()
        },
    )


def _line(name: str, values: Mapping[str, object]) -> str:
    """Line with a table."""
    entries = ", ".join(f"{key} = {_value(value)}" for key, value in values.items())
    return f"{name} = {{ {entries} }}"


def _key(name: str) -> str:
    """Name as a TOML key, in quotes if necessary."""
    return name if re.fullmatch("[A-Za-z0-9_-]+", name) else json.dumps(name)


def _value(value: object) -> str:
    """Value in TOML."""
    if isinstance(value, np.ndarray):
        return f"[{', '.join(_value(entry) for entry in value.tolist())}]"
    return json.dumps(value) if isinstance(value, str | int) else repr(float(value))  # type: ignore[arg-type]
