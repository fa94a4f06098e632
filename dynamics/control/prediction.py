"""One time step of a robot with its drives, and the effect of errors of its state.

The state has coordinates q (m,), their rates (m,) and the integral of the joint PID (n,). It also
has constant values. They are a torque (n,) and viscous friction (n,) at the joints, in addition to
those of the model, and an offset of the sensor (m,) that all measured poses have in common.

Without dry friction, a step uses the matrix exponential, which is exact for linear motion. Dry
friction is then added implicitly, like contacts in time-stepping methods (Moreau, Unilateral
contact and dry friction in finite freedom dynamics, 1988). Let u be the velocity of a joint at the
end of the step without its own dry friction, and b the largest change of u by the joint's Coulomb
torque. If |u| > b, the joint slips, and |u| is reduced by b; otherwise, it comes to rest. Since u
is uncertain, the torque is the expectation, over normally distributed u, of

    torque = coulomb sat(u / b),    sat(x) = min(1, max(-1, x))
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm
from scipy.special import ndtr

from dynamics.closed_loop.loop_settings import LoopSettings
from dynamics.control.inverse_dynamics import Model

# Largest number of iterations of Newton's method for the friction of all joints.
MOST_ITERATIONS = 12
# Ratio of a joint's friction error to the largest friction, below which the iterations end.
FRICTION_TOLERANCE = 1e-6
# Smallest standard deviation of a joint's velocity, rad/s or m/s: no velocity is known exactly.
LEAST_WIDTH = 1e-9
SHORTEST_HALVED = 1.5e-3  # length, s, below which no step is halved, even if a joint reverses in it
# Smallest ratio of the velocity change by dry friction to the velocity's standard deviation. It is
# above zero because the velocity change is a divisor.
LEAST_REACH = 1e-3


class StateSlices(NamedTuple):
    """Slices of the parts of a state: first the parts that move, then the constant parts."""

    coordinates: slice
    rates: slice
    integral: slice
    torque: slice
    viscous: slice
    offset: slice

    @classmethod
    def of(cls, m: int, n: int) -> "StateSlices":
        """Slices for a robot with m coordinates and n joints."""
        ends = np.cumsum([m, m, n, n, n, m]).tolist()
        return cls(*(slice(begin, end) for begin, end in pairwise([0, *ends])))

    @property
    def moving(self) -> slice:
        """Slice of the parts that move: coordinates, rates, integral."""
        return slice(0, self.integral.stop)

    @property
    def size(self) -> int:
        """Number of entries of a state."""
        return self.offset.stop


class Prediction:
    """Time steps of a robot with its drives, according to a model.

    The filter of the law `pid_filtered` is neglected.
    """

    def __init__(self, model: Model, settings: LoopSettings) -> None:
        robot = model.robot
        self.blocks = StateSlices.of(len(robot.coordinate_names), robot.layout.joints)
        rigid, self._coulomb, self._viscous, gains = robot.layout.split(model.parameters)
        self._rigid = rigid[None]
        self._friction = model.friction
        self._drives = settings.drives
        self._law = settings.drives.joint_law(gains)
        self._motion = robot.functions["equation_of_motion"]
        self._derivatives = robot.functions["motion_derivatives"]

    def step(
        self,
        state: np.ndarray,
        covariance: np.ndarray,
        command: np.ndarray,
        command_rate: np.ndarray,
        length: float,
    ) -> tuple[np.ndarray, np.ndarray]:
        """State after a step of a `length`, s, in which a command (n,) and its rate act.

        Also returns the map (size, size) from errors of the state before to errors after. The
        covariance (size, size) of the state determines how well the velocities of joints are known.
        A step in which a joint comes to rest or breaks away is halved until this event changes the
        joint's velocity by less than the standard deviation of the velocity, or until the step is
        shorter than SHORTEST_HALVED.
        """
        after, errors, too_long = self._once(state, covariance, command, command_rate, length)
        if not too_long or length < SHORTEST_HALVED:
            return after, errors
        midway, first = self.step(state, covariance, command, command_rate, length / 2)
        after, second = self.step(
            midway, first @ covariance @ first.T, command, command_rate, length / 2
        )
        return after, second @ first

    def _once(
        self,
        state: np.ndarray,
        covariance: np.ndarray,
        command: np.ndarray,
        command_rate: np.ndarray,
        length: float,
    ) -> tuple[np.ndarray, np.ndarray, bool]:
        """State and map of errors after one step, and True if the step is too long.

        It is too long if a joint that comes to rest or breaks away changes its velocity by more
        than the standard deviation of the velocity.
        """
        blocks = self.blocks
        after, errors, jacobian = self._without_dry_friction(state, command, command_rate, length)
        if not self._coulomb.any():
            return after, errors, False
        by_rates = jacobian @ errors[blocks.rates]
        velocity = jacobian @ after[blocks.rates]
        # changes of state and of joint velocities by unit torques over the step
        state_by_torque = errors[blocks.moving, blocks.torque]
        velocity_by_torque = jacobian @ state_by_torque[blocks.rates]
        width = np.sqrt(np.einsum("ij,jk,ik->i", by_rates, covariance, by_rates) + LEAST_WIDTH**2)
        largest, smooth = self._dry(velocity)
        friction, gains = expected_dry_friction(
            velocity, width, velocity_by_torque, largest, smooth
        )
        # friction at one joint changes the velocities, and thus the friction, of the others
        gain = np.linalg.solve(
            np.eye(len(friction))
            + gains[:, None] * (velocity_by_torque - np.diag(np.diag(velocity_by_torque))),
            np.diag(gains),
        )
        after[blocks.moving] -= state_by_torque @ friction
        errors[blocks.moving] -= state_by_torque @ gain @ by_rates
        speed = np.maximum(
            np.abs(jacobian @ state[blocks.rates]), np.abs(jacobian @ after[blocks.rates])
        )
        # velocity that additional friction could remove
        unused = np.diag(velocity_by_torque) * (largest - np.abs(friction))
        return after, errors, bool((np.minimum(speed, unused) > width).any())

    def _dry(self, velocity: np.ndarray) -> tuple[np.ndarray, float]:
        """Largest dry friction (n,) at joint velocities, and the law's smoothing velocity or 0."""
        law = self._friction
        largest = self._coulomb
        if law.name == "stribeck":
            largest = largest * np.where(
                velocity == 0.0, law.static_ratio, np.abs(law.level(velocity))
            )
        return largest, law.smoothing_velocity or 0.0

    def _without_dry_friction(
        self, state: np.ndarray, command: np.ndarray, command_rate: np.ndarray, length: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """State after a step, map of errors, and Jacobian of the joints (n, m) at its start."""
        slope, by_state, jacobian = self._slope(state, command, command_rate)
        moving = self.blocks.moving
        size = len(slope)
        constant = slice(size, by_state.shape[1])
        augmented = np.zeros((by_state.shape[1] + 1, by_state.shape[1] + 1))
        augmented[moving, :-1] = length * by_state
        augmented[moving, -1] = length * slope
        transition = expm(augmented)
        after = state.copy()
        errors = np.eye(self.blocks.size)
        after[moving] += transition[moving, -1]
        errors[moving, moving] = transition[moving, moving]
        errors[moving, constant] = transition[moving, constant]
        return after, errors, jacobian

    def _slope(
        self, state: np.ndarray, command: np.ndarray, command_rate: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Time derivative of the moving parts, its derivatives, and the joint Jacobian (n, m).

        The derivatives are with respect to the state without the offset, and ignore the torque
        limit.
        """
        blocks = self.blocks
        law = self._law
        by_pid = not self._drives.torques
        li = law.li
        ld = law.ld
        stiffness = law.lp + law.lx
        q = state[blocks.coordinates]
        rate = state[blocks.rates]
        integral = state[blocks.integral]
        outputs = self._motion(q[None], rate[None], self._rigid)
        mass, bias, jacobian, _, angle, *_ = (part[0] for part in outputs)
        velocity = jacobian @ rate
        error = command - angle[:, 0]
        by_error = law.lp * error + li * integral - law.lx * angle[:, 0]
        torque = by_error + ld * (law.rate_weight * command_rate - velocity) if by_pid else command
        limit = self._drives.torque_limit
        integral_rate = error
        if limit is not None:
            # conditional integration, as in the drives
            winds_up = (np.abs(torque) >= limit) & ((li * error - law.lx * velocity) * torque > 0)
            integral_rate = np.where(winds_up, law.lx * velocity / np.where(li, li, 1.0), error)
            torque = np.clip(torque, -limit, limit)
        push = np.linalg.solve(mass, jacobian.T)
        bias_acceleration = np.linalg.solve(mass, bias[:, 0])
        viscous = self._viscous + state[blocks.viscous]
        net = torque + state[blocks.torque] - viscous * velocity
        acceleration = push @ net - bias_acceleration
        arguments = (q[None], rate[None], acceleration[None], net[None], self._rigid)
        by_q, by_rate, _, _, turning = (part[0] for part in self._derivatives(*arguments))
        # the derivative of the joint accelerations with respect to the rates is 2 J_theta_dot
        damping = (ld * by_pid + viscous)[:, None]
        by_state = np.zeros((blocks.moving.stop, blocks.offset.start))
        by_state[blocks.coordinates, blocks.rates] = np.eye(len(rate))
        rate_rows = by_state[blocks.rates]
        rate_rows[:, blocks.coordinates] = push @ (
            (-stiffness * by_pid)[:, None] * jacobian - damping * (turning / 2)
        )
        rate_rows[:, blocks.coordinates] -= np.linalg.solve(mass, by_q)
        rate_rows[:, blocks.rates] = -push @ (damping * jacobian) - np.linalg.solve(mass, by_rate)
        rate_rows[:, blocks.integral] = li * by_pid * push
        rate_rows[:, blocks.torque] = push
        rate_rows[:, blocks.viscous] = -push * velocity
        by_state[blocks.integral, blocks.coordinates] = -by_pid * jacobian
        return np.concatenate([rate, acceleration, by_pid * integral_rate]), by_state, jacobian


def expected_dry_friction(
    velocity: np.ndarray,
    width: np.ndarray,
    velocity_by_torque: np.ndarray,
    largest: np.ndarray,
    smooth: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Expected dry friction (n,) over a step, and its gain (n,) for errors of the joint velocities.

    `velocity` (n,) are the joint velocities after the step without dry friction. Their errors are
    normal, with standard deviations `width` (n,). `velocity_by_torque` (n, n) is the change of the
    velocities by unit torques over the step, and `largest` (n,) is the largest dry friction.
    `smooth` is the smoothing velocity of the law, or 0.

    Dry friction brings a part of the distribution of velocities to rest. The gain is chosen so that
    propagated errors have the variance that remains. The slope of the expected torque would give
    another variance.
    """
    own_effect = np.diag(velocity_by_torque)
    reach = np.maximum(own_effect * largest + smooth, LEAST_REACH * width)
    others = velocity_by_torque - np.diag(own_effect)
    # Newton's method; in its initial guess, each joint slips or rests as if it were alone
    friction = largest * np.sign(velocity) * (np.abs(velocity) > reach)
    for _ in range(MOST_ITERATIONS):
        saturation, slope, _ = expected_saturation(velocity - others @ friction, width, reach)
        residual = largest * saturation - friction
        friction = friction + np.linalg.solve(
            np.eye(len(friction)) + (largest * slope)[:, None] * others, residual
        )
        if np.abs(residual).max() <= FRICTION_TOLERANCE * largest.max():
            break
    _, slope, variance = expected_saturation(velocity - others @ friction, width, reach)
    change = own_effect * largest
    # fraction of the variance of a velocity that remains after dry friction
    remaining = 1 - 2 * change * slope + (change / width) ** 2 * variance
    gain = (1 - np.sqrt(np.clip(remaining, 0.0, 1.0))) / own_effect
    return np.clip(friction, -largest, largest), gain


def expected_saturation(
    mean: np.ndarray, deviation: np.ndarray, reach: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Expectation of sat(u / reach) over normal u, its derivative, and the variance of sat.

    The derivative is with respect to the mean of u. Arrays have any shape. The standard deviation
    `deviation` of u and `reach` are > 0.
    """
    low = (-reach - mean) / deviation
    high = (reach - mean) / deviation
    inside = ndtr(high) - ndtr(low)
    at_low, at_high = (np.exp(-(end**2) / 2) / np.sqrt(2 * np.pi) for end in (low, high))
    line = mean * inside + deviation * (at_low - at_high)
    square = mean * line + deviation * (deviation * inside - reach * (at_low + at_high))
    saturation = ndtr(-high) - ndtr(low) + line / reach
    variance = 1 - inside + square / reach**2 - saturation**2
    return saturation, inside / reach, np.maximum(variance, 0.0)
