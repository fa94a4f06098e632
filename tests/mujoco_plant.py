"""A plant that shares no code with ours: MuJoCo's model of a robot, its drives and its visual servo.

MuJoCo gives the mass matrix, the bias forces, the damping and the Jacobians of the loops of an MJCF
file. With the Jacobian J of the loops and of the spins of the links, v = T w has the speeds w of
the actuated joints, and the equation of motion is

    T^T M T w_dot + T^T (bias - damping + M T_dot w) = torque - dry friction.

Joints stick and slip by events. Quaternions are integrated by their components.
"""

from xml.etree import ElementTree as Xml

import mujoco
import numpy as np
from scipy.optimize import brentq

STEPS = 8  # Runge-Kutta steps of a frame


def changed(text, bodies, ball_damping):
    """An MJCF text with centres of mass, m, and inertias about them by body, and damped balls."""
    root = Xml.fromstring(text)
    for body in root.iter("body"):
        if body.get("name") in bodies:
            centre, inertia = bodies[body.get("name")]
            form = body.find("inertial")
            form.set("pos", " ".join(map(repr, map(float, centre))))
            form.attrib.pop("diaginertia", None)
            six = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
            form.set("fullinertia", " ".join(map(repr, map(float, six))))
    for joint in root.iter("joint"):
        if joint.get("type") == "ball":
            joint.set("damping", repr(ball_damping))
    return Xml.tostring(root, encoding="unicode")


