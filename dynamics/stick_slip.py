"""Motion with dry joint friction over a span of constant command: the plain twin of the middle of `closed_loop.c`.

Each joint either slips one way (mode +1 or -1) or is stuck (mode 0) and then carries the friction torque that keeps its
acceleration zero. Between mode changes the motion is smooth and classical Runge-Kutta integrates it. A mode ends where
a slipping joint comes to rest or a stuck joint reaches its breakaway torque (eq. 24); the step is cut there, to
rounding. At rest, which joints stick is a box-constrained problem in the friction torques. Sensitivities go through
steps by implicit differentiation and through events by their saltation: the velocity zero fixes the event time.
"""

from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from dynamics.friction import FrictionLaw
from dynamics.loop_types import PARAMETER_COUNT, SINGULAR_MASS
from dynamics.parameters import COULOMB, RIGID_BODY, VISCOUS

LP, LI, LD = 64, 65, 66
MAX_EVENTS_PER_SEGMENT = 400
NO_MARGIN = 1e-12  # rad/s, or share of the breakaway torque
_FRACTION = (0.0, 0.5, 0.5, 1.0)
_WEIGHT = (1 / 6, 1 / 3, 1 / 3, 1 / 6)


class MotionStopped(Exception):
    """Integration cannot go on; the text is the reason."""


@dataclass(frozen=True)
class Command:
    """U(t) = value + slope t (6,), rad, and U_dot as the joint PID sees it; with their derivatives (6, 67)."""

    value: np.ndarray
    slope: np.ndarray
    rate: np.ndarray
    d_value: np.ndarray
    d_slope: np.ndarray
    d_rate: np.ndarray


@dataclass(frozen=True)
class State:
    """Pose, pose rate and joint PID integral, (6,) each."""

    pose: np.ndarray
    rate: np.ndarray
    integral: np.ndarray

    def moved(self, slope: "State", h: float) -> "State":
        """The state after a time h at a constant slope."""
        return State(
            self.pose + h * slope.pose, self.rate + h * slope.rate, self.integral + h * slope.integral
        )


@dataclass
class Evaluation:
    """The equation of motion at one state: see `pose_space_motion`; torques in N m, one entry a joint."""

    state: State
    time: float
    mass: np.ndarray
    bias: np.ndarray
    jacobian: np.ndarray
    bias_acceleration: np.ndarray
    angle: np.ndarray
    velocity: np.ndarray
    torque: np.ndarray
    net_torque: np.ndarray = field(default_factory=lambda: np.zeros(6))
    stick_force: np.ndarray = field(default_factory=lambda: np.zeros(6))
    acceleration: np.ndarray = field(default_factory=lambda: np.zeros(6))


