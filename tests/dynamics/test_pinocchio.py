"""Forward and inverse dynamics against Pinocchio: the same robot as a closed chain of 13 bodies with 18 constraints.

Pinocchio knows nothing of virtual work, of the leg Jacobians or of the platform joints' motion: it gets bodies, joints
and the demand that six points of the links stay on six points of the platform.
"""

import numpy as np
import pytest

pin = pytest.importorskip("pinocchio")


def _inertia(mass, centre, moments):
    return pin.Inertia(mass, np.asarray(centre, dtype=float), np.diag(moments))


class ClosedChain:
    """Free-flying platform, six revolute cranks, six links on spherical joints, 18 loop constraints at A."""

    def __init__(self, robot, legs_at, numerics, values):
        self.robot, self.legs_at, self.numerics, self.values = robot, legs_at, numerics, values
        g, self.model = robot.geometry, pin.Model()
        self.model.gravity.linear = g.gravity
        self.platform = self._body(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), 0, np.zeros(3))
        self.cranks, self.links, self.constraints = [], [], pin.StdVec_RigidConstraintModel()
        for leg in range(6):
            zero, axis = g.crank_zero_directions[leg], g.crank_axes[leg]
            place = pin.SE3(np.column_stack([zero, np.cross(axis, zero), axis]), g.base_joints[leg])
            crank = self._body(0, pin.JointModelRZ(), place, 1 + leg, [g.crank_length / 2, 0, 0])
            tip = pin.SE3(np.eye(3), np.array([g.crank_length, 0, 0]))
            link = self._body(crank, pin.JointModelSpherical(), tip, 7 + leg, [0, 0, g.link_length / 2])
            end = pin.SE3(np.eye(3), np.array([0, 0, g.link_length]))
            joint = pin.SE3(np.eye(3), g.platform_joints[leg])
            kind = pin.ContactType.CONTACT_3D
            self.constraints.append(
                pin.RigidConstraintModel(kind, self.model, link, end, self.platform, joint, pin.ReferenceFrame.LOCAL)
            )
            self.cranks.append(crank)
            self.links.append(link)
        self.data = self.model.createData()
        self.constraint_data = pin.StdVec_RigidConstraintData()
        self.constraint_data.extend([constraint.createData() for constraint in self.constraints])
        later = (self.constraint_data,) if int(pin.__version__.split(".")[0]) >= 4 else ()
        pin.initConstraintDynamics(self.model, self.data, self.constraints, *later)

    def _body(self, parent, joint, place, body, centre):
        number = self.model.addJoint(parent, joint, place, f"body{body}")
        mass, *moments = self.values[4 * body : 4 * body + 4]
        self.model.appendBodyToJoint(number, _inertia(mass, centre, moments), pin.SE3.Identity())
        return number

    def _link_frame(self, leg, pose):
        place = self.legs_at(pose)
        z = (place.joint[leg] - place.tip[leg]) / self.robot.geometry.link_length
        x = np.cross(self.robot.geometry.crank_axes[leg], z)
        x /= np.linalg.norm(x)
        return np.column_stack([x, np.cross(z, x), z])

    def coordinates(self, pose, twist):
        """Configuration and velocity of the chain; links turn without spin about their own axes (eq. 12)."""
        g, place = self.robot.geometry, self.legs_at(pose)
        frame = self.numerics.base_from_platform(pose)
        theta, rates = self.robot.inverse_kinematics(pose), self.robot.joint_jacobian(pose) @ twist
        q, v = pin.neutral(self.model), np.zeros(self.model.nv)
        q[:3], q[3:7] = pose[:3], pin.Quaternion(frame).coeffs()
        v[:3], v[3:6] = frame.T @ twist[:3], frame.T @ twist[3:]
        arms = place.joint - pose[:3]
        for leg in range(6):
            axis, zero = g.crank_axes[leg], g.crank_zero_directions[leg]
            x = np.cos(theta[leg]) * zero + np.sin(theta[leg]) * np.cross(axis, zero)
            crank, link = np.column_stack([x, np.cross(axis, x), axis]), self._link_frame(leg, pose)
            l = place.joint[leg] - place.tip[leg]
            l_dot = twist[:3] + np.cross(twist[3:], arms[leg]) - rates[leg] * np.cross(axis, place.crank[leg])
            omega = np.cross(l, l_dot) / (l @ l)
            i, j = self.model.joints[self.cranks[leg]], self.model.joints[self.links[leg]]
            q[i.idx_q], v[i.idx_v] = theta[leg], rates[leg]
            q[j.idx_q : j.idx_q + 4] = pin.Quaternion(crank.T @ link).coeffs()
            v[j.idx_v : j.idx_v + 3] = link.T @ (omega - rates[leg] * axis)
        return q, v

    def twist_dot(self, pose, twist, torque):
        """Platform acceleration [h_ddot, omega_dot], base axes, under net joint torques."""
        q, v = self.coordinates(pose, twist)
        generalised = np.zeros(self.model.nv)
        for leg in range(6):
            generalised[self.model.joints[self.cranks[leg]].idx_v] = torque[leg]
        settings = pin.ProximalSettings(1e-14, 0.0, 20)
        a = pin.constraintDynamics(
            self.model, self.data, q, v, generalised, self.constraints, self.constraint_data, settings
        )
        frame = self.numerics.base_from_platform(pose)
        return np.concatenate([frame @ (a[:3] + np.cross(v[3:6], v[:3])), frame @ a[3:6]])

    def closure(self, pose, twist):
        """Largest gap (m) and gap velocity (m/s) of the 18 constraints: proves that the chain is set up closed."""
        q, v = self.coordinates(pose, twist)
        pin.forwardKinematics(self.model, self.data, q, v)
        gap, speed = 0.0, 0.0
        for constraint in self.constraints:
            ends = []
            for joint, place in (
                (constraint.joint1_id, constraint.joint1_placement),
                (constraint.joint2_id, constraint.joint2_placement),
            ):
                at = self.data.oMi[joint].act(place)
                ends.append((at.translation, at.rotation @ place.actInv(self.data.v[joint]).linear))
            gap = max(gap, np.abs(ends[0][0] - ends[1][0]).max())
            speed = max(speed, np.abs(ends[0][1] - ends[1][1]).max())
        return gap, speed