class MujocoPlant:
    """A robot of an MJCF text on drives with the gains lp, li, ld."""

    def __init__(self, text, gains):
        self.model = mujoco.MjModel.from_xml_string(text)
        self.data = mujoco.MjData(self.model)
        mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        self.gains = gains
        model = self.model
        joints = [model.joint(f"joint{leg + 1}") for leg in range(model.nu)]
        self.angle, self.speed = (
            np.array([getattr(one, name)[0] for one in joints]) for name in ("qposadr", "dofadr")
        )
        self.dry = model.dof_frictionloss[self.speed]
        self.uneven = np.zeros(len(self.speed))
        """By how much dry friction is more in the positive direction, and less in the negative."""
        self.others = np.setdiff1d(np.arange(model.nv), self.speed)
        self.balls = [
            j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_BALL
        ]
        self.quaternions = [(3, 3)] + [
            (model.jnt_qposadr[j], model.jnt_dofadr[j]) for j in self.balls
        ]
        self.slides = np.setdiff1d(
            np.arange(model.nq), [at + k for at, _ in self.quaternions for k in range(4)]
        )
        self.rates = np.setdiff1d(
            np.arange(model.nv), [at + k for _, at in self.quaternions for k in range(3)]
        )

    def _loops(self):
        """Rows of the loops and of the links' spins, and their rates times the speeds."""
        model, data, nv = self.model, self.data, self.model.nv
        rows, drift = [], []
        for loop in range(model.neq):
            sides = []
            for site in (model.eq_obj1id[loop], model.eq_obj2id[loop]):
                body, at = model.site_bodyid[site], data.site_xpos[site]
                own, rate = np.zeros((3, nv)), np.zeros((3, nv))
                mujoco.mj_jac(model, data, own, None, at, body)
                mujoco.mj_jacDot(model, data, rate, None, at, body)
                sides.append((own, rate @ data.qvel))
            rows.append(sides[0][0] - sides[1][0])
            drift.append(sides[0][1] - sides[1][1])
        for ball in self.balls:
            body = model.jnt_bodyid[ball]
            own, rate = np.zeros((3, nv)), np.zeros((3, nv))
            mujoco.mj_jacBody(model, data, None, own, body)
            mujoco.mj_jacDot(model, data, None, rate, data.xpos[body], body)
            axis = data.xmat[body].reshape(3, 3)[:, 2]
            rows.append([axis @ own])
            # the axis itself moves by omega x axis, along which there is no spin
            drift.append([axis @ rate @ data.qvel])
        return np.vstack(rows), np.concatenate(drift)

    def _reduced(self, state):
        """Mass matrix (n, n) and bias (n,) of the actuated joints in a state."""
        model, data, count = self.model, self.data, len(self.speed)
        data.qpos[:], speeds = state[: model.nq], state[model.nq : model.nq + count]
        data.qvel[:] = 0.0
        mujoco.mj_fwdPosition(model, data)
        rows, _ = self._loops()
        onto = np.zeros((model.nv, count))
        onto[self.speed] = np.eye(count)
        onto[self.others] = -np.linalg.solve(rows[:, self.others], rows[:, self.speed])
        data.qvel[:] = onto @ speeds
        mujoco.mj_fwdVelocity(model, data)
        _, drift = self._loops()
        at_rest = np.zeros(model.nv)
        at_rest[self.others] = -np.linalg.solve(rows[:, self.others], drift)
        mass = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        forces = data.qfrc_bias - data.qfrc_passive + mass @ at_rest
        return onto.T @ mass @ onto, onto.T @ forces

    def _pushed(self, state, modes, command, command_rate):
        """Slope of a state, and what each stuck joint must hold."""
        count = len(self.speed)
        mass, bias = self._reduced(state)
        angles, speeds, integral = state[self.angle], *np.split(state[-2 * count :], 2)
        lp, li, ld = self.gains
        error = command - angles
        torque = lp * error + li * integral + ld * (command_rate - speeds)
        left = torque - bias - modes * self.dry - np.abs(modes) * self.uneven
        free = modes != 0
        gain = np.zeros(count)
        gain[free] = np.linalg.solve(mass[np.ix_(free, free)], left[free])
        slope = np.zeros_like(state)
        slope[self.slides] = self.data.qvel[self.rates]
        for at, speed in self.quaternions:
            w, (x, y, z) = state[at], state[at + 1 : at + 4]
            a, b, c = self.data.qvel[speed : speed + 3] / 2
            slope[at : at + 4] = [
                *(-x * a - y * b - z * c, w * a + y * c - z * b),
                *(w * b + z * a - x * c, w * c + x * b - y * a),
            ]
        slope[-2 * count :] = *gain, *error
        return slope, left - mass @ gain

    def _step(self, state, length, *given):
        one = self._pushed(state, *given)[0]
        two = self._pushed(state + length / 2 * one, *given)[0]
        three = self._pushed(state + length / 2 * two, *given)[0]
        four = self._pushed(state + length * three, *given)[0]
        return state + length / 6 * (one + 2 * two + 2 * three + four)

    def _broken(self, state, modes, *given):
        """By how much each joint (n,) breaks its mode: turns back, or holds more than it can."""
        count = len(self.speed)
        back = -modes * state[-2 * count : -count]
        if modes.all():
            return back
        held = self._pushed(state, modes, *given)[1]
        return np.where(modes != 0, back, np.abs(held - self.uneven) - self.dry)

    def _settled(self, state, modes, *given):
        """The state and its modes after all joints that break theirs have changed."""
        count = len(self.speed)
        for _ in range(3 * count):
            broken = self._broken(state, modes, *given)
            joint = int(np.argmax(broken))
            if broken[joint] <= 1e-12:
                break
            modes = modes.copy()
            if modes[joint]:
                state, modes[joint] = state.copy(), 0.0
                state[-2 * count + joint] = 0.0
            else:
                held = self._pushed(state, modes, *given)[1] - self.uneven
                modes[joint] = np.sign(held[joint])
        return state, modes

    def _frame(self, state, modes, period, *given):
        left = period
        while left > 1e-12:
            state, modes = self._settled(state, modes, *given)
            length = min(period / STEPS, left)
            after = self._step(state, length, modes, *given)
            if self._broken(after, modes, *given).max() > 0.0:
                begin, now = state, modes

                def worst(part, begin=begin, now=now):
                    there = self._step(begin, part, now, *given)
                    return self._broken(there, now, *given).max() - 1e-11

                if worst(length) > 0.0:
                    length = brentq(worst, 0.0, length, xtol=1e-12)
                    after = self._step(state, length, modes, *given)
            state, left = after, left - length
        return state, modes

    @property
    def pose(self):
        """Pose (6,) of the platform: R = Rx Ry Rz."""
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, self.data.qpos[3:7] / np.linalg.norm(self.data.qpos[3:7]))
        r = turn.reshape(3, 3)
        angles = np.arctan2(-r[1, 2], r[2, 2]), np.arcsin(r[0, 2]), np.arctan2(-r[0, 1], r[0, 0])
        return np.array([*self.data.qpos[:3], *angles])

    def run(self, reference, rates, period, servo, jacobian, sensor):
        """Poses, measurements and commands of a run from rest at home, without latency.

        servo: kp, kd and ki of eq. 30. jacobian: of the joints at a pose, as the servo knows it.
        sensor: function of the frame and the pose.
        """
        kp, kd, ki = servo
        count, model = len(self.speed), self.model
        angles = self.data.qpos[self.angle]
        state = np.concatenate([self.data.qpos, np.zeros(count), np.zeros(count)])
        bias = self._reduced(state)[1]
        state[-count:] = bias / self.gains[1]
        modes, command = np.zeros(count), angles
        summed = np.linalg.solve(jacobian(reference[0]), angles) / ki
        last, found = self.pose, []
        for frame, (wanted, rate) in enumerate(zip(reference, rates, strict=True)):
            self.data.qpos[:] = state[: model.nq]
            pose = self.pose
            measured = sensor(frame, pose)
            error = wanted - measured
            summed = summed + period * error
            demand = kp * error + kd * (rate - (measured - last) / period) + ki * summed
            before, command, last = command, jacobian(measured) @ demand, measured
            found.append((pose, measured, command))
            given = command, (command - before) / period
            state, modes = self._frame(state, modes, period, *given)
        return [np.array(one) for one in zip(*found, strict=True)]
