"""Where the robot is and will be: an extended Kalman filter of the robot in its drives, on the logged commands.

The state: coordinates q (m,), their rates (m,), integral of the joint PID (n,), and what the model has wrong: a torque
at each joint (n,), which walks at random, and viscous friction of each (n,), which stays. Between two frames it follows
the model's equation of motion under the commands that have arrived by then; a frame that is lost only makes it less
certain. Of dry friction the expectation counts, given how well the joint's velocity is known and how far it changes in
a step of the integration: coulomb erf(velocity in the middle of the step / sqrt(2) deviation).

How fast the disturbance walks, and how far the sensor's noise is from what the sensor says, is learnt on the way: the
scales of both covariances climb the likelihood of the innovations, by its exact gradient.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm
from scipy.special import erf

from dynamics.closed_loop.problem import LoopSettings
from dynamics.closed_loop.run import LoopFailure
from dynamics.control.inverse_dynamics import Model

SHORT_STEP, LONG_STEP = 2e-3, 2e-2
"""Of the integration, s: what dry friction does to a joint that turns back takes some milliseconds."""

DOUBT_LASTS = 0.4
"""Frames for which it is unknown which way dry friction acts on a joint that turns back, until a measured pose tells:
what it does meanwhile is noise of the rates. Three quarters of it made mean normalised errors 3 to 11 % larger."""

STEP_SHARE = 0.3
"""Of the change of a joint's velocity in a step, what counts as not known: about the deviation of a velocity that is
anywhere between that at the begin and that at the end. Without it friction that a step finds acting one way acts so to
its end, beyond the turn."""

TURNING = 4.0
"""Standard deviations of a joint's velocity from rest within which it may turn back."""

WALK = 0.003
"""What the disturbance walks in a second before anything has been learnt, relative to the torques at rest. Three times
as much states the errors with a model that is far off better (1.4 instead of 1.9), and makes those with a true one a
fifth larger."""

PLACE_DOUBT, RATE_DOUBT, TORQUE_DOUBT = 1e-4, 1e-5, 1e-3
"""Standard deviations at the start, where the robot rests: m and rad, m/s and rad/s, and of torques at rest."""

VISCOUS_DOUBT = 5.0
"""Standard deviation of the viscous friction that the model does not know of, over the inertia at the joint, 1/s."""

MEMORY = 2.0
"""Time, s, over which what innovations said of the scales fades: what was learnt far from the truth, of a slope that is
another there, would hold them back."""

KNOWN_BEFORE = (2.0, 200.0)
"""Information about the logarithms of the two scales, of the walk and of the sensor's noise, before the run."""

SAME_TIME = 1e-9
"""Frames within which two instants are one."""


@dataclass(frozen=True)
class Estimate:
    """Coordinates and rates (m,) at an instant, with the covariance (m, m) of the coordinates."""

    coordinates: np.ndarray
    rates: np.ndarray
    covariance: np.ndarray