@pytest.mark.parametrize("name", ["initial", "identified"])
def test_forward_dynamics_agrees_with_pinocchio(robot, states, legs_at, numerics, name):
    """twist_dot of 100 random states and torques agrees to 1e-9 of its size; friction enters as joint torque."""
    values = robot.parameter_sets[name].dynamic
    chain = ClosedChain(robot, legs_at, numerics, values)
    torques = 5 * np.random.default_rng(5).standard_normal((100, 6))
    accelerations = robot.forward_dynamics(states.pose, states.twist, torques, values)
    for pose, twist, torque, ours in zip(states.pose, states.twist, torques, accelerations, strict=True):
        gap, speed = chain.closure(pose, twist)
        assert gap < 1e-14
        assert speed < 1e-14
        theta_dot = robot.joint_jacobian(pose) @ twist
        net = torque - values[52:58] * np.sign(theta_dot) - values[58:64] * theta_dot
        theirs = chain.twist_dot(pose, twist, net)
        assert np.abs(ours - theirs).max() <= 1e-9 * np.abs(theirs).max()


def test_torques_of_a_motion_move_pinocchio_that_way(robot, states, legs_at, numerics):
    """Inverse dynamics without friction, put into Pinocchio's forward dynamics, gives the twist_dot asked for."""
    values = robot.parameter_sets["initial"].dynamic
    chain = ClosedChain(robot, legs_at, numerics, values)
    torques = robot.inverse_dynamics(states.pose, states.twist, states.twist_dot, values)
    for pose, twist, torque, wanted in zip(states.pose, states.twist, torques, states.twist_dot, strict=True):
        result = chain.twist_dot(pose, twist, torque)
        np.testing.assert_allclose(result, wanted, atol=1e-9 * np.abs(wanted).max())
