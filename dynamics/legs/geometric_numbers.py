"""Geometric numbers of a leg: the numbers that determine its kinematics.

Each kind of leg lists the names of its geometric numbers (`Leg.numbers`). They are coordinates of
its joints, m, its lengths, m, and small rotations of its axes, rad. Rotations are relative to the
present axes. Their values are thus zero, and only their deviations can differ from zero. The
rotations `u` and `v` are about axes perpendicular to the axis of the leg. On a crank, `u` is about
the zero direction, and `crank_zero` is about the crank axis.

A leg can be described by another leg and a vector of deviations of the geometric numbers. If the
deviations are symbols, expressions of the leg can be differentiated with respect to them.
"""

from typing import Any, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from dynamics.kinematics.platform import rotation_matrix
from dynamics.legs.leg import Leg

AnyKind = TypeVar("AnyKind", bound=Leg)
# Fields of a leg that are points, whose coordinates are geometric numbers.
POINTS = ("base_joint", "platform_joint")
MOST_NUMBERS = 11  # most geometric numbers that a leg of a built-in kind has


def unit_of(number: str) -> str:
    """Unit of a geometric number, rad or m."""
    return "rad" if _is_turn(number) else "m"


def values(leg: Leg) -> np.ndarray:
    """Geometric numbers (k,) of a leg, m. Its rotations are zero."""
    return np.array([_value(leg, name) for name in leg.numbers])


def moved(leg: AnyKind, deviations: ArrayLike | ca.SX) -> AnyKind:
    """Leg whose geometric numbers are changed by deviations (k,), m and rad.

    If the deviations are symbols, the leg can only be used in CasADi expressions.
    """
    symbols = (
        deviations
        if isinstance(deviations, ca.SX)
        else ca.SX(ca.DM(np.asarray(deviations, dtype=float)))
    )
    deviation = dict(zip(leg.numbers, ca.vertsplit(symbols), strict=True))
    changes: dict[str, Any] = {
        field: getattr(leg, field)
        + ca.vertcat(*[deviation.get(f"{field}.{axis}", ca.SX(0)) for axis in "xyz"])
        for field in POINTS
    }
    changes |= {
        name: getattr(leg, name) + deviation[name]
        for name in leg.numbers
        if "." not in name and not _is_turn(name)
    }
    if leg.turned:
        turns = [deviation.get(name, ca.SX(0)) for name in _turns(leg)]
        frame = ca.SX(_frame(leg)) @ rotation_matrix(ca.vertcat(*turns))
        changes |= {
            field: frame[:, column] for field, column in zip(leg.turned, (2, 0), strict=False)
        }
    return leg.model_copy(update={field: _number(value) for field, value in changes.items()})


def deviations(leg: Leg, nominal: Leg) -> np.ndarray:
    """Deviations (k,) of a leg from a nominal leg of the same kind, m and rad.

    This is the inverse of `moved`.
    """
    changes = dict(zip(leg.numbers, values(leg) - values(nominal), strict=True))
    if leg.turned:
        between = _frame(nominal).T @ _frame(leg)
        # without a zero direction, u and v follow from the axis, Rx(u) Ry(v) z in the nominal frame
        if len(leg.turned) == 1:
            x, y, z = between[:, 2]
            turns = [np.arctan2(-y, z), np.arcsin(x), 0.0]
        else:
            turns = list(Rotation.from_matrix(between).as_euler("XYZ"))
        changes |= {
            name: turn for name, turn in zip(_turns(leg), turns, strict=True) if name in changes
        }
    return np.array(list(changes.values()))


def _turns(leg: Leg) -> tuple[str, str, str]:
    """Names of the rotations of a leg."""
    return f"{leg.turned[0]}.u", f"{leg.turned[0]}.v", "crank_zero"


def _is_turn(number: str) -> bool:
    """Return True for a number that is a rotation."""
    return number == "crank_zero" or number.endswith((".u", ".v"))


def _value(leg: Leg, number: str) -> float:
    """Value of a geometric number of a leg, m. It is zero for a rotation."""
    field, _, entry = number.partition(".")
    if _is_turn(number):
        return 0.0
    value = getattr(leg, field)
    return float(value["xyz".index(entry)] if entry else value)


def _frame(leg: Leg) -> np.ndarray:
    """Right-handed axes (3, 3) of a leg, as columns.

    The last column is the axis of the leg. The first is its zero direction, if it has one.
    """
    axis = getattr(leg, leg.turned[0])
    if len(leg.turned) == 2:
        first = getattr(leg, leg.turned[1])
    else:
        across = np.cross(np.eye(3)[np.argmin(np.abs(axis))], axis)
        first = across / np.linalg.norm(across)
    return np.column_stack([first, np.cross(axis, first), axis])


def _number(value: ca.SX) -> Any:
    """Number or array of a constant expression. Any other expression is returned unchanged."""
    if not value.is_constant():
        return value
    array = np.array(ca.DM(value)).ravel()
    array.setflags(write=False)
    return float(array[0]) if len(array) == 1 else array
