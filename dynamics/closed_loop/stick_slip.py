"""Motion with dry joint friction over a span of constant command: the plain twin of `stick_slip.c`.

Each joint either slips one way (mode +1 or -1) or is stuck (mode 0) and then carries the friction torque that keeps its
acceleration zero. Between mode changes the motion is smooth and classical Runge-Kutta integrates it. A mode ends where
a slipping joint comes to rest or a stuck joint reaches its breakaway torque (eq. 24); the step is cut there, to
rounding. At rest, which joints stick is a box-constrained problem in the friction torques. Sensitivities follow every
step: see `sensitivity`.
"""

from dataclasses import replace

import numpy as np

from dynamics.closed_loop.joints import FrictionLaw, MotionFunctions
from dynamics.closed_loop.motion import Command, Evaluation, State, compliance
from dynamics.closed_loop.problem import LEFT_REACH, SINGULAR_MASS
from dynamics.closed_loop.sensitivity import FRACTION, WEIGHT, StepSensitivity
from dynamics.parameters import split_parameters

MAX_EVENTS_PER_SEGMENT = 400
NO_MARGIN = 1e-12  # rad/s, or share of the breakaway torque


class MotionStopped(Exception):
    """Integration cannot go on: the reason, and the pose (6,) at which it was found."""

    def __init__(self, reason: str, pose: np.ndarray) -> None:
        super().__init__(reason)
        self.pose = pose