class StickSlipMotion:
    """Integrates one robot with parameters (67,) under a friction law; keeps modes, and sensitivities if wanted."""

    def __init__(
        self, functions: dict[str, ca.Function], parameters: np.ndarray, friction: FrictionLaw, sensitivities: bool
    ) -> None:
        self._functions = functions
        self._rigid = parameters[RIGID_BODY]
        self._coulomb, self._viscous = parameters[COULOMB], parameters[VISCOUS]
        self._lp, self._li, self._ld = parameters[64:]
        self._friction = friction
        self._breakaway = friction.static_level * self._coulomb
        self._has_events = np.logical_and(self._coulomb > 0, friction.sticks)
        self.mode = np.zeros(6, dtype=int)
        self.events = 0
        self.tangent = State(*np.zeros((3, 6, PARAMETER_COUNT))) if sensitivities else None

    def torque_at(self, state: State, command: Command) -> np.ndarray:
        """Actuator torques (6,) of the joint PID (eq. 31), N m."""
        return self._terms(state, 0.0, command).torque

    def segment(self, state: State, command: Command, duration: float, steps: int) -> State:
        """The state after `duration` s under one command. Raises MotionStopped."""
        start = self._terms(state, 0.0, command)
        self._follow_frictionless(start)
        self._decide_modes(start, np.flatnonzero(self.mode == 0))
        now = self._evaluate(state, 0.0, command)
        events = 0
        for n in range(1, steps + 1):
            target = duration * n / steps
            while now.time < target:
                h = target - now.time
                stages, end = self._trial(now, command, h)
                if self._margin(end)[0] >= 0 and self._hinted(stages):
                    halfway = self._trial(now, command, h / 2)[1]
                    h, end = (h / 2, halfway) if self._margin(halfway)[0] < 0 else (h, end)
                if self._margin(end)[0] >= 0:
                    self._advance_tangent(stages, command, h)
                    stopped = self._stop_joints(end, np.flatnonzero(self.mode == 0))
                    self._follow_frictionless(end)
                    now = self._evaluate(stopped, target, command)
                    continue
                events += 1
                if events > MAX_EVENTS_PER_SEGMENT:
                    raise MotionStopped("more stick-slip events than a frame can hold")
                h, stages, end, held = self._locate_event(now, command, h, end)
                self._advance_tangent(stages, command, h)
                now = self._after_event(end, command, held)
                self.events += 1
        return now.state

    def _terms(self, state: State, time: float, command: Command) -> Evaluation:
        values = self._functions["equation_of_motion"](state.pose, state.rate, self._rigid)
        mass, bias, jacobian, bias_acceleration, angle = (np.asarray(value, dtype=float) for value in values)
        if not np.isfinite(mass).all():
            raise MotionStopped("the robot left the reachable set (the loop is unstable)")
        try:
            np.linalg.cholesky(mass)
        except np.linalg.LinAlgError:
            raise MotionStopped(SINGULAR_MASS) from None
        angle, velocity = angle[:, 0], jacobian @ state.rate
        error = command.value + command.slope * time - angle
        torque = self._lp * error + self._ld * (command.rate - velocity) + self._li * state.integral
        return Evaluation(
            state, time, mass, bias[:, 0], jacobian, bias_acceleration[:, 0], angle, velocity, torque
        )

    def _evaluate(self, state: State, time: float, command: Command) -> Evaluation:
        """Acceleration for the present modes; stuck joints carry what keeps their acceleration zero."""
        at = self._terms(state, time, command)
        slipping = self.mode != 0
        at.net_torque = at.torque - np.where(slipping, self._slip_friction(at), 0.0)
        free = np.linalg.solve(at.mass, at.jacobian.T @ at.net_torque - at.bias)
        stuck = np.flatnonzero(~slipping)
        if len(stuck):
            compliance, response = self._compliance(at, stuck)
            force = np.linalg.solve(compliance, at.jacobian[stuck] @ free + at.bias_acceleration[stuck])
            at.stick_force[stuck] = force
            at.net_torque[stuck] -= force
            # A robot that stands still stands still: rounding must not make it creep.
            free = free - response @ force if len(stuck) < 6 else np.zeros(6)
        at.acceleration = free
        return at

    def _slip_friction(self, at: Evaluation) -> np.ndarray:
        return self._coulomb * self._friction.dry_level(at.velocity, self.mode) + self._viscous * at.velocity

    @staticmethod
    def _compliance(at: Evaluation, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """J M^-1 J^T (n, n) of some joints, and M^-1 J^T (6, n)."""
        response = np.linalg.solve(at.mass, at.jacobian[joints].T)
        return at.jacobian[joints] @ response, response

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
        compliance, _ = self._compliance(at, joints)
        push = at.jacobian[joints] @ free + at.bias_acceleration[joints]
        limit, force = self._breakaway[joints], np.zeros(len(joints))
        for _ in range(1000):
            before = force.copy()
            for k in range(len(joints)):
                wanted = force[k] + (push[k] - compliance[k] @ force) / compliance[k, k]
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

    def _slope(self, at: Evaluation, command: Command) -> State:
        return State(at.state.rate, at.acceleration, command.value + command.slope * at.time - at.angle)

    def _trial(self, now: Evaluation, command: Command, h: float) -> tuple[list[Evaluation], Evaluation]:
        """One Runge-Kutta step with fixed modes: its four stages, and the evaluation at its end."""
        stages = [now]
        for fraction in _FRACTION[1:]:
            state = now.state.moved(self._slope(stages[-1], command), fraction * h)
            stages.append(self._evaluate(state, now.time + fraction * h, command))
        state = now.state
        for weight, stage in zip(_WEIGHT, stages, strict=True):
            state = state.moved(self._slope(stage, command), weight * h)
        return stages, self._evaluate(state, now.time + h, command)

    def _locate_event(
        self, now: Evaluation, command: Command, h: float, end: Evaluation
    ) -> tuple[float, list[Evaluation], Evaluation, bool]:
        """The step in (0, h] at which the modes stop holding: regula falsi (Illinois) on the margin.

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
                high, at_high = middle, margin
                if margin == 0:
                    break
                at_low = at_low / 2 if side < 0 else at_low
                side = -1
            else:
                low, at_low = middle, margin
                at_high = at_high / 2 if side > 0 else at_high
                side = 1
        return (high, *self._trial(now, command, high), held)

    def _stop_joints(self, at: Evaluation, joints: np.ndarray) -> State:
        """The state with the velocities of some joints taken out, as an impulse at them would."""
        if len(joints) == 6:
            return replace(at.state, rate=np.zeros(6))
        if not len(joints):
            return at.state
        compliance, response = self._compliance(at, joints)
        impulse = np.linalg.solve(compliance, at.jacobian[joints] @ at.state.rate)
        return replace(at.state, rate=at.state.rate - response @ impulse)

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
        after = self._evaluate(state, end.time, command)
        self._saltation(end, after, joint)
        return after

    def _saltation(self, before: Evaluation, after: Evaluation, joint: int) -> None:
        if self.tangent is None:
            return
        approach = before.jacobian[joint] @ before.acceleration + before.bias_acceleration[joint]
        if abs(approach) < 1e-9:
            return
        by_pose = np.asarray(self._functions["rate_map_derivative"](after.state.pose, after.state.rate), dtype=float)
        velocity = by_pose[joint] @ self.tangent.pose + before.jacobian[joint] @ self.tangent.rate
        jump = np.outer(after.acceleration - before.acceleration, velocity / approach)
        self.tangent = replace(self.tangent, rate=self.tangent.rate + jump)

    def _advance_tangent(self, stages: list[Evaluation], command: Command, h: float) -> None:
        if self.tangent is None:
            return
        slopes: list[State] = []
        for fraction, stage in zip(_FRACTION, stages, strict=True):
            at = self.tangent.moved(slopes[-1], fraction * h) if slopes else self.tangent
            slopes.append(self._tangent_slope(stage, command, at))
        for weight, slope in zip(_WEIGHT, slopes, strict=True):
            self.tangent = self.tangent.moved(slope, weight * h)

    def _tangent_slope(self, at: Evaluation, command: Command, x: State) -> State:
        """Time derivative of the sensitivities: the equation of motion differentiated implicitly."""
        values = self._functions["motion_derivatives"](
            at.state.pose, at.state.rate, at.acceleration, at.net_torque, self._rigid
        )
        by_pose, by_rate, columns, crank_by_pose, crank_by_rate = (np.asarray(v, dtype=float) for v in values)
        d_angle = at.jacobian @ x.pose
        d_velocity = crank_by_rate @ x.pose / 2 + at.jacobian @ x.rate
        d_torque = self._torque_tangent(at, command, x, d_angle, d_velocity)
        slipping = self.mode != 0
        right = at.jacobian[slipping].T @ d_torque[slipping] - by_pose @ x.pose - by_rate @ x.rate
        right[:, RIGID_BODY] -= columns
        d_acceleration = np.linalg.solve(at.mass, right)
        stuck = np.flatnonzero(~slipping)
        if len(stuck):
            compliance, response = self._compliance(at, stuck)
            drift = crank_by_pose @ x.pose + crank_by_rate @ x.rate + at.jacobian @ d_acceleration
            d_acceleration -= response @ np.linalg.solve(compliance, drift[stuck])
        return State(x.rate, d_acceleration, command.d_value + at.time * command.d_slope - d_angle)

    def _torque_tangent(
        self, at: Evaluation, command: Command, x: State, d_angle: np.ndarray, d_velocity: np.ndarray
    ) -> np.ndarray:
        """Derivative (6, 67) of the net joint torque, for stuck joints without the force that holds them."""
        slipping = self.mode != 0
        damping = self._ld + np.where(slipping, self._viscous, 0.0)
        dry = self._friction.dry_level(at.velocity, self.mode)
        damping = damping + np.where(slipping, self._coulomb * self._friction.dry_slope(at.velocity, self.mode), 0.0)
        d_error = command.d_value + at.time * command.d_slope - d_angle
        result = self._lp * d_error + self._ld * command.d_rate - damping[:, None] * d_velocity + self._li * x.integral
        joints = np.arange(6)
        result[:, LP] += command.value + command.slope * at.time - at.angle
        result[:, LI] += at.state.integral
        result[:, LD] += command.rate - at.velocity
        result[joints, COULOMB.start + joints] -= np.where(slipping, dry, 0.0)
        result[joints, VISCOUS.start + joints] -= np.where(slipping, at.velocity, 0.0)
        return result
