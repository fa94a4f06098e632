"""The dynamic parameters: their names, order and physical range (the paper's vector Xi, eq. 25).

The paper calls the driven arm of a leg its wrench; here it is the crank.
"""

import numpy as np
from numpy.typing import ArrayLike

from dynamics.checks import Shape, floats
from dynamics.errors import ParameterError
from dynamics.legs.rss_geometry import LEGS

INERTIAL = ("mass", "Ixx", "Iyy", "Izz")

BODY_NAMES: tuple[str, ...] = (
    "platform",
    *(f"crank{leg}" for leg in range(1, LEGS + 1)),
    *(f"link{leg}" for leg in range(1, LEGS + 1)),
)
RIGID_BODY_NAMES: tuple[str, ...] = tuple(f"{body}.{name}" for body in BODY_NAMES for name in INERTIAL)
COULOMB_NAMES: tuple[str, ...] = tuple(f"joint{leg}.coulomb" for leg in range(1, LEGS + 1))
VISCOUS_NAMES: tuple[str, ...] = tuple(f"joint{leg}.viscous" for leg in range(1, LEGS + 1))
PARAMETER_NAMES: tuple[str, ...] = RIGID_BODY_NAMES + COULOMB_NAMES + VISCOUS_NAMES
JOINT_PID_NAMES: tuple[str, ...] = ("joint_pid.lp", "joint_pid.li", "joint_pid.ld")

RIGID_BODY = slice(0, len(RIGID_BODY_NAMES))
COULOMB = slice(RIGID_BODY.stop, RIGID_BODY.stop + LEGS)
VISCOUS = slice(COULOMB.stop, COULOMB.stop + LEGS)

UNITS: dict[str, str] = {
    "mass": "kg",
    "Ixx": "kg m^2",
    "Iyy": "kg m^2",
    "Izz": "kg m^2",
    "coulomb": "N m",
    "viscous": "N m s/rad",
    "lp": "N m/rad",
    "li": "N m/(rad s)",
    "ld": "N m s/rad",
}


def unit_of(name: str) -> str:
    """Unit of a parameter name such as `crank1.mass` or `joint_pid.lp`."""
    return UNITS[name.rsplit(".", 1)[1]]


def split_parameters(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Parameters (67,) as those of rigid bodies (52,), Coulomb and viscous friction (6,) each, and lp, li, ld (3,)."""
    return values[RIGID_BODY], values[COULOMB], values[VISCOUS], values[VISCOUS.stop :]


def check_parameters(values: ArrayLike, *, batch: bool = False) -> np.ndarray:
    """The values as floats (64,), or (N, 64) where a batch may be.

    Raises ParameterError for another shape, and for one that is NaN, infinite, negative, or no platform mass; it names
    the parameter with its value, unit and limit, and its row in a batch.
    """
    count = len(PARAMETER_NAMES)
    shapes: list[Shape] = [(count,), ("N", count)]
    parameters = floats("parameters", values, *shapes[: 1 + batch], error=ParameterError, finite=False)
    allowed = (parameters >= 0) & (parameters < np.inf)
    allowed[..., 0] &= parameters[..., 0] > 0
    if allowed.all():
        return parameters
    place = tuple(int(index) for index in np.argwhere(~allowed)[0])
    name, limit = PARAMETER_NAMES[place[-1]], ">= 0" if place[-1] else "> 0"
    where = f" (row {place[0]})" if len(place) > 1 else ""
    raise ParameterError(
        f"{name} = {parameters[place]:g} {unit_of(name)} is not allowed, must be finite and {limit}{where}"
    )
