"""Warnings about bodies with all ten inertial parameters (full bodies).

They concern parameters about which a record says nothing, and centres of mass outside of a body.
"""

import numpy as np
from numpy.typing import NDArray

from dynamics import Robot
from dynamics.parameters import ParameterLayout
from dynamics.spatial_inertia import FULL_INERTIAL
from identify.arrays import Array

# Distance of a centre of mass from its body, in standard deviations, above which to warn.
OUTSIDE_STDS = 3.0


def full_body_warnings(
    robot: Robot, estimate: Array, covariance: Array, shown: NDArray[np.bool_]
) -> tuple[str, ...]:
    """Return the warnings about the full bodies of a robot with estimates (p,).

    covariance (p, p): covariance of the estimates. shown (p,): True for each parameter that is
    identified or a part of an identified group.
    """
    return (*_outside(robot, estimate, covariance), *_unseen(robot.layout, shown))


def _unseen(layout: ParameterLayout, shown: NDArray[np.bool_]) -> tuple[str, ...]:
    """Return a warning about the parameters of full bodies that are not `shown` (p,)."""
    unseen: dict[str, list[str]] = {}
    for kind, full, rows in zip(layout.kinds, layout.full, layout.body_slices, strict=True):
        if full and not shown[rows].all():
            names = [name for name, one in zip(FULL_INERTIAL, shown[rows], strict=True) if not one]
            unseen.setdefault(kind.name, []).extend(names)
    if not unseen:
        return ()
    said = "; ".join(
        f"{kind}: {', '.join(name for name in FULL_INERTIAL if name in names)}"
        for kind, names in unseen.items()
    )
    return (
        "the record determines these parameters of full bodies neither alone nor in a sum, so they "
        f"keep their initial guess: {said}; a motion that turns these bodies more can determine "
        "them, unless they have no effect on this robot",
    )


def _outside(robot: Robot, estimate: Array, covariance: Array) -> list[str]:
    """Return a warning for each full body whose centre of mass is outside of the drawn body."""
    layout = robot.layout
    reaches = robot.geometry.body_reaches
    said = []
    for body, full, rows, reach in zip(
        layout.bodies, layout.full, layout.body_slices, reaches, strict=True
    ):
        own = slice(rows.start, rows.start + 4)
        mass, *first = estimate[own]
        if not full or mass <= 0:
            continue
        centre = np.array(first) / mass
        off = float(np.linalg.norm(centre))
        if off <= reach:
            continue
        # Derivative of the distance with respect to the mass and the first moments.
        slope = np.append(-off, centre / off) / mass
        std = float(np.sqrt(slope @ covariance[own, own] @ slope))
        if off - reach > OUTSIDE_STDS * std:
            said.append(
                f"the centre of mass of {body} is {off:.3g} ± {std:.2g} m from the place that the "
                f"robot file gives it, but its drawing reaches {reach:.3g} m: look for a load on "
                "it, or a wrong mass"
            )
    return said
