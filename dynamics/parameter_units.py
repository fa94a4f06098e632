"""Units of dynamic parameters by their names."""

import re

from dynamics.spatial_inertia import FIRST_MOMENTS, MOMENTS, PRODUCTS

# Name of a passive joint: link_joint is the joint between the link and the body before it. This
# name is for the joints of all legs. The name for a single leg has the number of the leg, such as
# link3_joint.
PASSIVE_JOINT = "{}_joint"

UNITS = (
    {"mass": "kg"}
    | dict.fromkeys(FIRST_MOMENTS, "kg m")
    | dict.fromkeys((*MOMENTS, *PRODUCTS), "kg m^2")
)
REVOLUTE = {
    "coulomb": "N m",
    "viscous": "N m s/rad",
    "lp": "N m/rad",
    "li": "N m/(rad s)",
    "ld": "N m s/rad",
}
PRISMATIC = {"coulomb": "N", "viscous": "N s/m", "lp": "N/m", "li": "N/(m s)", "ld": "N s/m"}


def of_all_legs(name: str) -> str:
    """Name of a parameter of passive joints for all legs, such as `link_joint.viscous`.

    `name` may be the parameter of a single leg, such as `link3_joint.viscous`.
    """
    return re.sub(r"\d+(?=_joint\.)", "", name)


def unit_of(name: str, prismatic: bool = False) -> str:
    """Unit of the parameter with a name such as `crank1.mass` or `joint_pid.lp`."""
    joint, _, entry = name.rpartition(".")
    if joint.endswith(PASSIVE_JOINT.format("")):
        # passive joints turn, whatever the actuators do
        return REVOLUTE[entry]
    return (UNITS | (PRISMATIC if prismatic else REVOLUTE))[name.rsplit(".", 1)[1]]
