"""Principal inertias that a rigid body can have: positive mass, and no moment larger than the sum of the other two.

Published tables break this (the cranks and links of the paper's Table 1 do), and multibody engines refuse such bodies.
`physical_inertias` names them, or changes as little as possible, and where it can what the motion does not feel:

- a crank turns about its own z alone, so Ixx and Iyy give way and Izz stays;
- a link without spin does no work against Izz, so Izz gives way and Ixx and Iyy stay;
- the platform feels all three, so they share the change equally (the nearest moments in the least-squares sense).
"""

from dataclasses import dataclass

import numpy as np

from dynamics.errors import ParameterError
from dynamics.parameters import BODY_NAMES

MOMENTS = ("Ixx", "Iyy", "Izz")

# Engines refuse a moving body without mass or inertia; MuJoCo's limit is 1e-15.
SMALLEST = 1e-12

# A sum of two rounded moments may fall below the third by one unit of the last digit; MuJoCo compares exactly.
ROUNDING = 1e-14


class UnphysicalInertiaError(ParameterError):
    """Bodies whose mass and principal inertias no rigid body can have."""


@dataclass(frozen=True)
class BodyInertias:
    """Mass (kg) and principal moments Ixx, Iyy, Izz (kg m^2) of each body, (13, 4) in the order of `BODY_NAMES`, and
    what was changed, in words by body (empty: nothing)."""

    values: np.ndarray
    changes: dict[str, str]


def physical_inertias(parameters: np.ndarray, allow_changes: bool = False) -> BodyInertias:
    """Inertias of parameters (64,) that a multibody engine accepts.

    Raises UnphysicalInertiaError, naming bodies and values, where one must be changed and `allow_changes` is False.
    """
    given = np.array(parameters[: 4 * len(BODY_NAMES)], dtype=float).reshape(-1, 4)
    broken = {body: fault for body, row in zip(BODY_NAMES, given, strict=True) if (fault := _fault(row))}
    if broken and not allow_changes:
        raise UnphysicalInertiaError(
            f"no rigid body has these inertias [kg, kg m^2]: {'; '.join(grouped(broken))}; "
            "pass allow_unphysical_inertia (--allow-unphysical-inertia on the command line) to take the nearest ones "
            "that engines accept"
        )
    values, changes = given.copy(), dict[str, str]()
    for index, body in enumerate(BODY_NAMES):
        if body in broken:
            values[index] = _repaired(body, given[index])
            changes[body] = _difference(given[index], values[index])
    return BodyInertias(values, changes)


def grouped(texts: dict[str, str]) -> list[str]:
    """Texts by body as lines `body, body: text`, one for all bodies that share a text, in the order of the bodies."""
    bodies: dict[str, list[str]] = {}
    for body, text in texts.items():
        bodies.setdefault(text, []).append(body)
    return [f"{', '.join(names)}: {text}" for text, names in bodies.items()]


def _fault(row: np.ndarray) -> str:
    """What is wrong with a body's mass and moments (4,), with its values; empty when nothing is."""
    for name, value in zip(("mass", *MOMENTS), row, strict=True):
        if value < SMALLEST:
            return f"{name} = {value:g} is below {SMALLEST:g}"
    largest = int(np.argmax(row[1:]))
    others = [index for index in range(3) if index != largest]
    half = row[1:] / 2  # sums of two of the largest floats overflow
    if half[largest] <= half[others[0]] + half[others[1]]:
        return ""
    total = " + ".join(f"{MOMENTS[index]} {row[1 + index]:g}" for index in others)
    return f"{MOMENTS[largest]} {row[1 + largest]:g} > {total}"


def _repaired(body: str, row: np.ndarray) -> np.ndarray:
    mass = max(row[0], SMALLEST)
    moments = np.maximum(row[1:], SMALLEST) / 4  # sums of three of the largest floats overflow
    if body.startswith("crank"):
        moments = _crank_moments(*moments)
    elif body.startswith("link"):
        moments = _link_moments(*moments)
    else:
        moments = _nearest_moments(moments)
    return np.array([mass, *4 * np.array(moments)])


def _crank_moments(x: float, y: float, z: float) -> list[float]:
    if x + y < z:
        half = (z - x - y) / 2 + ROUNDING * z
        return [x + half, y + half, z]
    return [min(x, (y + z) * (1 - ROUNDING)), min(y, (x + z) * (1 - ROUNDING)), z]


def _link_moments(x: float, y: float, z: float) -> list[float]:
    slack = ROUNDING * (x + y)
    return [x, y, min(max(z, abs(x - y) + slack), x + y - slack)]


def _nearest_moments(moments: np.ndarray) -> list[float]:
    largest = int(np.argmax(moments))
    excess = 2 * moments[largest] - moments.sum()
    if excess > 0:
        share = excess / 3 + ROUNDING * moments[largest]
        moments = moments + share
        moments[largest] -= 2 * share
    return [float(value) for value in moments]


def _difference(before: np.ndarray, after: np.ndarray) -> str:
    named = zip(("mass", *MOMENTS), before, after, strict=True)
    return ", ".join(f"{name} {old:g} -> {new:g}" for name, old, new in named if old != new)
