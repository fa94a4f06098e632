"""MJCF of a robot: the text of a model that MuJoCo loads, with all bodies at home.

The platform has a free joint. The bodies of each leg form a chain from the base on, with the joints
of the leg's segments. A `connect` equality joins the end of each leg to the platform, and the
platform thus has only the degrees of freedom that the legs allow. Motors act on the actuated
joints, whose coordinates are those of `inverse_kinematics`. The viscous friction of these joints is
written as joint damping, and their Coulomb friction as friction loss. A link that consists of two
equal bars is written as two bodies.

MuJoCo's ball joints let bodies spin freely about their own axes, which eq. 12 excludes. No torque
causes this spin as long as Ixx = Iyy, and it stays zero. The export adds no damping against it,
because damping would also act on the other two axes of the ball joint.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal, get_args
from xml.etree import ElementTree as Xml

import numpy as np
from scipy.spatial.transform import Rotation

from dynamics.bodies import Frames, Part, parts_of
from dynamics.checks import check_choice, check_type, flag, real
from dynamics.engines.mjcf_looks import (
    BALL_RADIUS,
    PLATE_THICKNESS,
    add_assets,
    add_ball,
    add_base_looks,
    add_rod,
    disc,
    numbers_text,
)
from dynamics.errors import DynamicsError
from dynamics.inertia import BodyInertias, grouped, physical_inertias
from dynamics.kinematics.platform import base_from_platform
from dynamics.pseudo_inertia import PAIRS, about_centre, is_centred
from dynamics.robot import Robot

# largest impedance; MuJoCo lowers larger values to this one without a warning
MAX_IMPEDANCE = 0.9999

# characters that XML cannot write: control characters, halves of surrogate pairs (from undecodable
# file names), non-characters
NOT_IN_XML = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")

Integrator = Literal["implicitfast", "RK4"]

CHANGED_INERTIAS = (
    "Inertias that no rigid body can have were changed to the nearest that MuJoCo accepts. A "
    "moment that does no work in its",
    "leg does not alter the motion, as with a crank that turns only about z or a link that does "
    "not spin; other moments do.",
)


@dataclass(frozen=True)
class MjcfSolver:
    """Integration of the exported model by MuJoCo.

    MuJoCo closes loops by stiff springs, so that a small gap remains. Stiff springs need short
    steps `timestep_s`: at 0.25 ms the loops of rss6 stay closed to some nanometres in the motions
    of `cmmsim verify-model`.

    `time_constant_steps` is the time constant of the springs in steps; MuJoCo requires at least 2.
    `impedance` is the fraction of the constraint force that the solver enforces at once; the
    springs provide the remainder. Raises DynamicsError for a value out of range.

    The integrator implicitfast treats joint damping implicitly. It is stable for any viscous
    friction and needs one evaluation per step. RK4 is of fourth order, for comparisons with other
    engines, and needs four evaluations per step.
    """

    timestep_s: float = 2.5e-4
    time_constant_steps: float = 2.0
    impedance: float = MAX_IMPEDANCE
    integrator: Integrator = "implicitfast"

    def __post_init__(self) -> None:
        real("timestep", self.timestep_s, DynamicsError, above=0, unit=" s")
        real("time constant", self.time_constant_steps, DynamicsError, least=2, unit=" steps")
        if real("impedance", self.impedance, DynamicsError, above=0) > MAX_IMPEDANCE:
            raise DynamicsError(
                f"impedance is {self.impedance}, must be > 0 and <= {MAX_IMPEDANCE}"
            )
        check_choice("integrator", self.integrator, get_args(Integrator), DynamicsError)


def mjcf_text(
    robot: Robot,
    parameters: np.ndarray | None = None,
    *,
    allow_unphysical_inertia: bool = False,
    coulomb: bool = True,
    solver: MjcfSolver | None = None,
    source: str = "nominal parameters",
) -> str:
    """MJCF of a robot with dynamic parameters (p,), by default the nominal ones.

    If `coulomb` is False, joints have viscous friction only. `source` is a text for the header of
    the file that states where the parameters come from.

    Raises ParameterError for wrong parameters. Raises its subclass UnphysicalInertiaError for a
    body that breaks Ix + Iy >= Iz, unless `allow_unphysical_inertia` is True. With True, such an
    inertia is changed to the nearest that MuJoCo accepts, and the header of the file says so.
    """
    check_type("robot", robot, Robot, DynamicsError)
    check_type("source", source, str, DynamicsError)
    solver = MjcfSolver() if solver is None else solver
    check_type("solver", solver, MjcfSolver, DynamicsError)
    values = robot.layout.check(robot.nominal_parameters if parameters is None else parameters)
    allow_unphysical_inertia = flag(
        "allow_unphysical_inertia", allow_unphysical_inertia, DynamicsError
    )
    coulomb = flag("coulomb", coulomb, DynamicsError)
    inertias = physical_inertias(robot.layout, values, allow_unphysical_inertia)
    dry = values[robot.layout.coulomb]
    viscous = values[robot.layout.viscous]
    chain = _Chain(robot)
    gains = robot.parameter_sets["guess"].joint_pid
    root = Xml.Element("mujoco", model=NOT_IN_XML.sub("?", robot.name))
    _add_header(root, robot, inertias, source)
    Xml.SubElement(root, "compiler", angle="radian", autolimits="true", inertiafromgeom="false")
    _add_options(root, robot, solver, len(chain.ends))
    custom = Xml.SubElement(root, "custom")
    for name, numbers in (("joint_pid", gains), ("travel_limit", robot.travel_limit)):
        Xml.SubElement(custom, "numeric", name=name, data=numbers_text(numbers))
    add_assets(root, robot.geometry)
    world = Xml.SubElement(root, "worldbody")
    add_base_looks(world, robot.geometry)
    _add_platform(world, chain, inertias.values[0])
    coordinates = [*robot.home_pose[:3], *quaternion(base_from_platform(robot.home_pose))]
    bodies = {-1: world}
    for number, part in enumerate(chain.parts):
        friction = {
            "frictionloss": numbers_text(dry[part.leg] if coulomb else 0.0),
            "damping": numbers_text(viscous[part.leg]),
        }
        inertia = part.share * inertias.values[part.body]
        bodies[number], joints = _add_part(bodies[part.before], chain, number, inertia, friction)
        coordinates += joints
    _add_loops_and_motors(root, chain)
    Xml.SubElement(
        Xml.SubElement(root, "keyframe"), "key", name="home", qpos=numbers_text(coordinates)
    )
    Xml.indent(root)
    return Xml.tostring(root, encoding="unicode") + "\n"


class _Chain:
    """Parts of a robot at home.

    `ends` maps the number of each leg's last part to the point (3,) at which this part is joined to
    the platform, m, in the frame of the platform.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.parts = parts_of(robot.geometry).all
        self.home = parts_of(robot.geometry).frames(robot, robot.home_pose)
        self.joints = robot.inverse_kinematics(robot.home_pose)
        platform = base_from_platform(robot.home_pose)
        self.ends = {
            number: robot.geometry.legs[part.leg].platform_joint
            + platform.T @ self.home.axes[part.before] @ part.offset
            for number, part in enumerate(self.parts)
            if part.last
        }


