"""A 6-RSS robot as MJCF, the text of a model that MuJoCo loads: a closed chain of 13 bodies.

The platform flies freely; each crank turns about its axis on the base (angle zero as in `inverse_kinematics`), each
link hangs on its crank's tip by a ball joint, and six `connect` equalities hold the link ends to the platform's joints.
Motors act on the cranks. Joint damping is the viscous friction, joint friction loss the Coulomb friction.

MuJoCo's ball joints leave the links free to spin about their own axes, which eq. 12 excludes. Nothing drives that spin
as long as Ixx = Iyy: it stays zero. Damping it away would damp the other two axes of the ball joint too, so the export
adds none.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal, get_args
from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from dynamics.checks import check_choice, check_type, flag, real
from dynamics.errors import DynamicsError
from dynamics.inertia import BodyInertias, grouped, physical_inertias
from dynamics.legs.rss_geometry import LEGS, Rss6Geometry
from dynamics.parameters import COULOMB, VISCOUS, check_parameters
from dynamics.robot import Robot

# MuJoCo silently lowers larger ones.
MAX_IMPEDANCE = 0.9999

# XML has no way to write these: control characters, halves of surrogate pairs (undecodable file names), non-characters.
NOT_IN_XML = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")

Integrator = Literal["implicitfast", "RK4"]

CHANGED_INERTIAS = (
    "Inertias that no rigid body has were changed to the nearest that MuJoCo accepts. Cranks turn about z alone and",
    "links do not spin, so a crank's Ixx, Iyy and a link's Izz do not alter the motion; other changes do.",
)


@dataclass(frozen=True)
class MjcfSolver:
    """How MuJoCo integrates the exported model. Its loops are springs, never exactly closed, so they are made stiff.

    timestep_s: the springs must be resolved by the step, so stiff loops ask for short steps; at 0.25 ms the loops of
    rss6 stay closed to some nanometres in the motions of `cmmsim verify-model`.
    time_constant_steps: time constant of a loop's spring in steps; 2 is the shortest that MuJoCo allows.
    impedance: share of a loop force that the solver enforces at once; the springs bring the rest.
    integrator: implicitfast takes joint damping implicitly, so that any viscous friction is stable, at one evaluation
    a step; RK4 is of fourth order, for comparisons with other engines, at four.
    """

    timestep_s: float = 2.5e-4
    time_constant_steps: float = 2.0
    impedance: float = MAX_IMPEDANCE
    integrator: Integrator = "implicitfast"

    def __post_init__(self) -> None:
        real("timestep", self.timestep_s, DynamicsError, above=0, unit=" s")
        real("time constant", self.time_constant_steps, DynamicsError, least=2, unit=" steps")
        if real("impedance", self.impedance, DynamicsError, above=0) > MAX_IMPEDANCE:
            raise DynamicsError(f"impedance is {self.impedance}, must be > 0 and <= {MAX_IMPEDANCE}")
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
    """MJCF of a robot with dynamic parameters (64,) (None: nominal); `source` says in the file where they come from.

    coulomb: write the dry friction; without it the joints only damp. Raises ParameterError, and its subclass
    UnphysicalInertiaError where a body breaks Ix + Iy >= Iz and `allow_unphysical_inertia` is False.
    """
    check_type("robot", robot, Robot, DynamicsError)
    check_type("source", source, str, DynamicsError)
    solver = MjcfSolver() if solver is None else solver
    check_type("solver", solver, MjcfSolver, DynamicsError)
    values = check_parameters(robot.nominal_parameters if parameters is None else parameters)
    allow_unphysical_inertia = flag("allow_unphysical_inertia", allow_unphysical_inertia, DynamicsError)
    coulomb = flag("coulomb", coulomb, DynamicsError)
    inertias = physical_inertias(values, allow_unphysical_inertia)
    frames = body_frames(robot, robot.home_pose)
    root = Xml.Element("mujoco", model=NOT_IN_XML.sub("?", robot.name))
    _add_header(root, robot, inertias, source)
    Xml.SubElement(root, "compiler", angle="radian", autolimits="true", inertiafromgeom="false")
    _add_options(root, robot, solver)
    add_assets(root)
    world = Xml.SubElement(root, "worldbody")
    add_base_looks(world, robot.geometry)
    _add_platform(world, robot, inertias)
    for leg in range(LEGS):
        friction = (values[COULOMB][leg] if coulomb else 0.0, values[VISCOUS][leg])
        _add_leg(world, robot, leg, frames, inertias, friction)
    _add_loops_and_motors(root)
    coordinates = [*robot.home_pose[:3], *quaternion(frames.platform)]
    for angle in frames.angle:
        coordinates += [angle, 1.0, 0.0, 0.0, 0.0]
    Xml.SubElement(Xml.SubElement(root, "keyframe"), "key", name="home", qpos=_numbers(coordinates))
    Xml.indent(root)
    return Xml.tostring(root, encoding="unicode") + "\n"


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternion (4,) of a rotation matrix (3, 3), scalar first and not negative, as MuJoCo writes it."""
    return Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=True)


