"""The dynamic parameters: their names, order and physical range (the paper's vector Xi, eq. 25).

The paper calls the driven arm of a leg its wrench; here it is the crank.
"""

import numpy as np
from numpy.typing import ArrayLike

from dynamics.errors import ParameterError
from dynamics.geometry import LEGS

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


def check_parameters(values: ArrayLike) -> np.ndarray:
    """Return values as a float array (64,); raise ParameterError on a wrong shape, NaN, or a negative entry."""
    try:
        array = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise ParameterError(f"parameters must be {len(PARAMETER_NAMES)} numbers, got {values!r:.60}") from None
    if array.shape != (len(PARAMETER_NAMES),):
        raise ParameterError(f"parameters must have shape ({len(PARAMETER_NAMES)},), got {array.shape}")
    allowed = (array >= 0) & (array < np.inf)
    allowed[0] &= array[0] > 0
    if not allowed.all():
        index = int(np.argmin(allowed))
        name, limit = PARAMETER_NAMES[index], ">= 0" if index else "> 0"
        raise ParameterError(f"{name} = {array[index]:g} {unit_of(name)} is not allowed, must be finite and {limit}")
    return array


def inertia_warnings(values: np.ndarray) -> list[str]:
    """Bodies whose principal inertias break the triangle inequality I_x + I_y >= I_z (in any order), one line each."""
    lines = []
    for index, body in enumerate(BODY_NAMES):
        moments = np.asarray(values, dtype=float)[4 * index + 1 : 4 * index + 4]
        if 2 * moments.max() > moments.sum() * (1 + 1e-12):
            lines.append(f"{body}: largest inertia {moments.max():.3g} kg m^2 exceeds the sum of the other two")
    return lines
