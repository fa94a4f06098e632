"""One step of a robot in its drives, from what is known of it now to what will be known of it.

The state: coordinates q (m,) and their rates (m,), the integral of the joint PID (n,); and what stays as it is: a
torque at each joint (n,) and viscous friction of each (n,) of which the model does not know, and what all measured
poses have in common (m,), an offset of the sensor.

Without dry friction a step is an exponential one, exact for linear motion. Dry friction is then taken in implicitly, as
time stepping does for contacts (Moreau, Unilateral contact and dry friction in finite freedom dynamics, 1988): a joint
that would end the step with a velocity u, friction of the others counted, keeps what is beyond b, the change that the
Coulomb torque can make in a step, and rests otherwise. The velocity is not known exactly, so that of this

    torque = coulomb sat(u / b),    sat(x) = min(1, max(-1, x))

the expectation counts, over normal u.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm
from scipy.special import ndtr

from dynamics.closed_loop.problem import LoopSettings
from dynamics.control.inverse_dynamics import Model

ROUNDS, SETTLED = 12, 1e-6
"""Of Newton's method over the joints, and the error of a saturation at which it ends."""

LEAST_WIDTH = 1e-9
"""Standard deviation of a joint's velocity, rad/s or m/s: it is never known exactly."""

SHORTEST = 1.5e-3
"""Time, s, that is not halved where a joint turns."""

LEAST_REACH = 1e-3
"""Of what dry friction can change in a step, over that deviation: where there is none, a division by zero."""


class Blocks(NamedTuple):
    """Where the parts of a state lie: those that move, then those that stay as they are."""

    coordinates: slice
    rates: slice
    integral: slice
    torque: slice
    viscous: slice
    offset: slice

    @classmethod
    def of(cls, m: int, n: int) -> "Blocks":
        """Of a robot with so many coordinates, m, and joints, n."""
        ends = np.cumsum([m, m, n, n, n, m]).tolist()
        return cls(*(slice(begin, end) for begin, end in pairwise([0, *ends])))

    @property
    def moving(self) -> slice:
        """What moves: coordinates, rates, integral."""
        return slice(0, self.integral.stop)

    @property
    def size(self) -> int:
        """Of a state."""
        return self.offset.stop


