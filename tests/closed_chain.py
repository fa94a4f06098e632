"""A robot in Pinocchio: free-flying platform, the bodies of each leg on their joints, and loop
constraints at its end.

Pinocchio knows nothing of virtual work, of the leg Jacobians or of the platform joints' motion: it
gets bodies, joints and the demand that points of the last bodies stay on points of the platform,
which is so kept from moving as it cannot. Joint coordinates and rates are those the robot gives;
`closure` shows whether they close the chain.
"""

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from tests.dynamics.conftest import base_from_platform

SETTINGS = pin.ProximalSettings(1e-14, 0.0, 20)
# Of `lcaba`, which needs some regularisation: with so little it is done after two iterations.
RECURSIVE = pin.ProximalSettings(1e-10, 1e-8, 20)

NONE, SAME = np.zeros(3), np.eye(3)
X, Y, Z = SAME
JOINTS = {
    "hinge": [pin.JointModelRZ],
    "link hinge": [pin.JointModelRY],
    "slide": [pin.JointModelPZ],
    "ball": [pin.JointModelSpherical],
    "universal": [pin.JointModelRZ, pin.JointModelRX],
}
# Axes of a planar link in those of its crank, when both are in line: y is along the hinges.
LINK_HINGE = np.column_stack([Y, Z, X])


class ChainState(NamedTuple):
    """Configuration, velocity and generalised force of the chain, as Pinocchio orders them."""

    q: np.ndarray
    v: np.ndarray
    force: np.ndarray


class Part(NamedTuple):
    """A body of a leg: its joint to part `before` (-1: the base), where that is in the frame there;
    which inertia of the leg it has and what share of it, its centre of mass; and its end, which is
    on the platform `off` the joint."""

    joint: str
    before: int
    place: pin.SE3
    body: int
    centre: np.ndarray
    end: np.ndarray | None = None
    share: float = 1.0
    off: np.ndarray = NONE


def turned(axes, origin):
    return pin.SE3(np.array(axes), np.array(origin, dtype=float))


def across(z):
    """Axes with a given z."""
    x = np.cross(z, [0.3, 0.5, 0.8]) / np.linalg.norm(np.cross(z, [0.3, 0.5, 0.8]))
    return np.column_stack([x, np.cross(z, x), z])


def crank_parts(leg, joint, turn=SAME, offs=(NONE,)):
    """A crank and the links on it, of which there may be two."""
    zero, tip, end = leg.crank_zero_direction, leg.crank_length * X, leg.link_length * Z
    foot = np.column_stack([zero, np.cross(leg.crank_axis, zero), leg.crank_axis])
    links = [
        Part(joint, 0, turned(turn, tip + off), 1, end / 2, end, 1 / len(offs), off @ foot.T)
        for off in offs
    ]
    return [Part("hinge", -1, turned(foot, leg.base_joint), 0, tip / 2), *links]


def parallelogram_parts(leg):
    half = leg.bar_distance / 2 * Z
    return crank_parts(leg, "ball", offs=(-half, half))


def slider_parts(leg, joint, turn):
    rail, end = across(leg.slider_axis), leg.link_length * Z
    slider = Part("slide", -1, turned(rail, leg.base_joint), 0, NONE)
    return [slider, Part(joint, 0, turned(rail.T @ turn, NONE), 1, end / 2, end)]


def ups_parts(leg):
    foot, rod = turned(across(leg.joint_axis), leg.base_joint), turned(SAME, leg.zero_length * Z)
    cylinder = Part("universal", -1, foot, 0, leg.cylinder_centre * Z)
    return [cylinder, Part("slide", 0, rod, 1, -leg.rod_centre * Z, NONE)]


PARTS = {
    "rss": lambda leg: crank_parts(leg, "ball"),
    "rus": lambda leg: crank_parts(leg, "universal"),
    "rrr": lambda leg: crank_parts(leg, "link hinge", LINK_HINGE),
    "parallelogram": parallelogram_parts,
    "ups": ups_parts,
    "pss": lambda leg: slider_parts(leg, "ball", SAME),
    "pus": lambda leg: slider_parts(leg, "universal", across(leg.joint_axis)),
}


def about_joint(point):
    """Matrix (10, 10) from our inertial parameters about a point to those of Pinocchio about the
    origin: m, m c, Ixx, Ixy, Iyy, Ixz, Iyz, Izz.
    """
    rows = []
    for mass, *first, xx, yy, zz, xy, xz, yz in np.eye(10):
        first = np.array(first)
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        tensor += mass * (point @ point * SAME - np.outer(point, point))
        tensor += 2 * point @ first * SAME - np.outer(point, first) - np.outer(first, point)
        x, y, z = tensor
        rows.append([mass, *(first + mass * point), x[0], x[1], y[1], x[2], y[2], z[2]])
    return np.transpose(rows)