def _add_header(root: Xml.Element, robot: Robot, inertias: BodyInertias, source: str) -> None:
    lines = [
        f"6-RSS robot {robot.name}, {source}; exported by cmmsim. Units: m, kg, s, rad, N m.",
        "Keyframe home: all cranks at their home angles, platform at rest.",
        "Links may spin about their own axes; no force makes them as long as Ixx = Iyy.",
    ]
    if inertias.changes:
        lines += [*CHANGED_INERTIAS, *grouped(inertias.changes)]
    for line in lines:
        _add_comment(root, line.replace("->", "to"))


def _add_options(root: Xml.Element, robot: Robot, solver: MjcfSolver) -> None:
    _add_comment(root, "Newton solves the 18 stiff loop equations exactly in a step or two.")
    Xml.SubElement(
        root,
        "option",
        timestep=_numbers(solver.timestep_s),
        integrator=solver.integrator,
        solver="Newton",
        tolerance="1e-14",
        iterations="50",
        gravity=_numbers(robot.geometry.gravity),
    )
    stiff = {
        "solref": _numbers([solver.time_constant_steps * solver.timestep_s, 1.0]),
        "solimp": _numbers([solver.impedance, solver.impedance, 1e-3, 0.5, 2.0]),
    }
    default = Xml.SubElement(root, "default")
    _add_comment(default, "Stiffest stable loops: time constant of two steps, critically damped, impedance near 1.")
    Xml.SubElement(default, "equality", stiff)
    _add_comment(default, "Dry friction is a soft constraint too: as stiff, so that a resting joint creeps least.")
    Xml.SubElement(default, "joint", solreffriction=stiff["solref"], solimpfriction=stiff["solimp"])
    Xml.SubElement(default, "geom", contype="0", conaffinity="0", group="1")
    Xml.SubElement(default, "site", size="0.004", group="3")


def _add_platform(world: Xml.Element, robot: Robot, inertias: BodyInertias) -> None:
    pose = robot.home_pose
    turned = quaternion(Rotation.from_euler("XYZ", pose[3:6]).as_matrix())
    body = Xml.SubElement(world, "body", name="platform", pos=_numbers(pose[:3]), quat=_numbers(turned))
    Xml.SubElement(body, "freejoint", name="platform")
    _add_inertia(body, np.zeros(3), inertias.values[0])
    for leg, joint in enumerate(robot.geometry.platform_joints):
        Xml.SubElement(body, "site", name=f"platform_joint{leg + 1}", pos=_numbers(joint))
    centre, radius = _disc(robot.geometry.platform_joints)
    half = np.array([0.0, 0.0, PLATE_THICKNESS / 2])
    _rod(body, "cylinder", centre - half, centre + half, radius, "plate")
    for joint in robot.geometry.platform_joints:
        _ball(body, _numbers(joint))


def _add_leg(
    world: Xml.Element,
    robot: Robot,
    leg: int,
    frames: BodyFrames,
    inertias: BodyInertias,
    friction: tuple[float, float],
) -> None:
    geometry, number = robot.geometry, leg + 1
    at_zero = geometry.crank_frames(np.zeros(LEGS))[leg]
    place = {"pos": _numbers(geometry.base_joints[leg]), "quat": _numbers(quaternion(at_zero))}
    crank = Xml.SubElement(world, "body", name=f"crank{number}", attrib=place)
    rubbing = {"frictionloss": _numbers(friction[0]), "damping": _numbers(friction[1])}
    Xml.SubElement(crank, "joint", name=f"joint{number}", type="hinge", axis="0 0 1", attrib=rubbing)
    _add_inertia(crank, np.array([geometry.crank_length / 2, 0, 0]), inertias.values[number])
    _rod(crank, "capsule", [0, 0, 0], [geometry.crank_length, 0, 0], CRANK_RADIUS, "crank")
    relative = quaternion(frames.crank[leg].T @ frames.link[leg])
    tip = {"pos": _numbers([geometry.crank_length, 0, 0]), "quat": _numbers(relative)}
    link = Xml.SubElement(crank, "body", name=f"link{number}", attrib=tip)
    Xml.SubElement(link, "joint", name=f"tip{number}", type="ball")
    _add_inertia(link, np.array([0, 0, geometry.link_length / 2]), inertias.values[LEGS + number])
    Xml.SubElement(link, "site", name=f"link_end{number}", pos=_numbers([0, 0, geometry.link_length]))
    _rod(link, "capsule", [0, 0, 0], [0, 0, geometry.link_length], LINK_RADIUS, "link")
    _ball(link, "0 0 0")


