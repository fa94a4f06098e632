"""Bodies of a robot with other lengths than a given robot.

Bodies keep their material. A platform is scaled as a plate of the same thickness, and the bodies of
the legs as bars of the same section. The moments of a centred body grow as those of a thin plate or
bar, and a full body is stretched with its centre of mass. A body of the legs whose inertias no
rigid body can have, as those of cranks and links in the paper, becomes a uniform round rod of
steel.
"""

from collections.abc import Mapping

import numpy as np

from dynamics.inertia import physical_inertias
from dynamics.parameters import ParameterLayout
from dynamics.pseudo_inertia import inertial_parameters, pseudo_inertia
from dynamics.spatial_inertia import FULL_INERTIAL, MOMENTS

# Moment of inertia of each body of a leg about the axis along its length.
MOMENT_ABOUT_LENGTH = {"crank": "Ixx", "link": "Izz", "cylinder": "Izz", "rod": "Izz"}
STEEL = 7850.0  # density of the rods, kg/m^3


def impossible_kinds(layout: ParameterLayout, bodies: np.ndarray) -> set[str]:
    """Kinds of leg bodies with a largest moment of inertia above the sum of the other two.

    `bodies` (bodies, 10) are in the order of the layout.
    """
    moments = bodies[:, [FULL_INERTIAL.index(name) for name in MOMENTS]]
    impossible = 2 * moments.max(axis=1) > moments.sum(axis=1)
    kinds = {kind.name for kind, broken in zip(layout.kinds, impossible, strict=True) if broken}
    return kinds & MOMENT_ABOUT_LENGTH.keys()


def rod_moments(mass: float, length: float, along: str) -> np.ndarray:
    """Moments of inertia (3,) of a uniform round rod of steel about its centre, kg m^2.

    `along` names the moment about the axis of the rod. Mass, kg, and length, m, give the radius.
    """
    radius_squared = mass / (np.pi * STEEL * length)
    moments = np.full(3, mass * (3 * radius_squared + length**2) / 12)
    moments[MOMENTS.index(along)] = mass * radius_squared / 2
    return moments


def scaled_bodies(
    layout: ParameterLayout,
    dynamic: np.ndarray,
    ratios: Mapping[str, float],
    rods: Mapping[str, float],
) -> np.ndarray:
    """Dynamic parameters (p,) with scaled bodies, all of which can exist. Friction is kept.

    `ratios` has the ratio of each new length to the old one. `rods` has the kinds of bodies that
    become rods, with their lengths, m.
    """
    values = dynamic.copy()
    bodies = layout.bodies_of(values)
    moments = [FULL_INERTIAL.index(name) for name in MOMENTS]
    for row, kind in enumerate(layout.kinds):
        if kind.name == "platform":
            ratio = ratios["platform_radius"]
            mass_factor, moment_factor, along = ratio**2, ratio**4, None
        else:
            ratio = ratios.get(kind.name, 1.0)
            mass_factor, moment_factor = ratio, ratio**3
            along = MOMENT_ABOUT_LENGTH.get(kind.name)
        if along is not None and kind.name in rods:
            mass = mass_factor * bodies[row, 0]
            bodies[row] = 0.0
            bodies[row, 0] = mass
            bodies[row, moments] = rod_moments(mass, rods[kind.name], along)
            continue
        if layout.full[row]:
            bodies[row] = _stretched(bodies[row], mass_factor, ratio, along)
            continue
        bodies[row, 0] *= mass_factor
        for column, moment in zip(moments, MOMENTS, strict=True):
            bodies[row, column] *= mass_factor if moment == along else moment_factor
    # rounded inertias can break Ix + Iy >= Iz again, by the size of the rounding
    for _ in range(2):
        values[layout.rigid] = rounded(layout.rigid_of(bodies))
        bodies = physical_inertias(layout, values, allow_changes=True).values
    values[layout.rigid] = layout.rigid_of(bodies)
    return values


def _stretched(body: np.ndarray, mass_factor: float, ratio: float, along: str | None) -> np.ndarray:
    """Full body (10,) stretched along its length, or in the plane x y if `along` is None."""
    stretch = np.ones(4)
    stretch[[0, 1] if along is None else MOMENTS.index(along)] = ratio
    return inertial_parameters(mass_factor * pseudo_inertia(body) * np.outer(stretch, stretch))


def rounded(values: np.ndarray) -> np.ndarray:
    """Values rounded to four significant digits."""
    return np.array([float(f"{value:.4g}") for value in values])
