"""A robot in Pinocchio: free-flying platform, six revolute cranks, six links on spherical joints, 18 loop constraints.

Pinocchio knows nothing of virtual work, of the leg Jacobians or of the platform joints' motion: it gets bodies, joints
and the demand that six points of the links stay on six points of the platform. Crank angles and rates are those the
robot gives; `closure` shows whether they close the chain.
"""

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from tests.dynamics.conftest import base_from_platform, link_axes, place_legs

SETTINGS = pin.ProximalSettings(1e-14, 0.0, 20)


class ChainState(NamedTuple):
    """Configuration, velocity and generalised force of the chain, as Pinocchio orders them."""

    q: np.ndarray
    v: np.ndarray
    force: np.ndarray


class ClosedChain:
    """A robot with dynamic parameters (64,); friction is no part of it."""

    def __init__(self, robot, values):
        self.robot, self.model = robot, pin.Model()
        self.model.gravity.linear = robot.geometry.gravity
        self._bodies = np.reshape(values[:52], (13, 4))
        platform = self._body(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), 0, np.zeros(3))
        self.joints, self.loops = [], pin.StdVec_RigidConstraintModel()
        for leg in range(6):
            self._leg(leg, platform)
        self.data, self.loop_data = self.model.createData(), pin.StdVec_RigidConstraintData()
        self.loop_data.extend([loop.createData() for loop in self.loops])
        later = (self.loop_data,) if int(pin.__version__.split(".")[0]) >= 4 else ()
        pin.initConstraintDynamics(self.model, self.data, self.loops, *later)

    def _body(self, parent, joint, place, body, centre):
        mass, *moments = self._bodies[body]
        number = self.model.addJoint(parent, joint, place, f"body{body}")
        self.model.appendBodyToJoint(number, pin.Inertia(mass, centre, np.diag(moments)), pin.SE3.Identity())
        return number

    def _leg(self, leg, platform):
        g = self.robot.geometry
        zero, axis = g.crank_zero_directions[leg], g.crank_axes[leg]
        foot = pin.SE3(np.column_stack([zero, np.cross(axis, zero), axis]), g.base_joints[leg])
        tip, end = (pin.SE3(np.eye(3), np.array(point)) for point in ([g.crank_length, 0, 0], [0, 0, g.link_length]))
        crank = self._body(0, pin.JointModelRZ(), foot, 1 + leg, tip.translation / 2)
        link = self._body(crank, pin.JointModelSpherical(), tip, 7 + leg, end.translation / 2)
        joint = pin.SE3(np.eye(3), g.platform_joints[leg])
        kind, frame = pin.ContactType.CONTACT_3D, pin.ReferenceFrame.LOCAL
        self.loops.append(pin.RigidConstraintModel(kind, self.model, link, end, platform, joint, frame))
        self.joints.append((self.model.joints[crank], self.model.joints[link]))

    def state(self, pose, twist, torque):
        """The chain at a pose (6,), with a twist (6,) and net joint torques (6,); links do not spin (eq. 12)."""
        g = self.robot.geometry
        turn = base_from_platform(pose)
        theta, rates = self.robot.inverse_kinematics(pose), self.robot.joint_jacobian(pose) @ twist
        q, v, force = pin.neutral(self.model), np.zeros(self.model.nv), np.zeros(self.model.nv)
        q[:3], q[3:7] = pose[:3], pin.Quaternion(turn).coeffs()
        v[:3], v[3:6] = turn.T @ twist[:3], turn.T @ twist[3:]
        legs = place_legs(g, pose, theta)
        arms, links, frames = legs.joint - pose[:3], legs.joint - legs.tip, link_axes(g, legs)
        for leg, (crank_joint, link_joint) in enumerate(self.joints):
            axis, l, link = g.crank_axes[leg], links[leg], frames[leg]
            x = legs.crank[leg] / g.crank_length
            crank = np.column_stack([x, np.cross(axis, x), axis])
            l_dot = twist[:3] + np.cross(twist[3:], arms[leg]) - rates[leg] * np.cross(axis, legs.crank[leg])
            omega = np.cross(l, l_dot) / (l @ l)
            q[crank_joint.idx_q], v[crank_joint.idx_v], force[crank_joint.idx_v] = theta[leg], rates[leg], torque[leg]
            q[link_joint.idx_q : link_joint.idx_q + 4] = pin.Quaternion(crank.T @ link).coeffs()
            v[link_joint.idx_v : link_joint.idx_v + 3] = link.T @ (omega - rates[leg] * axis)
        return ChainState(q, v, force)

    def acceleration(self, state):
        """One call of `constraintDynamics`: generalised acceleration."""
        return pin.constraintDynamics(self.model, self.data, *state, self.loops, self.loop_data, SETTINGS)

    def twist_dot(self, state):
        """Platform acceleration [h_ddot, omega_dot] (6,), base axes."""
        a, v = self.acceleration(state), state.v
        turn = pin.Quaternion(*state.q[[6, 3, 4, 5]]).toRotationMatrix()
        return np.concatenate([turn @ (a[:3] + np.cross(v[3:6], v[:3])), turn @ a[3:6]])

    def closure(self, state):
        """Largest gap (m) and gap velocity (m/s) of the 18 constraints: proves that the chain is set up closed."""
        pin.forwardKinematics(self.model, self.data, state.q, state.v)

        def end(joint, place):
            at = self.data.oMi[joint].act(place)
            return np.array([at.translation, at.rotation @ place.actInv(self.data.v[joint]).linear])

        gaps = [end(c.joint1_id, c.joint1_placement) - end(c.joint2_id, c.joint2_placement) for c in self.loops]
        return np.abs(gaps).max(axis=(0, 2))