def link_motion(axis, link, rate, spins):
    """Axes and angular velocity of a link: x is normal to a standing axis; about this and about x
    it turns, or, where it hangs on a ball, as it does without spin."""
    length = np.linalg.norm(link)
    z, z_rate = link / length, rate / length
    x = np.cross(axis, z) / np.linalg.norm(np.cross(axis, z))
    omega, excluded = np.cross(z, z_rate), np.cross(axis, x)
    if spins:
        omega = omega - z * (omega @ excluded) / (z @ excluded)
    return np.column_stack([x, np.cross(z, x), z]), omega


def crank_motions(leg, theta, rate, at, moving):
    axis, zero = leg.crank_axis, leg.crank_zero_direction
    x = np.cos(theta) * zero + np.sin(theta) * np.cross(axis, zero)
    tip, tip_rate = (
        leg.base_joint + leg.crank_length * x,
        rate * leg.crank_length * np.cross(axis, x),
    )
    link = link_motion(axis, at - tip, moving - tip_rate, leg.type == "rus")
    return [(np.column_stack([x, np.cross(axis, x), axis]), rate * axis), link, link]


def slider_motions(leg, coordinate, rate, at, moving):
    axis = leg.slider_axis
    link, link_rate = at - leg.base_joint - coordinate * axis, moving - rate * axis
    spins = leg.type == "pus"
    return [
        (across(axis), NONE),
        link_motion(leg.joint_axis if spins else axis, link, link_rate, spins),
    ]


def ups_motions(leg, coordinate, rate, at, moving):
    body = link_motion(leg.joint_axis, at - leg.base_joint, moving, True)
    return [body, body]


MOTIONS = {"ups": ups_motions, "pss": slider_motions, "pus": slider_motions}


