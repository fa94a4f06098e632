"""Names of a robot's parameters in a scenario."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dynamics.parameters import ParameterLayout


def check_parameter_names(known: Mapping[str, object], robot: str) -> None:
    """Check that names are parameters of a robot, which is given by name or path.

    Raises ValueError for any other name (with the valid names), or if there is no such robot.
    """
    if not known:
        return
    # Late imports: dynamics loads CasADi, which the help of the command line does not need.
    from dynamics.errors import RobotFileError
    from dynamics.parameters import (
        own_passive_parameters,
        parameter_layout,
        passive_parameters,
    )
    from dynamics.robot_file import read_robot_file

    try:
        # The model can have full bodies, passive friction and gains of each joint where the robot
        # file has none.
        legs = read_robot_file(robot).geometry.legs
        passive = passive_parameters(legs)
        layout = parameter_layout(legs, ("all",), passive=passive)
        own = own_passive_parameters(legs)
        valid = {*layout.names, *own, *parameter_layout(legs, own_gains=True).names}
    except RobotFileError as error:
        raise ValueError(f"robot: {error}") from None
    for name in known:
        if name not in valid:
            # TOML reads a dotted key without quotes as a table within a table.
            unquoted = any(full.startswith(f"{name}.") for full in valid)
            quoted = f'; its dot needs quotes: {{"{name}.…" = {{value = …, std = …}}}}'
            hint = quoted if unquoted else ""
            raise ValueError(
                f"identification.prior: no parameter {name!r}; valid: {in_words(layout)}{hint}"
            )


def in_words(layout: "ParameterLayout") -> str:
    """Return the names of all parameters in one line."""
    kinds: dict[str, list[str]] = {}
    for body, kind in zip(layout.bodies, layout.kinds, strict=True):
        kinds.setdefault(kind.name, []).append(body)
    bodies = " or ".join(_range(names) for names in kinds.values())
    gains = ", ".join(f".{name.split('.')[1]}" for name in layout.joint_pid_names[1:])
    return (
        f"mass, Ixx, Iyy or Izz of {bodies} (platform.mass), for a full body also mcx, mcy, mcz, "
        "Ixy, Ixz or Iyz, coulomb or viscous of "
        f"{_range(layout.joint_names)}, {', '.join(layout.passive_names)}, and "
        f"{layout.joint_pid_names[0]}, {gains}, with model.gains = each {layout.joint_names[0]}.lp "
        "and so on"
    )


def _range(names: list[str] | tuple[str, ...]) -> str:
    return f"{names[0]} to {names[-1]}" if len(names) > 1 else names[0]
