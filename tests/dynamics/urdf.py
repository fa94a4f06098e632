"""Robots as URDF and YAML of their closures, in the convention that `urdf_import` reads; written
body by body.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from dynamics.bodies import parts_of
from dynamics.pseudo_inertia import about_centre


def urdf_of(robot, values, platform_on_a_leg):
    """Texts of a robot with parameters (p,). The platform floats, or hangs on the first leg by a
    spherical joint.

    Actuated joints are written at zero, passive ones as they are at home.
    """
    parts, home = (
        parts_of(robot.geometry).all,
        parts_of(robot.geometry).frames(robot, robot.home_pose),
    )
    at_home, bodies = robot.inverse_kinematics(robot.home_pose), robot.layout.bodies_of(values)
    dry, viscous = values[robot.layout.coulomb].tolist(), values[robot.layout.viscous].tolist()
    turn = Rotation.from_euler("XYZ", robot.home_pose[3:]).as_matrix()
    places = {"base": (np.zeros(3), np.eye(3)), "platform": (robot.home_pose[:3], turn)}
    lines, balls, loops = [link("base"), link("platform", bodies[0])], [], []
    if not platform_on_a_leg:
        lines.append(joint("platform", "floating", "base", "platform", places))
    for number, part in enumerate(parts):
        segment, name = part.segment, part.name
        before = "base" if part.before < 0 else parts[part.before].name
        places[name] = home.origin[number], home.axes[number]
        axis = home.axes[number].T @ home.axes[part.before] @ segment.axis
        lines.append(link(name, part.share * bodies[part.body], segment.centre))
        if segment.joint == "ball":
            balls.append(name)
        if segment.joint == "universal":
            lines.append(link(f"hub_{name}"))
            places[f"hub_{name}"] = places[name]
            lines.append(joint(f"first_{name}", "continuous", before, f"hub_{name}", places, axis))
            before, axis = f"hub_{name}", [1, 0, 0]
        kind, more = {"slide": "prismatic"}.get(segment.joint, "revolute"), ""
        if segment.actuated:
            name, limit = f"joint{part.leg + 1}", robot.travel_limit
            more = f'<dynamics friction="{dry[part.leg]!r}" damping="{viscous[part.leg]!r}"/>'
            more += f'<limit lower="{-limit!r}" upper="{limit!r}" effort="1" velocity="1"/>'
        turned = at_home[part.leg] if segment.actuated else 0.0
        lines.append(joint(name, kind, before, part.name, places, axis, turned, more))
        if part.last:
            end = home.origin[number] + home.axes[number] @ segment.end
            places[f"end_{part.name}"], places[f"seat_{part.name}"] = (
                (end, home.axes[number]),
                (end, turn),
            )
            lines += [link(f"end_{part.name}"), link(f"seat_{part.name}")]
            lines.append(
                joint(f"to_end_{part.name}", "fixed", part.name, f"end_{part.name}", places)
            )
            if platform_on_a_leg and not loops and "hanging" not in balls:
                balls.append("hanging")
                lines.append(
                    joint("hanging", "revolute", f"end_{part.name}", f"seat_{part.name}", places)
                )
                lines.append(joint("to_platform", "fixed", f"seat_{part.name}", "platform", places))
            else:
                lines.append(
                    joint(f"to_seat_{part.name}", "fixed", "platform", f"seat_{part.name}", places)
                )
                loops.append([f"end_{part.name}", f"seat_{part.name}"])
    closures = {
        "closed_loop": loops,
        "type": ["3d"] * len(loops),
        "name_mot": list(robot.joint_names),
    }
    closures |= {"joint_name": balls, "joint_type": ["SPHERICAL"] * len(balls)}
    text = "\n".join(['<robot name="made">', *lines, "</robot>"])
    return text, "\n".join(f"{key}: {value}" for key, value in closures.items())


def link(name, inertia=None, centre=(0, 0, 0)):
    if inertia is None:
        return f'<link name="{name}"/>'
    off, tensor = about_centre(inertia)
    mass, (xx, xy, xz), (yy, yz), (zz,) = inertia[0], tensor[0], tensor[1, 1:], tensor[2, 2:]
    moments = f'ixx="{xx}" iyy="{yy}" izz="{zz}"'
    tensor = f'<inertia {moments} ixy="{xy}" ixz="{xz}" iyz="{yz}"/>'
    place = f'<origin xyz="{numbers(np.array(centre) + off)}"/>'
    return f'<link name="{name}"><inertial>{place}<mass value="{mass}"/>{tensor}</inertial></link>'


def joint(name, kind, parent, child, places, axis=(1, 0, 0), turned=0.0, more=""):
    """A joint that is where the child is at home, less the coordinate that it has there."""
    (at, axes), (point, turn), axis = places[parent], places[child], np.array(axis, dtype=float)
    if kind == "prismatic":
        point = point - turned * turn @ axis
    else:
        turn = turn @ Rotation.from_rotvec(-turned * axis).as_matrix()
    angles = Rotation.from_matrix(axes.T @ turn).as_euler("xyz", suppress_warnings=True)
    origin = f'<origin xyz="{numbers(axes.T @ (point - at))}" rpy="{numbers(angles)}"/>'
    ends = f'<parent link="{parent}"/><child link="{child}"/><axis xyz="{numbers(axis)}"/>'
    return f'<joint name="{name}" type="{kind}">{origin}{ends}{more}</joint>'


def numbers(values):
    return " ".join(repr(float(value)) for value in values)