def _add_inertia(body: Xml.Element, centre: np.ndarray, inertia: np.ndarray) -> None:
    Xml.SubElement(body, "inertial", pos=_numbers(centre), mass=_numbers(inertia[0]), diaginertia=_numbers(inertia[1:]))


def _add_loops_and_motors(root: Xml.Element) -> None:
    equality, actuator = Xml.SubElement(root, "equality"), Xml.SubElement(root, "actuator")
    for number in range(1, LEGS + 1):
        ends = {"site1": f"link_end{number}", "site2": f"platform_joint{number}"}
        Xml.SubElement(equality, "connect", name=f"loop{number}", attrib=ends)
        Xml.SubElement(actuator, "motor", name=f"motor{number}", joint=f"joint{number}")


def _add_comment(parent: Xml.Element, text: str) -> None:
    """Add a comment; XML allows neither two hyphens side by side in it nor some characters."""
    parent.append(Xml.Comment(f" {re.sub('-(?=-)', '- ', NOT_IN_XML.sub('?', text))} "))


def _numbers(values: ArrayLike) -> str:
    """Numbers as MJCF writes them, with all their digits."""
    return " ".join(repr(float(value)) for value in np.atleast_1d(np.asarray(values, dtype=float)))


# What the exported robot looks like: geoms without mass or contact, so that a viewer shows a 6-RSS robot.
CRANK_RADIUS, LINK_RADIUS, BALL_RADIUS = 0.010, 0.006, 0.009
PLATE_THICKNESS = 0.012
COLOURS = {
    "base": "0.35 0.37 0.40 1",
    "crank": "0.85 0.45 0.15 1",
    "link": "0.75 0.77 0.80 1",
    "plate": "0.2 0.45 0.7 1",
}


def add_assets(root: Xml.Element) -> None:
    """Sky, light and view, and the colours of the bodies."""
    visual = Xml.SubElement(root, "visual")
    Xml.SubElement(visual, "headlight", ambient="0.4 0.4 0.4", diffuse="0.5 0.5 0.5")
    Xml.SubElement(root, "statistic", center="0 0 0.1", extent="0.6")
    asset = Xml.SubElement(root, "asset")
    sky = {"type": "skybox", "builtin": "gradient", "rgb1": "0.9 0.93 0.97", "rgb2": "0.5 0.55 0.6"}
    Xml.SubElement(asset, "texture", sky, width="64", height="384")
    for name, colour in COLOURS.items():
        Xml.SubElement(asset, "material", name=name, rgba=colour)


def add_base_looks(world: Xml.Element, geometry: Rss6Geometry) -> None:
    """A plate below the cranks and a motor on each crank axis."""
    centre, radius = _disc(geometry.base_joints)
    drop = np.array([0.0, 0.0, 0.05])
    _rod(world, "cylinder", centre - drop, centre - drop - [0, 0, 0.01], radius + 0.04, "base")
    for foot, axis in zip(geometry.base_joints, geometry.crank_axes, strict=True):
        _rod(world, "cylinder", foot - 0.04 * axis, foot + 0.012 * axis, 0.022, "base")


def _disc(points: np.ndarray) -> tuple[np.ndarray, float]:
    centre = points.mean(axis=0)
    return centre, float(np.linalg.norm(points - centre, axis=1).max())


def _rod(parent: Xml.Element, kind: str, start: ArrayLike, end: ArrayLike, radius: float, material: str) -> None:
    ends = _numbers(np.concatenate([start, end]))
    Xml.SubElement(parent, "geom", type=kind, fromto=ends, size=_numbers(radius), material=material)


def _ball(parent: Xml.Element, centre: str) -> None:
    Xml.SubElement(parent, "geom", type="sphere", pos=centre, size=_numbers(BALL_RADIUS), material="link")


@dataclass(frozen=True)
class BodyFrames:
    """Crank angles (6,), crank tips T and platform joints A (6, 3) in m, and base-from-body rotations of the platform
    (3, 3), the cranks (6, 3, 3) and the links (6, 3, 3)."""

    angle: np.ndarray
    tip: np.ndarray
    joint: np.ndarray
    platform: np.ndarray
    crank: np.ndarray
    link: np.ndarray


def body_frames(robot: Robot, pose: np.ndarray) -> BodyFrames:
    """Frames of all bodies with the platform at a pose (6,)."""
    geometry, angle = robot.geometry, robot.inverse_kinematics(pose)
    platform = Rotation.from_euler("XYZ", pose[3:6]).as_matrix()
    tip, joint = geometry.crank_tips(angle), pose[:3] + geometry.platform_joints @ platform.T
    z = (joint - tip) / np.linalg.norm(joint - tip, axis=1, keepdims=True)
    across = np.cross(geometry.crank_axes, z)
    x = across / np.linalg.norm(across, axis=1, keepdims=True)
    link = np.stack([x, np.cross(z, x), z], axis=-1)
    return BodyFrames(angle, tip, joint, platform, geometry.crank_frames(angle), link)