class StickSlipMotion:
    """Integrates one robot with parameters (67,) under a friction law; keeps modes and sensitivities.

    tangent: derivatives of the first state (see `sensitivity`), or None where no sensitivities are wanted.
    """

    def __init__(
        self,
        functions: MotionFunctions,
        parameters: np.ndarray,
        friction: FrictionLaw,
        tangent: State | None = None,
    ) -> None:
        self._functions = functions
        self._rigid, self._coulomb, self._viscous, joint_pid = split_parameters(parameters)
        self._lp, self._li, self._ld = joint_pid
        self._friction = friction
        self._breakaway = friction.static_level * self._coulomb
        self._has_events = np.logical_and(self._coulomb > 0, friction.sticks)
        self.mode = np.zeros(6, dtype=int)
        self.events = 0
        self._last_event = MAX_EVENTS_PER_SEGMENT
        self._sensitivity = None
        if tangent is not None:
            self._sensitivity = StepSensitivity(functions, parameters, friction, tangent)
        self._unmoved = True

    @property
    def tangent(self) -> State | None:
        """Derivatives of the present state, (6, columns) each."""
        return self._sensitivity.tangent if self._sensitivity else None

    def start_from(self, state: State) -> None:
        """Take the modes from the velocities of a state: joints slower than NO_MARGIN are at rest."""
        values = self._functions["equation_of_motion"](state.pose, state.rate, self._rigid)
        velocity = np.asarray(values[2], dtype=float) @ state.rate
        self.mode = np.where(np.abs(velocity) <= NO_MARGIN, 0, np.where(velocity > 0, 1, -1))

    def torque_at(self, state: State, command: Command) -> np.ndarray:
        """Actuator torques (6,) of the joint PID (eq. 31), N m."""
        return self._terms(state, 0.0, command).torque

    def segment(self, state: State, command: Command, duration: float, steps: int) -> State:
        """The state after `duration` s under one command. Raises MotionStopped."""
        now = self._begin(state, command)
        self._last_event = self.events + MAX_EVENTS_PER_SEGMENT
        for n in range(1, steps + 1):
            target = duration * n / steps
            while now.time < target:
                now = self._step(now, command, target)
        return now.state

    def _begin(self, state: State, command: Command) -> Evaluation:
        """The evaluation at the start of a segment, in the modes that its command leaves."""
        start = self._terms(state, 0.0, command)
        self._follow_frictionless(start)
        self._decide_modes(start, np.flatnonzero(self.mode == 0))
        now = self._evaluate(state, 0.0, command)
        if self._sensitivity and self._unmoved:  # a start moved at joints that stick loses their velocities at once
            stuck = np.flatnonzero(self.mode == 0)
            self._sensitivity.stop(now, stuck, state.rate, np.zeros(len(stuck)))
        self._unmoved = False
        return now

    def _step(self, now: Evaluation, command: Command, target: float) -> Evaluation:
        """One step to the time `target`, s, or to where the first mode before it ends."""
        h = target - now.time
        stages, end = self._trial(now, command, h)
        if self._margin(end)[0] >= 0 and self._hinted(stages):
            halfway = self._trial(now, command, h / 2)[1]
            h, end = (h / 2, halfway) if self._margin(halfway)[0] < 0 else (h, end)
        if self._margin(end)[0] < 0:
            return self._step_to_event(now, command, h, end)
        if self._sensitivity:
            self._sensitivity.step(stages, end, command, self.mode)
        stopped = self._stop_joints(end, np.flatnonzero(self.mode == 0))
        self._follow_frictionless(end)
        return self._evaluate(stopped, target, command)

    def _step_to_event(self, now: Evaluation, command: Command, h: float, end: Evaluation) -> Evaluation:
        """The step to where a mode ends that is broken at `end`, after h s, and what follows in the new modes."""
        if self.events == self._last_event:
            raise MotionStopped("more stick-slip events than a frame can hold", now.state.pose)
        stages, end, held = self._locate_event(now, command, h, end)
        if self._sensitivity and held:
            self._sensitivity.cut_step(stages, end, command, self.mode, self._margin(end)[1])
        elif self._sensitivity:
            self._sensitivity.fixed_step(stages, end, command, self.mode)
        self.events += 1
        return self._after_event(end, command, held)

    def _terms(self, state: State, time: float, command: Command) -> Evaluation:
        values = self._functions["equation_of_motion"](state.pose, state.rate, self._rigid)
        mass, bias, jacobian, bias_acceleration, angle = (np.asarray(value, dtype=float) for value in values)
        if not np.isfinite(mass).all():
            raise MotionStopped(LEFT_REACH, state.pose)
        try:
            np.linalg.cholesky(mass)
        except np.linalg.LinAlgError:
            raise MotionStopped(SINGULAR_MASS, state.pose) from None
        angle, velocity = angle[:, 0], jacobian @ state.rate
        error = command.value + command.slope * time - angle
        torque = self._lp * error + self._ld * (command.rate - velocity) + self._li * state.integral
        return Evaluation(state, time, mass, bias[:, 0], jacobian, bias_acceleration[:, 0], error, velocity, torque)

    def _evaluate(self, state: State, time: float, command: Command) -> Evaluation:
        """Acceleration for the present modes; stuck joints carry what keeps their acceleration zero."""
        at = self._terms(state, time, command)
        slipping = self.mode != 0
        at.net_torque = at.torque - np.where(slipping, self._slip_friction(at), 0.0)
        free = np.linalg.solve(at.mass, at.jacobian.T @ at.net_torque - at.bias)
        stuck = np.flatnonzero(~slipping)
        if len(stuck):
            matrix, response = compliance(at, stuck)
            force = np.linalg.solve(matrix, at.jacobian[stuck] @ free + at.bias_acceleration[stuck])
            at.stick_force[stuck] = force
            at.net_torque[stuck] -= force
            # A robot that stands still stands still: rounding must not make it creep.
            free = free - response @ force if len(stuck) < len(free) else np.zeros_like(free)
        at.acceleration = free
        return at

    def _slip_friction(self, at: Evaluation) -> np.ndarray:
        return self._coulomb * self._friction.dry_level(at.velocity, self.mode) + self._viscous * at.velocity

    def _follow_frictionless(self, at: Evaluation) -> None:
        """Joints without dry friction have no modes to break: they slip the way they move."""
        self.mode = np.where(self._has_events, self.mode, np.where(at.velocity < 0, -1, 1))

    def _decide_modes(self, at: Evaluation, joints: np.ndarray) -> None:
        """Which joints at rest stick, and which way the others start: projected Gauss-Seidel on friction torques."""
        if not len(joints):
            return
        slip = self._slip_friction(at)
        slip[joints] = 0.0
        free = np.linalg.solve(at.mass, at.jacobian.T @ (at.torque - slip) - at.bias)
        matrix, _ = compliance(at, joints)
        push = at.jacobian[joints] @ free + at.bias_acceleration[joints]
        limit, force = self._breakaway[joints], np.zeros(len(joints))
        for _ in range(1000):
            before = force.copy()
            for k in range(len(joints)):
                wanted = force[k] + (push[k] - matrix[k] @ force) / matrix[k, k]
                force[k] = min(max(wanted, -limit[k]), limit[k])
            if np.abs(force - before).max() < 1e-15:
                break
        self.mode[joints] = np.where(np.abs(force) < limit, 0, np.where(force >= 0, 1, -1))

    def _margin(self, at: Evaluation) -> tuple[float, int]:
        """How far the modes are from being broken (>= 0 while they hold), and the joint that is closest."""
        with np.errstate(divide="ignore", invalid="ignore"):
            reserve = (self._breakaway - np.abs(at.stick_force)) / self._breakaway
        margins = np.where(self.mode != 0, self.mode * at.velocity, reserve)
        margins = np.where(self._has_events, np.minimum(margins, 1.0), 1.0)
        joint = int(np.argmin(margins))
        return float(margins[joint]), joint

    def _hinted(self, stages: list[Evaluation]) -> bool:
        """Whether modes that hold at both ends of a step may have been broken in between (a joint reversing twice)."""
        return any(self._margin(stage)[0] < 0 for stage in stages[1:3])

    def _trial(self, now: Evaluation, command: Command, h: float) -> tuple[list[Evaluation], Evaluation]:
        """One Runge-Kutta step with fixed modes: its four stages, and the evaluation at its end."""
        stages = [now]
        for fraction in FRACTION[1:]:
            state = now.state.moved(_slope(stages[-1]), fraction * h)
            stages.append(self._evaluate(state, now.time + fraction * h, command))
        state = now.state
        for weight, stage in zip(WEIGHT, stages, strict=True):
            state = state.moved(_slope(stage), weight * h)
        return stages, self._evaluate(state, now.time + h, command)

    def _locate_event(
        self, now: Evaluation, command: Command, h: float, end: Evaluation
    ) -> tuple[list[Evaluation], Evaluation, bool]:
        """The step in (0, h] at which the modes stop holding: regula falsi (Anderson-Bjorck) on the margin.

        A joint that has just started from rest has no margin yet: then the bracket is found by halving, and the last
        entry returned is False where there is none.
        """
        low, high, side = 0.0, h, 0
        at_low, at_high = self._margin(now)[0], self._margin(end)[0]
        for _ in range(40):
            if at_low >= NO_MARGIN:
                break
            margin = self._margin(self._trial(now, command, high / 2)[1])[0]
            if margin > 0:
                low, at_low = high / 2, margin
                break
            high, at_high = high / 2, margin
        held = at_low > 0
        for iteration in range(80):
            if not held or high - low <= 1e-15 + 1e-13 * h:
                break
            middle = (low * at_high - high * at_low) / (at_high - at_low)
            if iteration > 40 or not low < middle < high:
                middle = 0.5 * (low + high)
            margin = self._margin(self._trial(now, command, middle)[1])[0]
            if margin <= 0:
                at_low *= _kept_share(margin, at_high) if side < 0 else 1.0
                high, at_high = middle, margin
                if margin == 0:
                    break
                side = -1
            else:
                at_high *= _kept_share(margin, at_low) if side > 0 else 1.0
                low, at_low = middle, margin
                side = 1
        return (*self._trial(now, command, high), held)

    def _stop_joints(self, at: Evaluation, joints: np.ndarray) -> State:
        """The state with the velocities of some joints taken out, as an impulse at them would."""
        if not len(joints):
            return at.state
        matrix, response = compliance(at, joints)
        impulse = np.linalg.solve(matrix, at.jacobian[joints] @ at.state.rate)
        rate = at.state.rate
        rate = rate - response @ impulse if len(joints) < len(rate) else np.zeros_like(rate)
        if self._sensitivity:
            self._sensitivity.stop(at, joints, rate, impulse)
        return replace(at.state, rate=rate)

    def _after_event(self, end: Evaluation, command: Command, held: bool) -> Evaluation:
        """Change the modes; `held` is False where a joint that starts from rest turns back at once: it sticks."""
        joint = self._margin(end)[1]
        if self.mode[joint] == 0:
            self.mode[joint] = 1 if end.stick_force[joint] > 0 else -1
            return self._evaluate(end.state, end.time, command)
        self.mode[joint] = 0
        joints = np.flatnonzero(self.mode == 0)
        state = self._stop_joints(end, joints)
        if held:
            self._decide_modes(self._terms(state, end.time, command), joints)
        return self._evaluate(state, end.time, command)


def _kept_share(margin: float, before: float) -> float:
    """By how much to weigh down the end of the bracket that stayed, when the other end moved twice."""
    share = 1 - margin / before
    return share if share > 0 else 0.5


def _slope(at: Evaluation) -> State:
    return State(at.state.rate, at.acceleration, at.error)