class Prediction:
    """Steps of a robot as a model has it, in its drives."""

    def __init__(self, model: Model, settings: LoopSettings) -> None:
        robot = model.robot
        self.blocks = Blocks.of(len(robot.coordinate_names), robot.layout.joints)
        rigid, self._coulomb, self._viscous, gains = robot.layout.split(model.parameters)
        self._rigid, self._friction, self._drives = rigid[None], model.friction, settings.drives
        self._law = settings.drives.joint_law(gains)
        self._motion = robot.functions["equation_of_motion"]
        self._derivatives = robot.functions["motion_derivatives"]

    def step(
        self, state: np.ndarray, covariance: np.ndarray, command: np.ndarray, command_rate: np.ndarray, length: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """The state after a time, s, in which a command and its rate (n,) act; and the map (size, size) of errors.

        covariance (size, size): of the state, which says how well the velocities of joints are known. A time in which a
        joint comes to rest or breaks away is halved until that makes less of its velocity than is not known of it.
        """
        after, errors, turns = self._once(state, covariance, command, command_rate, length)
        if not turns or length < SHORTEST:
            return after, errors
        midway, first = self.step(state, covariance, command, command_rate, length / 2)
        after, second = self.step(midway, first @ covariance @ first.T, command, command_rate, length / 2)
        return after, second @ first

    def _once(
        self, state: np.ndarray, covariance: np.ndarray, command: np.ndarray, command_rate: np.ndarray, length: float
    ) -> tuple[np.ndarray, np.ndarray, bool]:
        """The same in one go, and whether a joint comes to rest or breaks away by more than is not known of it."""
        at = self.blocks
        free, errors, jacobian = self._without_dry_friction(state, command, command_rate, length)
        if not self._coulomb.any():
            return free, errors, False
        by_rates, velocity = jacobian @ errors[at.rates], jacobian @ free[at.rates]
        pushed = errors[at.moving, at.torque]  # by a torque over the step
        turned = jacobian @ pushed[at.rates]
        width = np.sqrt(np.einsum("ij,jk,ik->i", by_rates, covariance, by_rates) + LEAST_WIDTH**2)
        largest, smooth = self._dry(velocity)
        level, kept = expected_dry_friction(velocity, width, turned, largest, smooth)
        gain = np.linalg.solve(np.eye(len(level)) + kept[:, None] * (turned - np.diag(np.diag(turned))), np.diag(kept))
        free[at.moving] -= pushed @ level
        errors[at.moving] -= pushed @ gain @ by_rates
        moved = np.maximum(np.abs(jacobian @ state[at.rates]), np.abs(jacobian @ free[at.rates]))
        unused = np.diag(turned) * (largest - np.abs(level))  # what more friction could take of the velocity
        return free, errors, bool((np.minimum(moved, unused) > width).any())

    def _dry(self, velocity: np.ndarray) -> tuple[np.ndarray, float]:
        """The largest dry friction (n,) at joint velocities, and the velocity over which it turns."""
        law, largest = self._friction, self._coulomb
        if law.name == "stribeck":
            largest = largest * np.where(velocity == 0.0, law.static_ratio, np.abs(law.level(velocity)))
        return largest, law.smoothing_velocity or 0.0

    def _without_dry_friction(
        self, state: np.ndarray, command: np.ndarray, command_rate: np.ndarray, length: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """State after the step, the map of errors, and the Jacobian of the joints (n, m) at its start."""
        slope, by_state, jacobian = self._slope(state, command, command_rate)
        moving, size = self.blocks.moving, len(slope)
        held = slice(size, by_state.shape[1])
        augmented = np.zeros((by_state.shape[1] + 1, by_state.shape[1] + 1))
        augmented[moving, :-1], augmented[moving, -1] = length * by_state, length * slope
        moved, after, errors = expm(augmented), state.copy(), np.eye(self.blocks.size)
        after[moving] += moved[moving, -1]
        errors[moving, moving], errors[moving, held] = moved[moving, moving], moved[moving, held]
        return after, errors, jacobian

    def _slope(
        self, state: np.ndarray, command: np.ndarray, command_rate: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """d/dt of what moves, its derivative by the state but for the offset, and the Jacobian of the joints (n, m)."""
        at, law, pid = self.blocks, self._law, not self._drives.torques
        li, ld, stiff = law.li, law.ld, law.lp + law.lx
        q, rate, integral = state[at.coordinates], state[at.rates], state[at.integral]
        found = self._motion(q[None], rate[None], self._rigid)
        mass, bias, jacobian, _, angle, *_ = (part[0] for part in found)
        velocity, error = jacobian @ rate, command - angle[:, 0]
        by_error = law.lp * error + li * integral - law.lx * angle[:, 0]
        torque = by_error + ld * (law.rate_weight * command_rate - velocity) if pid else command
        limit, growing = self._drives.torque_limit, error
        if limit is not None:
            further = (np.abs(torque) >= limit) & ((li * error - law.lx * velocity) * torque > 0)
            growing = np.where(further, law.lx * velocity / (li or 1.0), error)
            torque = np.clip(torque, -limit, limit)
        push, falling = np.linalg.solve(mass, jacobian.T), np.linalg.solve(mass, bias[:, 0])
        viscous = self._viscous + state[at.viscous]
        net = torque + state[at.torque] - viscous * velocity
        acceleration = push @ net - falling
        given = (q[None], rate[None], acceleration[None], net[None], self._rigid)
        by_q, by_rate, _, _, turning = (part[0] for part in self._derivatives(*given))
        damping = (ld * pid + viscous)[:, None]
        by_state = np.zeros((at.moving.stop, at.offset.start))
        by_state[at.coordinates, at.rates] = np.eye(len(rate))
        of_rates = by_state[at.rates]
        of_rates[:, at.coordinates] = push @ (-stiff * pid * jacobian - damping * (turning / 2))
        of_rates[:, at.coordinates] -= np.linalg.solve(mass, by_q)
        of_rates[:, at.rates] = -push @ (damping * jacobian) - np.linalg.solve(mass, by_rate)
        of_rates[:, at.integral], of_rates[:, at.torque] = li * pid * push, push
        of_rates[:, at.viscous] = -push * velocity
        by_state[at.integral, at.coordinates] = -pid * jacobian
        return np.concatenate([rate, acceleration, pid * growing]), by_state, jacobian


def expected_dry_friction(
    velocity: np.ndarray, width: np.ndarray, turned: np.ndarray, largest: np.ndarray, smooth: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Dry friction (n,) over a step, and how it answers to errors of each joint's velocity (n,).

    velocity (n,): that of the joints after the step without dry friction, normal with standard deviations width (n,);
    turned (n, n): what a torque over the step makes of them; largest (n,): torque; smooth: velocity over which it
    turns. Errors of a joint's velocity are passed on by so much that their variance is that after dry friction, of
    which some of the drawn joints rest, not that of a line through it.
    """
    own = np.diag(turned)
    reach, others = np.maximum(own * largest + smooth, LEAST_REACH * width), turned - np.diag(own)
    level = largest * np.sign(velocity) * (np.abs(velocity) > reach)
    for _ in range(ROUNDS):
        share, slope, _ = expected_saturation(velocity - others @ level, width, reach)
        miss = largest * share - level
        level = level + np.linalg.solve(np.eye(len(level)) + (largest * slope)[:, None] * others, miss)
        if np.abs(miss).max() <= SETTLED * largest.max():
            break
    _, slope, variance = expected_saturation(velocity - others @ level, width, reach)
    change = own * largest
    passed = 1 - 2 * change * slope + (change / width) ** 2 * variance
    return np.clip(level, -largest, largest), (1 - np.sqrt(np.clip(passed, 0.0, 1.0))) / own


def expected_saturation(
    mean: np.ndarray, deviation: np.ndarray, reach: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Expectation of sat(u / reach) over normal u, its derivative by the mean, and its variance, of any shape;
    deviation and reach > 0."""
    low, high = (-reach - mean) / deviation, (reach - mean) / deviation
    inside = ndtr(high) - ndtr(low)
    at_low, at_high = (np.exp(-(end**2) / 2) / np.sqrt(2 * np.pi) for end in (low, high))
    line = mean * inside + deviation * (at_low - at_high)
    square = mean * line + deviation * (deviation * inside - reach * (at_low + at_high))
    share = ndtr(-high) - ndtr(low) + line / reach
    return share, inside / reach, np.maximum(1 - inside + square / reach**2 - share**2, 0.0)
