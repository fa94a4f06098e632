"""Units of dynamic parameters by their names."""

from dynamics.spatial_inertia import FIRST_MOMENTS, MOMENTS, PRODUCTS

PASSIVE_JOINT = "{}_joint"
"""Name of a passive joint: that of the body outwards from it, such as link_joint."""

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


def unit_of(name: str, prismatic: bool = False) -> str:
    """Unit of a parameter name such as `crank1.mass` or `joint_pid.lp`."""
    joint, _, entry = name.rpartition(".")
    if joint.endswith(PASSIVE_JOINT.format("")):
        # passive joints turn, whatever the actuators do
        return REVOLUTE[entry]
    return (UNITS | (PRISMATIC if prismatic else REVOLUTE))[name.rsplit(".", 1)[1]]
