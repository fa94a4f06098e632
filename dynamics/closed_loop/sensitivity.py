"""Sensitivities over the steps of `stick_slip`, the exact derivative of what it computes: twin of `step_sensitivity.c`.

Derivatives are rows over columns: the 67 parameters, the length of the present step, and the start state if wanted. A
Runge-Kutta step is differentiated stage by stage, the equation of motion at each implicitly. A step that an event cuts
has the length at which a margin vanishes at its end; the margin's derivative gives that of the length, and the step
that follows is shorter by it. Stopping joints by an impulse is differentiated implicitly too.
"""

from dataclasses import replace

import numpy as np

from dynamics.closed_loop.joints import FrictionLaw, MotionFunctions
from dynamics.closed_loop.motion import Command, Evaluation, State, compliance
from dynamics.closed_loop.problem import LENGTH
from dynamics.parameters import COULOMB, RIGID_BODY, VISCOUS, split_parameters

LP, LI, LD = 64, 65, 66
NO_APPROACH = 1e-9  # rad/s^2 or N m/s: an event so slow has no derivative
FRACTION = (0.0, 0.5, 0.5, 1.0)
WEIGHT = (1 / 6, 1 / 3, 1 / 3, 1 / 6)


class StepSensitivity:
    """Derivatives of the state (`tangent`: (6, columns) each) and of the time at which the present step starts."""

    def __init__(
        self, functions: MotionFunctions, parameters: np.ndarray, friction: FrictionLaw, tangent: State
    ) -> None:
        self._functions = functions
        self._rigid, self._coulomb, self._viscous, joint_pid = split_parameters(parameters)
        self._lp, self._li, self._ld = joint_pid
        self._friction = friction
        self.tangent = tangent
        self._d_time = np.zeros(tangent.pose.shape[1])

    def step(self, stages: list[Evaluation], end: Evaluation, command: Command, mode: np.ndarray) -> None:
        """Over a step to a fixed time."""
        d_length = -self._d_time
        self._runge_kutta(stages, end, command, mode, d_length)
        self._d_time = self._d_time + d_length

    def fixed_step(self, stages: list[Evaluation], end: Evaluation, command: Command, mode: np.ndarray) -> None:
        """Over a step of fixed length."""
        self._runge_kutta(stages, end, command, mode, np.zeros_like(self._d_time))

    def cut_step(
        self, stages: list[Evaluation], end: Evaluation, command: Command, mode: np.ndarray, joint: int
    ) -> None:
        """Over a step that ends where the mode of a joint does; before that mode changes."""
        length = np.zeros_like(self._d_time)
        length[LENGTH] = 1.0
        self._runge_kutta(stages, end, command, mode, length)
        margin = self._margin(end, command, mode, joint, self._d_time + length)
        d_length = np.zeros_like(margin)
        if abs(margin[LENGTH]) > NO_APPROACH:
            d_length = -margin / margin[LENGTH]
        d_length[LENGTH] = 0.0
        x = self.tangent
        for rows in (x.pose, x.rate, x.integral):
            rows += np.outer(rows[:, LENGTH], d_length)
            rows[:, LENGTH] = 0.0
        self._d_time = self._d_time + d_length

    def stop(self, at: Evaluation, joints: np.ndarray, rate: np.ndarray, impulse: np.ndarray) -> None:
        """Through an impulse (n,) at some joints that changed the pose rate to `rate`, leaving these joints at rest.

        M change = -J^T impulse and J rate = 0 in these joints, differentiated implicitly.
        """
        if len(joints) == 6:
            self.tangent = replace(self.tangent, rate=np.zeros_like(self.tangent.rate))
            return
        x, rest, torque = self.tangent, np.zeros(6), np.zeros(6)
        torque[joints] = -impulse
        pushed = self._derivatives(at.state.pose, rest, rate - at.state.rate, torque)
        unmoved = self._derivatives(at.state.pose, rest, rest, rest)
        by_pose, columns = (pushed[i] - unmoved[i] for i in (0, 2))  # the difference leaves out gravity
        right = -by_pose @ x.pose
        right[:, RIGID_BODY] -= columns
        moved = x.rate + np.linalg.solve(at.mass, right)
        matrix, response = compliance(at, joints)
        left_over = at.jacobian[joints] @ moved + self._velocity_by_pose(at.state.pose, rate)[joints] @ x.pose
        self.tangent = replace(x, rate=moved - response @ np.linalg.solve(matrix, left_over))

    def _runge_kutta(
        self, stages: list[Evaluation], end: Evaluation, command: Command, mode: np.ndarray, d_length: np.ndarray
    ) -> None:
        h = end.time - stages[0].time
        changes: list[State] = []
        for fraction, stage in zip(FRACTION, stages, strict=True):
            x = self.tangent.moved(changes[-1], fraction) if changes else self.tangent
            slope = self._slope(stage, command, mode, x, self._d_time + fraction * d_length)[0]
            changes.append(_change(stage, slope, h, d_length))
        for weight, change in zip(WEIGHT, changes, strict=True):
            self.tangent = self.tangent.moved(change, weight)

    def _margin(
        self, end: Evaluation, command: Command, mode: np.ndarray, joint: int, d_time: np.ndarray
    ) -> np.ndarray:
        """Derivative of what vanishes at an event: a joint's velocity, or its stick force less the breakaway torque."""
        x = self.tangent
        if mode[joint] != 0:
            by_pose = self._velocity_by_pose(end.state.pose, end.state.rate)
            return np.asarray(by_pose[joint] @ x.pose + end.jacobian[joint] @ x.rate)
        d_force = self._slope(end, command, mode, x, d_time)[1][joint] * np.sign(end.stick_force[joint])
        d_force[COULOMB.start + joint] -= self._friction.static_level
        return np.asarray(d_force)

    def _velocity_by_pose(self, pose: np.ndarray, rate: np.ndarray) -> np.ndarray:
        return np.asarray(self._functions["rate_map_derivative"](pose, rate), dtype=float)

    def _derivatives(self, *arguments: np.ndarray) -> list[np.ndarray]:
        values = self._functions["motion_derivatives"](*arguments, self._rigid)
        return [np.asarray(value, dtype=float) for value in values]

    def _slope(
        self, at: Evaluation, command: Command, mode: np.ndarray, x: State, d_time: np.ndarray
    ) -> tuple[State, np.ndarray]:
        """Derivatives of the state's time derivative, and of the stick forces (6, columns; of stuck joints only)."""
        by_pose, by_rate, columns, crank_by_pose, crank_by_rate = self._derivatives(
            at.state.pose, at.state.rate, at.acceleration, at.net_torque
        )
        d_error = command.d_value + at.time * command.d_slope + np.outer(command.slope, d_time) - at.jacobian @ x.pose
        d_velocity = crank_by_rate @ x.pose / 2 + at.jacobian @ x.rate
        d_torque = self._torque(at, command, mode, x, d_error, d_velocity)
        slipping = mode != 0
        right = at.jacobian[slipping].T @ d_torque[slipping] - by_pose @ x.pose - by_rate @ x.rate
        right[:, RIGID_BODY] -= columns
        d_acceleration = np.linalg.solve(at.mass, right)
        stuck = np.flatnonzero(~slipping)
        if len(stuck):
            matrix, response = compliance(at, stuck)
            drift = crank_by_pose @ x.pose + crank_by_rate @ x.rate + at.jacobian @ d_acceleration
            d_net_torque = -np.linalg.solve(matrix, drift[stuck])
            d_acceleration += response @ d_net_torque
            d_torque[stuck] -= d_net_torque
        return State(x.rate, d_acceleration, d_error), d_torque

    def _torque(
        self,
        at: Evaluation,
        command: Command,
        mode: np.ndarray,
        x: State,
        d_error: np.ndarray,
        d_velocity: np.ndarray,
    ) -> np.ndarray:
        """Derivative of the net joint torque (6, columns), for stuck joints without the force that holds them."""
        slipping = mode != 0
        damping = self._ld + np.where(slipping, self._viscous, 0.0)
        dry = self._friction.dry_level(at.velocity, mode)
        damping = damping + np.where(slipping, self._coulomb * self._friction.dry_slope(at.velocity, mode), 0.0)
        result = self._lp * d_error + self._ld * command.d_rate - damping[:, None] * d_velocity + self._li * x.integral
        joints = np.arange(6)
        result[:, LP] += at.error
        result[:, LI] += at.state.integral
        result[:, LD] += command.rate - at.velocity
        result[joints, COULOMB.start + joints] -= np.where(slipping, dry, 0.0)
        result[joints, VISCOUS.start + joints] -= np.where(slipping, at.velocity, 0.0)
        return result


def _change(stage: Evaluation, d_slope: State, h: float, d_length: np.ndarray) -> State:
    """Derivative of h times the slope of a stage."""
    return State(
        h * d_slope.pose + np.outer(stage.state.rate, d_length),
        h * d_slope.rate + np.outer(stage.acceleration, d_length),
        h * d_slope.integral + np.outer(stage.error, d_length),
    )
