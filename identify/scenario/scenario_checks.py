"""What a scenario may not claim of parameters and bodies: names that do not exist, and bodies that cannot."""

from collections.abc import Mapping
from typing import Any

VALID_NAMES = (
    "mass, Ixx, Iyy or Izz of platform, crank1 to crank6 or link1 to link6 (platform.mass), coulomb or viscous of "
    "joint1 to joint6, and joint_pid.lp, .li, .ld"
)
"""The names of all parameters in one line."""

ROUNDING = 1e-9
"""Share by which the moments of a flat body may miss their sum."""


def check_parameter_names(known: Any) -> Any:
    """Return what is known by parameter name; what is no mapping is left to the check of its type.

    Raises ValueError for a name that is no parameter's, with the valid ones.
    """
    from dynamics.parameters import JOINT_PID_NAMES, PARAMETER_NAMES

    names = PARAMETER_NAMES + JOINT_PID_NAMES
    for name in known if isinstance(known, Mapping) else ():
        if name not in names:
            unquoted = any(full.startswith(f"{name}.") for full in names)
            hint = f'; its dot needs quotes: {{"{name}.…" = {{value = …, std = …}}}}' if unquoted else ""
            raise ValueError(f"no parameter {name!r}; valid: {VALID_NAMES}{hint}")
    return known


def check_moments(moments: Mapping[str, float]) -> None:
    """Check the three principal moments of inertia [kg m2] of one body, by their names.

    Raises ValueError where one exceeds the sum of the other two, which no distribution of mass has.
    """
    largest = max(moments, key=lambda name: moments[name])
    others = {name: value for name, value in moments.items() if name != largest}
    if moments[largest] > (1 + ROUNDING) * sum(others.values()):
        parts = " + ".join(f"{name} {value:g}" for name, value in others.items())
        raise ValueError(f"{largest} = {moments[largest]:g} kg m2 exceeds {parts} kg m2, as in no rigid body")


def check_load_std(name: str, std: float, load_name: str, load: float, unit: str) -> None:
    """Check how well a figure of a known load is known, by the names of both.

    Raises ValueError where the standard deviation exceeds the figure itself.
    """
    if std > load:
        raise ValueError(
            f"{name} = {std:g} {unit} exceeds {load_name} = {load:g} {unit}: a load that may be none is not known"
        )