class Observer:
    """Follows one run. `see` a frame, ask `ahead`, `issue` the command; all times in s.

    model: of the robot; pose (6,) at which it stands, held by the command (n,), as the run begins; latencies (frames,):
    when the command of each frame acts, which is known as it is issued; noise(frame): covariance (6, 6) of its pose.
    """

    def __init__(
        self,
        model: Model,
        settings: LoopSettings,
        pose: np.ndarray,
        holding: np.ndarray,
        latencies: np.ndarray,
        noise: Callable[[int], np.ndarray],
    ) -> None:
        robot, timing = model.robot, settings.timing
        self._model, self._noise, self._latencies = model, noise, latencies
        self._drives, self._linear = settings.drives, timing.hold == "linear"
        self._period, self._time = 1 / timing.frame_rate_hz, 0.0
        self._motion = robot.functions["equation_of_motion"]
        self._derivatives = robot.functions["motion_derivatives"]
        rigid, self._coulomb, self._viscous, gains = robot.layout.split(model.parameters)
        self._law = settings.drives.joint_law(gains)
        self._rigid = rigid[None]
        self._m, self._n = len(robot.coordinate_names), robot.layout.joints
        self._arrivals, self._commands = [-np.inf, -np.inf], [holding, holding]
        self._start(pose, holding)

    def _start(self, pose: np.ndarray, holding: np.ndarray) -> None:
        m, n, robot = self._m, self._n, self._model.robot
        torque = robot.static_torque(pose, self._model.dynamic)
        self._state = np.zeros(2 * m + 3 * n)
        self._state[:m] = robot.coordinates(pose)
        if self._drives.torques:
            self._state[2 * m + n : 2 * m + 2 * n] = torque - holding
        else:
            self._state[2 * m : 2 * m + n] = self._model.held(pose, self._drives)[1]
        scale = np.full(n, np.abs(torque).mean())
        self._walk = np.diag(np.concatenate([np.zeros(2 * m + n), (WALK * scale) ** 2, np.zeros(n)]))
        jacobian, free = robot.coordinate_jacobian(pose), robot.geometry.chart.basis
        mass = free.T @ robot.mass_matrix(pose, self._model.dynamic) @ free
        felt = 1 / np.diag(jacobian @ np.linalg.solve(mass, jacobian.T))
        at_rest = [np.full(m, PLACE_DOUBT), np.full(m, RATE_DOUBT), np.zeros(n)]
        doubt = np.concatenate([*at_rest, TORQUE_DOUBT * scale, VISCOUS_DOUBT * felt])
        self._covariance = np.diag(doubt**2)
        self._by_scale = np.zeros((2, 2 * m + 3 * n, 2 * m + 3 * n))
        self._scale, self._information = np.zeros(2), np.diag(KNOWN_BEFORE)

    @property
    def scales(self) -> np.ndarray:
        """Factors (2,) that were learnt: of the covariances of the walk and of the sensor's noise."""
        return np.exp(self._scale)

    @property
    def disturbance(self) -> np.ndarray:
        """Torque (n,) at the joints that the model does not know of."""
        return self._state[2 * self._m + self._n : 2 * self._m + 2 * self._n].copy()

    @property
    def viscous(self) -> np.ndarray:
        """Viscous friction (n,) of the joints that the model does not know of."""
        return self._state[2 * self._m + 2 * self._n :].copy()

    def see(self, frame: int, pose: np.ndarray | None) -> Estimate:
        """Go on to a frame, and take in its measured pose (6,), if it is not lost; what was expected before that."""
        time = frame * self._period
        self._state, self._covariance = self._moved(time, self._state, self._covariance, self._by_scale)
        self._time = time
        expected = self._estimate(self._state, self._covariance)
        if pose is not None:
            self._learn(self._model.robot.coordinates(pose), self._noise(frame))
        return expected

    def arrival(self, frame: int) -> float:
        """When the command of a frame acts, s: not before the one before it."""
        return max(frame * self._period + float(self._latencies[frame]), self._arrivals[-1])

    def ahead(self, time: float) -> Estimate:
        """What is expected at a later time, s, with the commands that are on their way."""
        return self._estimate(*self._moved(time, self._state, self._covariance, None))

    def issue(self, frame: int, command: np.ndarray) -> None:
        """Note the command (n,) of a frame."""
        self._arrivals.append(self.arrival(frame))
        self._commands.append(np.array(command))
        del self._arrivals[: -self._kept()], self._commands[: -self._kept()]

    def _kept(self) -> int:
        return 4 + sum(1 for arrival in self._arrivals if arrival > self._time - 2 * self._period)

    def _estimate(self, state: np.ndarray, covariance: np.ndarray) -> Estimate:
        m = self._m
        return Estimate(state[:m].copy(), state[m : 2 * m].copy(), covariance[:m, :m].copy())

    def _learn(self, measured: np.ndarray, noise: np.ndarray) -> None:
        m, free = self._m, self._model.robot.geometry.chart.basis
        seen = np.exp(self._scale[1]) * free.T @ noise @ free
        innovation = measured - self._state[:m]
        inverse = np.linalg.inv(self._covariance[:m, :m] + seen)
        by_scale = self._by_scale[:, :m, :m].copy()
        by_scale[1] += seen
        told = inverse @ innovation
        shares = inverse @ by_scale
        gradient = 0.5 * (np.einsum("i,kij,j->k", told, by_scale, told) - np.trace(shares, axis1=1, axis2=2))
        before = np.diag(KNOWN_BEFORE)
        self._information = before + np.exp(-self._period / MEMORY) * (self._information - before)
        self._information += 0.5 * np.einsum("aij,bji->ab", shares, shares)
        gain = self._covariance[:, :m] @ inverse
        self._state = self._state + gain @ innovation
        kept = np.eye(len(gain))
        kept[:, :m] -= gain
        self._covariance = kept @ self._covariance @ kept.T + gain @ seen @ gain.T
        self._by_scale = kept @ self._by_scale @ kept.T
        self._by_scale[1] += gain @ seen @ gain.T
        self._scale = self._scale + np.clip(np.linalg.solve(self._information, gradient), -0.5, 0.5)

    def _moved(
        self, time: float, state: np.ndarray, covariance: np.ndarray, by_scale: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """State and covariance at a later time; the derivatives of the covariance by the scales move in place."""
        at, m, longest = self._time, self._m, SHORT_STEP
        while at < time - SAME_TIME * self._period:
            begins = [*self._arrivals, *(arrival + self._period for arrival in self._arrivals)]
            later = [begin for begin in begins if at + SAME_TIME * self._period < begin < time]
            end = min([time, at + longest, *later])
            command, rate = self._acting((at + end) / 2)
            state, map_, rubbed, until_turned = self._step(state, covariance, command, rate, end - at)
            longest = SHORT_STEP if self._linear else float(np.clip(until_turned, SHORT_STEP, LONG_STEP))
            walked = np.exp(self._scale[0]) * (end - at) * self._walk
            covariance = map_ @ covariance @ map_.T + walked
            covariance[m : 2 * m, m : 2 * m] += rubbed
            if by_scale is not None:
                by_scale[:] = map_ @ by_scale @ map_.T
                by_scale[0] += walked
            at = end
        if not np.isfinite(state).all():
            frame = round(time / self._period)
            raise LoopFailure(f"the observer has lost the robot at frame {frame} (t = {time:.3f} s)", frame)
        return state, covariance

    def _acting(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """The command at a time, and what the joint PID takes for its rate."""
        newest = max(k for k, arrival in enumerate(self._arrivals) if arrival <= time)
        before = self._commands[max(newest - 1, 0)]
        change = self._commands[newest] - before
        done = min((time - self._arrivals[newest]) / self._period, 1.0) if self._linear else 1.0
        return before + done * change, change / self._period

    def _step(
        self, state: np.ndarray, covariance: np.ndarray, command: np.ndarray, rate: np.ndarray, length: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """The state after a time, s, its derivative by the state: an exponential step, exact for linear motion; the
        covariance (m, m) of the rates that dry friction adds; and the time, s, that is left until a joint may turn."""
        slope, by_state, unsure, until_turned = self._slope(state, covariance, command, rate, length)
        size = len(state)
        augmented = np.zeros((size + 1, size + 1))
        augmented[:size, :size], augmented[:size, size] = by_state, slope
        moved = expm(length * augmented)
        push = by_state[self._m : 2 * self._m, 2 * self._m + self._n : 2 * self._m + 2 * self._n]
        rubbed = length * DOUBT_LASTS * self._period * (push * unsure) @ push.T
        return state + moved[:size, size], moved[:size, :size], rubbed, until_turned - length

    def _slope(
        self, state: np.ndarray, covariance: np.ndarray, command: np.ndarray, command_rate: np.ndarray, length: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        m, n, law = self._m, self._n, self._law
        li, ld, stiff = law.li, law.ld, law.lp + law.lx
        q, rate, integral, disturbance, more = np.split(state, [m, 2 * m, 2 * m + n, 2 * m + 2 * n])
        found = self._motion(q[None], rate[None], self._rigid)
        mass, bias, jacobian, _, angle, *_ = (part[0] for part in found)
        velocity, error = jacobian @ rate, command - angle[:, 0]
        pid = not self._drives.torques
        by_error = law.lp * error + li * integral - law.lx * angle[:, 0]
        torque = by_error + ld * (law.rate_weight * command_rate - velocity) if pid else command
        limit, growing = self._drives.torque_limit, error
        if limit is not None:
            further = (np.abs(torque) >= limit) & ((li * error - law.lx * velocity) * torque > 0)
            growing = np.where(further, law.lx * velocity / (li or 1.0), error)
            torque = np.clip(torque, -limit, limit)
        push, known = np.linalg.solve(mass, jacobian.T), covariance[m : 2 * m, m : 2 * m]
        falling = np.linalg.solve(mass, bias[:, 0])
        without = torque + disturbance - (self._viscous + more) * velocity
        level = self._expected_friction(velocity, jacobian, known, np.zeros(n))[0]
        change = length * jacobian @ (push @ (without - self._coulomb * level) - falling)
        level, by_velocity, unsure, width = self._expected_friction(velocity, jacobian, known, change)
        net = without - self._coulomb * level
        acceleration = push @ net - falling
        given = (q[None], rate[None], acceleration[None], net[None], self._rigid)
        by_q, by_rate, _, _, turning = (part[0] for part in self._derivatives(*given))
        damping = (ld * pid + self._viscous + more + self._coulomb * by_velocity)[:, None]
        net_by_q = -stiff * pid * jacobian - damping * (turning / 2)
        by_state = np.zeros((len(state), len(state)))
        by_state[:m, m : 2 * m] = np.eye(m)
        by_state[m : 2 * m, :m] = push @ net_by_q - np.linalg.solve(mass, by_q)
        by_state[m : 2 * m, m : 2 * m] = -push @ (damping * jacobian) - np.linalg.solve(mass, by_rate)
        by_state[m : 2 * m, 2 * m : 2 * m + n] = li * pid * push
        by_state[m : 2 * m, 2 * m + n : 2 * m + 2 * n] = push
        by_state[m : 2 * m, 2 * m + 2 * n :] = -push * velocity
        by_state[2 * m : 2 * m + n, :m] = -pid * jacobian
        until_turned = np.min((np.abs(velocity) - TURNING * width) / np.maximum(np.abs(jacobian @ acceleration), 1e-12))
        slope = np.concatenate([rate, acceleration, pid * growing, np.zeros(2 * n)])
        return slope, by_state, unsure, float(until_turned)

    def _expected_friction(
        self, velocity: np.ndarray, jacobian: np.ndarray, covariance: np.ndarray, change: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Expectation of dry friction over the Coulomb torque, its derivative by the velocity, the variance of its
        torque about this line, and how well the velocity is known, each (n,): the line at the middle of a step in which
        the velocity changes by so much (n,)."""
        law = self._model.friction
        smooth = np.sqrt(2 / np.pi) * (law.smoothing_velocity or 0.0)
        variance = np.einsum("ij,jk,ik->i", jacobian, covariance, jacobian) + (STEP_SHARE * change) ** 2
        width, velocity = np.sqrt(variance + smooth**2 + 1e-12), velocity + change / 2
        more = np.abs(law.level(velocity)) if law.name == "stribeck" else 1.0
        ratio = velocity / width
        level, slope = more * erf(ratio / np.sqrt(2)), np.sqrt(2 / np.pi) / width * np.exp(-(ratio**2) / 2)
        unsure = self._coulomb**2 * np.maximum(more**2 - level**2 - (slope * width) ** 2, 0.0)
        return level - slope * change / 2, slope, unsure, width