def end_names(part: Part) -> dict[str, str]:
    """Names of the two sites that close a loop: on a leg's last part, and on the platform."""
    # the end of a name such as link1a: the number of the leg, and the letter of the bar
    tail = part.name.lstrip("abcdefghijklmnopqrstuvwxyz_")
    return {"site1": f"link_end{tail}", "site2": f"platform_joint{tail}"}


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternion (4,) of a rotation matrix (3, 3), scalar first and not negative."""
    return Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=True)


def _add_header(root: Xml.Element, robot: Robot, inertias: BodyInertias, source: str) -> None:
    """Add comments on the model."""
    lines = [
        f"Parallel robot {robot.name}, {source}; exported by cmmsim. Units: m, kg, s, rad, N, N m.",
        "The model as written, and its keyframe home: all actuated joints at their home "
        "coordinates, platform at rest.",
        "Links on ball joints can spin about their own axes; no torque makes them spin as long as "
        "Ixx = Iyy.",
    ]
    if inertias.changes:
        lines += [*CHANGED_INERTIAS, *grouped(inertias.changes)]
    for line in lines:
        _add_comment(root, line.replace("->", "to"))


def _add_options(root: Xml.Element, robot: Robot, solver: MjcfSolver, loops: int) -> None:
    """Add options of the solver, and defaults for loops (equalities), joints, geoms and sites."""
    _add_comment(
        root, f"Newton solves the {3 * loops} stiff loop equations exactly in a step or two."
    )
    Xml.SubElement(
        root,
        "option",
        timestep=numbers_text(solver.timestep_s),
        integrator=solver.integrator,
        solver="Newton",
        tolerance="1e-14",
        iterations="50",
        gravity=numbers_text(robot.geometry.gravity),
    )
    stiff = {
        "solref": numbers_text([solver.time_constant_steps * solver.timestep_s, 1.0]),
        "solimp": numbers_text([solver.impedance, solver.impedance, 1e-3, 0.5, 2.0]),
    }
    default = Xml.SubElement(root, "default")
    _add_comment(
        default,
        "Stiffest stable loops: time constant of two steps, critically damped, impedance near 1.",
    )
    Xml.SubElement(default, "equality", stiff)
    _add_comment(
        default,
        "Dry friction is a soft constraint, too. It is as stiff, so that a resting joint creeps "
        "least.",
    )
    Xml.SubElement(default, "joint", solreffriction=stiff["solref"], solimpfriction=stiff["solimp"])
    Xml.SubElement(default, "geom", contype="0", conaffinity="0", group="1")
    Xml.SubElement(default, "site", size="0.004", group="3")


def _add_platform(world: Xml.Element, chain: _Chain, inertia: np.ndarray) -> None:
    """Add the platform with its inertia (10,), the sites of its joints, and its appearance."""
    pose = chain.robot.home_pose
    joints = chain.robot.geometry.platform_joints
    turned = numbers_text(quaternion(base_from_platform(pose)))
    body = Xml.SubElement(world, "body", name="platform", pos=numbers_text(pose[:3]), quat=turned)
    Xml.SubElement(body, "freejoint", name="platform")
    _add_inertia(body, np.zeros(3), inertia)
    for number, end in chain.ends.items():
        Xml.SubElement(
            body, "site", name=end_names(chain.parts[number])["site2"], pos=numbers_text(end)
        )
    centre, radius = disc(joints)
    half = np.array([0.0, 0.0, PLATE_THICKNESS / 2])
    add_rod(body, "cylinder", centre - half, centre + half, radius, "plate")
    for end in chain.ends.values():
        add_ball(body, end, BALL_RADIUS)


def _add_part(
    parent: Xml.Element, chain: _Chain, number: int, inertia: np.ndarray, friction: dict[str, str]
) -> tuple[Xml.Element, list[float]]:
    """Add a part as a child of the previous part of its leg, or of the base.

    Returns the new element, and the coordinates of its joint at home.
    """
    part = chain.parts[number]
    home = chain.home
    segment = part.segment
    before = part.before
    parent_from_base = home.axes[before].T
    pose = {
        "pos": numbers_text(
            _cleaned(parent_from_base @ (home.origin[number] - home.origin[before]))
        ),
        "quat": numbers_text(_cleaned(quaternion(parent_from_base @ home.axes[number]))),
    }
    body = Xml.SubElement(parent, "body", name=part.name, attrib=pose)
    coordinates = _add_joint(
        body, part, part_axis(part, home, number), chain.joints[part.leg], friction
    )
    _add_inertia(body, segment.centre, inertia)
    start, end = segment.rod
    add_rod(body, "capsule", start, end, segment.radius, "crank" if segment.actuated else "link")
    if segment.joint in ("ball", "universal"):
        add_ball(body, np.zeros(3), 1.5 * segment.radius)
    if segment.end is not None:
        Xml.SubElement(body, "site", name=end_names(part)["site1"], pos=numbers_text(segment.end))
    return body, coordinates


def _add_joint(
    body: Xml.Element, part: Part, axis: np.ndarray, coordinate: float, friction: dict[str, str]
) -> list[float]:
    """Add the joint of a part, and return its coordinates at home.

    A universal joint is written as two hinges. The axis of the first is fixed in the parent body.
    """
    if part.segment.joint == "ball":
        Xml.SubElement(body, "joint", name=part.name, type="ball")
        return [1.0, 0.0, 0.0, 0.0]
    if part.segment.joint == "universal":
        Xml.SubElement(body, "joint", name=part.name, type="hinge", axis=numbers_text(axis))
        Xml.SubElement(body, "joint", name=f"{part.name}_x", type="hinge", axis="1 0 0")
        return [0.0, 0.0]
    attributes = {"type": part.segment.joint, "axis": numbers_text(axis)}
    if not part.segment.actuated:
        Xml.SubElement(body, "joint", name=part.name, attrib=attributes)
        return [0.0]
    attributes |= {"ref": numbers_text(coordinate)} | friction
    Xml.SubElement(body, "joint", name=f"joint{part.leg + 1}", attrib=attributes)
    return [coordinate]


def part_axis(part: Part, frames: Frames, number: int) -> np.ndarray:
    """Axis (3,) of the joint of a part, in the axes of the part."""
    return _cleaned(frames.axes[number].T @ frames.axes[part.before] @ part.segment.axis)


def _cleaned(values: np.ndarray) -> np.ndarray:
    """Values with zero in place of those that are only rounding errors.

    The values are of the order of magnitude of 1, in m or without unit.
    """
    return np.where(np.abs(values) < 2e-15, 0.0, values)


def _add_inertia(body: Xml.Element, reference: np.ndarray, inertia: np.ndarray) -> None:
    """Add the inertia of a full body (10,) about a reference point (3,) in the body's frame, m."""
    attributes = {"pos": numbers_text(reference), "mass": numbers_text(inertia[0])}
    if is_centred(inertia):
        attributes["diaginertia"] = numbers_text(inertia[4:7])
    else:
        centre, about = about_centre(inertia)
        attributes["pos"] = numbers_text(reference + centre)
        products = [about[row, column] for row, column in PAIRS]
        attributes["fullinertia"] = numbers_text([*np.diagonal(about), *products])
    Xml.SubElement(body, "inertial", attrib=attributes)


def _add_loops_and_motors(root: Xml.Element, chain: _Chain) -> None:
    """Add an equality for each loop, and a motor for each leg."""
    equality = Xml.SubElement(root, "equality")
    actuator = Xml.SubElement(root, "actuator")
    for number in chain.ends:
        ends = end_names(chain.parts[number])
        Xml.SubElement(
            equality, "connect", name=ends["site2"].replace("platform_joint", "loop"), attrib=ends
        )
    for leg, joint in enumerate(chain.robot.joint_names, 1):
        Xml.SubElement(actuator, "motor", name=f"motor{leg}", joint=joint)


def _add_comment(parent: Xml.Element, text: str) -> None:
    """Add a comment, without adjacent hyphens and without characters that XML does not allow."""
    parent.append(Xml.Comment(f" {re.sub('-(?=-)', '- ', NOT_IN_XML.sub('?', text))} "))