class ClosedChain:
    """A robot with dynamic parameters (p,); friction is no part of it."""

    def __init__(self, robot, values, moving=None):
        """moving: robot with compiled kinematics, which are the same in any form of its bodies."""
        self.robot, self.model = moving or robot, pin.Model()
        self.model.gravity.linear = robot.geometry.gravity
        self._bodies, layout = robot.layout.bodies_of(values), robot.layout
        platform = self._body(0, pin.JointModelFreeFlyer, pin.SE3.Identity(), self._bodies[0], NONE)
        self.legs, self.loops = [], pin.StdVec_RigidConstraintModel()
        self._places = [(platform, 0, 1.0, NONE)]
        for leg, own in zip(robot.geometry.legs, layout.of_leg, strict=True):
            self._leg(leg, own, platform)
        self.data, self.loop_data = self.model.createData(), pin.StdVec_RigidConstraintData()
        self.loop_data.extend([loop.createData() for loop in self.loops])
        later = (self.loop_data,) if int(pin.__version__.split(".")[0]) >= 4 else ()
        pin.initConstraintDynamics(self.model, self.data, self.loops, *later)
        if hasattr(pin, "lcaba"):
            pin.computeJointMinimalOrdering(self.model, self.data, self.loops)

    def _body(self, parent, joint, place, inertia, centre):
        """A joint with a body (10,), whose inertial parameters are about a point of its frame."""
        number = self.model.addJoint(parent, joint(), place, f"joint{self.model.njoints}")
        if inertia is not None:
            inertia = pin.Inertia.FromDynamicParameters(about_joint(centre) @ inertia)
            self.model.appendBodyToJoint(number, inertia, pin.SE3.Identity())
        return number

    def _leg(self, leg, own, platform):
        parts, joints = PARTS[leg.type](leg), []
        for part in parts:
            kinds, parent = JOINTS[part.joint], joints[part.before][-1] if part.before >= 0 else 0
            inertia, numbers, place = part.share * self._bodies[own[part.body]], [], part.place
            for kind in kinds:
                last = len(numbers) == len(kinds) - 1
                numbers.append(
                    self._body(parent, kind, place, inertia if last else None, part.centre)
                )
                if last:
                    self._places.append((numbers[-1], own[part.body], part.share, part.centre))
                parent, place = numbers[-1], pin.SE3.Identity()
            joints.append(numbers)
            if part.end is not None:
                at_home = base_from_platform(self.robot.home_pose)
                on_platform = turned(SAME, leg.platform_joint + part.off @ at_home)
                kind, frame = pin.ContactType.CONTACT_3D, pin.ReferenceFrame.LOCAL
                end = turned(SAME, part.end)
                self.loops.append(
                    pin.RigidConstraintModel(
                        kind, self.model, numbers[-1], end, platform, on_platform, frame
                    )
                )
        self.legs.append(
            (leg, parts, [[self.model.joints[n] for n in numbers] for numbers in joints])
        )

    def state(self, pose, twist, torque):
        """The chain at a pose (6,), with a twist (6,) and net joint torques (n,); on balls nothing
        spins (eq. 12).
        """
        turn = base_from_platform(pose)
        theta, rates = self.robot.inverse_kinematics(pose), self.robot.joint_jacobian(pose) @ twist
        q, v, force = pin.neutral(self.model), np.zeros(self.model.nv), np.zeros(self.model.nv)
        q[:3], q[3:7] = pose[:3], pin.Quaternion(turn).coeffs()
        v[:3], v[3:6] = turn.T @ twist[:3], turn.T @ twist[3:]
        for number, (leg, parts, joints) in enumerate(self.legs):
            arm = turn @ leg.platform_joint
            at, moving = pose[:3] + arm, twist[:3] + np.cross(twist[3:], arm)
            motions = MOTIONS.get(leg.type, crank_motions)(
                leg, theta[number], rates[number], at, moving
            )
            for part, own, (axes, omega) in zip(parts, joints, motions[: len(parts)], strict=True):
                before, omega_before = motions[part.before] if part.before >= 0 else (SAME, NONE)
                frame = before @ part.place.rotation
                coordinates, speeds = _joint(part, frame.T @ axes, frame.T @ (omega - omega_before))
                if part.joint == "slide":
                    coordinates, speeds = [[theta[number]]], [[rates[number]]]
                for joint, coordinate, speed in zip(own, coordinates, speeds, strict=True):
                    q[joint.idx_q : joint.idx_q + joint.nq] = coordinate
                    v[joint.idx_v : joint.idx_v + joint.nv] = speed
                if part.joint in ("slide", "hinge"):
                    force[own[0].idx_v] = torque[number]
        return ChainState(q, v, force)

    def acceleration(self, state):
        """One call of `constraintDynamics`: generalised acceleration."""
        return pin.constraintDynamics(
            self.model, self.data, *state, self.loops, self.loop_data, SETTINGS
        )

    def recursive_acceleration(self, state):
        """One call of `lcaba`, by articulated bodies with their loops: generalised acceleration, to
        some 1e-7.
        """
        return pin.lcaba(self.model, self.data, *state, self.loops, self.loop_data, RECURSIVE)

    def twist_dot(self, state):
        """Platform acceleration [h_ddot, omega_dot] (6,), base axes."""
        return self.platform_acceleration(state, self.acceleration(state))

    def platform_acceleration(self, state, a):
        """Of a generalised acceleration: [h_ddot, omega_dot] (6,), base axes."""
        turn, v = pin.Quaternion(*state.q[[6, 3, 4, 5]]).toRotationMatrix(), state.v
        return np.concatenate([turn @ (a[:3] + np.cross(v[3:6], v[:3])), turn @ a[3:6]])

    def regressor(self, state, a, speeds):
        """Torque along speeds (nv, m) of the chain for a unit of each inertial parameter (m, bodies,
        10), at a generalised acceleration.
        """
        rows = pin.computeJointTorqueRegressor(self.model, self.data, state.q, state.v, a)
        found = np.zeros((speeds.shape[1], len(self._bodies), 10))
        for number, body, share, centre in self._places:
            own = rows[:, 10 * (number - 1) : 10 * number]
            found[:, body] += share * speeds.T @ own @ about_joint(centre)
        return found

    def closure(self, state):
        """Largest gap (m) and gap velocity (m/s) of the constraints: proves that the chain is set
        up closed.
        """
        pin.forwardKinematics(self.model, self.data, state.q, state.v)

        def end(joint, place):
            at = self.data.oMi[joint].act(place)
            return np.array([at.translation, at.rotation @ place.actInv(self.data.v[joint]).linear])

        gaps = [
            end(c.joint1_id, c.joint1_placement) - end(c.joint2_id, c.joint2_placement)
            for c in self.loops
        ]
        return np.abs(gaps).max(axis=(0, 2))


def _joint(part, axes, omega):
    """Coordinates and speeds of the joints of a part, for its axes and angular velocity in the
    frame of the first.
    """
    if part.joint == "ball":
        return [pin.Quaternion(axes).coeffs()], [axes.T @ omega]
    if part.joint == "link hinge":
        return [[np.arctan2(axes[0, 2], axes[0, 0])]], [[omega[1]]]
    turn, tilt = np.arctan2(axes[1, 0], axes[0, 0]), np.arctan2(axes[2, 1], axes[2, 2])
    return [[turn], [tilt]][: len(JOINTS[part.joint])], [[omega[2]], [omega @ axes[:, 0]]][
        : len(JOINTS[part.joint])
    ]
