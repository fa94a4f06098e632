"""URDF of a robot and YAML of its closures, in the convention that `urdf_import` reads.

URDF can describe only trees. The last body of each leg ends in a frame `end_...` that coincides
with a frame `seat_...` of the platform, and the YAML lists these pairs of frames. The platform has
a floating joint, or a spherical joint on the first leg. The zero of an actuated joint is that of
its coordinate, and the zero of a passive joint is at home. A universal joint is two revolute joints
with a hub between them. A spherical joint is written as a revolute joint, and the YAML names it.
Limits of torque and rate are placeholders, because a robot file states none.
"""

from xml.sax.saxutils import quoteattr

import numpy as np
from scipy.spatial.transform import Rotation

from dynamics.bodies import parts_of
from dynamics.inertia import physical_inertias
from dynamics.kinematics.platform import base_from_platform
from dynamics.pseudo_inertia import about_centre
from dynamics.robot import Robot

# URDF requires limits of torque or force and of rate, which a robot file does not state.
NO_LIMITS = 'effort="1e9" velocity="1e9"'
COMMENT = "effort and velocity are placeholders: the robot file states no limits"
# Origin (3,), m, and axes (3, 3) of each link, in the axes of the base.
Places = dict[str, tuple[np.ndarray, np.ndarray]]


def urdf_texts(
    robot: Robot,
    parameters: np.ndarray | None = None,
    *,
    platform_on_a_leg: bool = False,
    allow_unphysical_inertia: bool = False,
) -> tuple[str, str]:
    """URDF and YAML of a robot with dynamic parameters (p,), by default the nominal ones.

    If `platform_on_a_leg` is True, the platform has a spherical joint on the first leg instead of a
    floating joint.

    Raises ParameterError for wrong parameters. Raises its subclass UnphysicalInertiaError for a
    body that breaks Ix + Iy >= Iz, unless `allow_unphysical_inertia` is True. With True, such an
    inertia is changed to the nearest that MuJoCo accepts.
    """
    values = robot.layout.check(robot.nominal_parameters if parameters is None else parameters)
    bodies = physical_inertias(robot.layout, values, allow_unphysical_inertia).values
    parts = parts_of(robot.geometry).all
    home = parts_of(robot.geometry).frames(robot, robot.home_pose)
    at_home = robot.inverse_kinematics(robot.home_pose)
    dry = values[robot.layout.coulomb].tolist()
    viscous = values[robot.layout.viscous].tolist()
    platform_axes = base_from_platform(robot.home_pose)
    places: Places = {
        "base": (np.zeros(3), np.eye(3)),
        "platform": (robot.home_pose[:3], platform_axes),
    }
    lines = [_link("base"), _link("platform", bodies[0])]
    spherical: list[str] = []
    loops: list[list[str]] = []
    if not platform_on_a_leg:
        lines.append(_joint("platform", "floating", "base", "platform", places))
    for number, part in enumerate(parts):
        segment = part.segment
        name = part.name
        before = "base" if part.before < 0 else parts[part.before].name
        places[name] = home.origin[number], home.axes[number]
        axis = home.axes[number].T @ home.axes[part.before] @ segment.axis
        lines.append(_link(name, part.share * bodies[part.body], segment.centre))
        # URDF has no ball joint: the YAML file names the hinges that stand for ball joints
        if segment.joint == "ball":
            spherical.append(name)
        # URDF has no universal joint: it becomes two hinges, with a body without mass between them
        if segment.joint == "universal":
            hub = f"hub_{name}"
            lines.append(_link(hub))
            places[hub] = places[name]
            lines.append(_joint(f"first_{name}", "continuous", before, hub, places, axis))
            before = hub
            axis = np.array([1.0, 0.0, 0.0])
        kind = "prismatic" if segment.joint == "slide" else "revolute"
        coordinate = 0.0
        more = ""
        if segment.actuated:
            name = robot.joint_names[part.leg]
            limit = robot.travel_limit
            coordinate = at_home[part.leg]
            more = f'<dynamics friction="{dry[part.leg]!r}" damping="{viscous[part.leg]!r}"/>'
            more += f'<limit lower="{-limit!r}" upper="{limit!r}" {NO_LIMITS}/>'
        lines.append(_joint(name, kind, before, part.name, places, axis, coordinate, more))
        if part.last:
            # URDF is a tree: a leg ends in a link of its own, which the YAML file joins to a link
            # on the platform with the same origin
            end, seat = f"end_{part.name}", f"seat_{part.name}"
            end_point = home.origin[number] + home.axes[number] @ segment.end
            places |= {end: (end_point, home.axes[number]), seat: (end_point, platform_axes)}
            lines += [_link(end), _link(seat)]
            lines.append(_joint(f"to_{end}", "fixed", part.name, end, places))
            if platform_on_a_leg and not loops and "hanging" not in spherical:
                spherical.append("hanging")
                lines.append(_joint("hanging", "revolute", end, seat, places))
                lines.append(_joint("to_platform", "fixed", seat, "platform", places))
            else:
                lines.append(_joint(f"to_{seat}", "fixed", "platform", seat, places))
                loops.append([end, seat])
    closures = {
        "closed_loop": loops,
        "type": ["3d"] * len(loops),
        "name_mot": list(robot.joint_names),
        "joint_name": spherical,
        "joint_type": ["SPHERICAL"] * len(spherical),
    }
    opening = f"<robot name={quoteattr(robot.name)}>"
    text = "\n".join([opening, f"<!-- {COMMENT} -->", *lines, "</robot>"])
    return text, "\n".join(f"{key}: {value}" for key, value in closures.items())


def _link(
    name: str,
    inertia: np.ndarray | None = None,
    reference: np.ndarray | tuple[int, ...] = (0, 0, 0),
) -> str:
    """Link without mass, or with inertial parameters (10,) about a reference point (3,), m."""
    if inertia is None:
        return f'<link name="{name}"/>'
    centre, tensor = about_centre(inertia)
    mass = inertia[0]
    (xx, xy, xz), (yy, yz), (zz,) = tensor[0], tensor[1, 1:], tensor[2, 2:]
    moments = f'ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="{xy}" ixz="{xz}" iyz="{yz}"'
    origin_tag = f'<origin xyz="{_numbers(np.array(reference) + centre)}"/>'
    return (
        f'<link name="{name}"><inertial>{origin_tag}<mass value="{mass}"/><inertia {moments}/>'
        "</inertial></link>"
    )


def _joint(
    name: str,
    kind: str,
    parent: str,
    child: str,
    places: Places,
    axis: np.ndarray | tuple[int, ...] = (1, 0, 0),
    coordinate: float = 0.0,
    more: str = "",
) -> str:
    """Joint with a coordinate at home, rad or m, between two links with `places` at home.

    `more` is the text of further elements of the joint.
    """
    parent_origin, parent_axes = places[parent]
    origin, axes = places[child]
    axis = np.array(axis, dtype=float)
    # URDF needs the frame of the child at coordinate zero
    if kind == "prismatic":
        origin = origin - coordinate * axes @ axis
    else:
        axes = axes @ Rotation.from_rotvec(-coordinate * axis).as_matrix()
    angles = Rotation.from_matrix(parent_axes.T @ axes).as_euler("xyz", suppress_warnings=True)
    xyz = _numbers(parent_axes.T @ (origin - parent_origin))
    ends = f'<parent link="{parent}"/><child link="{child}"/><axis xyz="{_numbers(axis)}"/>'
    origin_tag = f'<origin xyz="{xyz}" rpy="{_numbers(angles)}"/>'
    return f'<joint name="{name}" type="{kind}">{origin_tag}{ends}{more}</joint>'


def _numbers(values: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)
