"""Where the robot is and will be: an extended Kalman filter of the robot in its drives, on the logged commands.

Between two frames the state follows the model under the commands that have arrived by then (`prediction`); a frame that
is lost only makes it less certain. Of what the model has wrong, the torque at each joint walks at random, viscous
friction stays, and so does what all measured poses have in common: of that no pose tells, but it is not forgotten.

How fast the torque walks, and how far the sensor's noise is from what the sensor says, is learnt on the way: the scales
of both covariances climb the likelihood of the innovations, by its exact gradient.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dynamics.closed_loop.problem import LoopSettings
from dynamics.control.inverse_dynamics import Model
from dynamics.control.prediction import Prediction
from dynamics.errors import SimulationError

STEP = 3e-3
"""Of the prediction, s, at most: what dry friction does to a joint that turns back takes some milliseconds."""

PLACE_DOUBT, RATE_DOUBT, TORQUE_DOUBT = 1e-4, 1e-5, 1e-3
"""Standard deviations at the start, where the robot rests: m and rad, m/s and rad/s, and of torques at rest."""

VISCOUS_DOUBT = 5.0
"""Standard deviation of the viscous friction that the model does not know of, over the inertia at the joint, 1/s."""

SCALE_FELT = 2.0
"""How much more of a model's error torques meet than joint commands do: that of the factor common to all parameters."""

MEMORY = 2.0
"""Time, s, over which what innovations said of the scales fades: what was learnt far from the truth, of a slope that is
another there, would hold them back."""

KNOWN_BEFORE = (0.3, 200.0)
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
    when the command of each frame acts, which is known as it is issued; noise(frame): covariance (6, 6) of its pose;
    common (6, 6): that of what all measured poses have in common.
    """

    def __init__(
        self,
        model: Model,
        settings: LoopSettings,
        pose: np.ndarray,
        holding: np.ndarray,
        latencies: np.ndarray,
        noise: Callable[[int], np.ndarray],
        common: np.ndarray,
    ) -> None:
        timing = settings.timing
        self._model, self._noise, self._latencies = model, noise, latencies
        self._drives, self._linear = settings.drives, timing.hold == "linear"
        self._period, self._time = 1 / timing.frame_rate_hz, 0.0
        self._prediction = Prediction(model, settings)
        self._arrivals, self._commands = [-np.inf, -np.inf], [holding, holding]
        self._start(pose, holding, common)

    def _start(self, pose: np.ndarray, holding: np.ndarray, common: np.ndarray) -> None:
        at, robot = self._prediction.blocks, self._model.robot
        torque, free = robot.static_torque(pose, self._model.dynamic), robot.geometry.chart.basis
        self._state = np.zeros(at.size)
        self._state[at.coordinates] = robot.coordinates(pose)
        if self._drives.torques:
            self._state[at.torque] = torque - holding
        else:
            self._state[at.integral] = self._model.held(pose, self._drives)[1]
        scale = np.abs(torque).mean()
        # in a frame the walk changes by as much as the error of a model does, which is smooth along a motion
        walk, doubt = np.zeros(at.size), np.zeros(at.size)
        felt_scale = SCALE_FELT if self._drives.torques else 1.0
        walk[at.torque] = felt_scale * self._model.doubt * scale * np.sqrt(self._period)
        self._walk = np.diag(walk**2)
        jacobian = robot.coordinate_jacobian(pose)
        mass = free.T @ robot.mass_matrix(pose, self._model.dynamic) @ free
        felt = 1 / np.diag(jacobian @ np.linalg.solve(mass, jacobian.T))
        doubt[at.coordinates], doubt[at.rates] = PLACE_DOUBT, RATE_DOUBT
        doubt[at.torque], doubt[at.viscous] = TORQUE_DOUBT * scale, VISCOUS_DOUBT * felt
        self._covariance = np.diag(doubt**2)
        self._covariance[at.offset, at.offset] = free.T @ common @ free
        self._seen = np.zeros((len(mass), at.size))
        self._seen[:, at.coordinates] = self._seen[:, at.offset] = np.eye(len(mass))
        self._by_scale = np.zeros((2, at.size, at.size))
        self._scale, self._information = np.zeros(2), np.diag(KNOWN_BEFORE)

    @property
    def scales(self) -> np.ndarray:
        """Factors (2,) that were learnt: of the covariances of the walk and of the sensor's noise."""
        return np.exp(self._scale)

    @property
    def disturbance(self) -> np.ndarray:
        """Torque (n,) at the joints that the model does not know of."""
        return self._state[self._prediction.blocks.torque].copy()

    @property
    def viscous(self) -> np.ndarray:
        """Viscous friction (n,) of the joints that the model does not know of."""
        return self._state[self._prediction.blocks.viscous].copy()

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
        at = self._prediction.blocks
        place = covariance[at.coordinates, at.coordinates]
        return Estimate(state[at.coordinates].copy(), state[at.rates].copy(), place.copy())

    def _learn(self, measured: np.ndarray, noise: np.ndarray) -> None:
        seen, free = self._seen, self._model.robot.geometry.chart.basis
        noise = np.exp(self._scale[1]) * free.T @ noise @ free
        innovation = measured - seen @ self._state
        inverse = np.linalg.inv(seen @ self._covariance @ seen.T + noise)
        by_scale = seen @ self._by_scale @ seen.T
        by_scale[1] += noise
        told = inverse @ innovation
        shares = inverse @ by_scale
        gradient = 0.5 * (np.einsum("i,kij,j->k", told, by_scale, told) - np.trace(shares, axis1=1, axis2=2))
        before = np.diag(KNOWN_BEFORE)
        self._information = before + np.exp(-self._period / MEMORY) * (self._information - before)
        self._information += 0.5 * np.einsum("aij,bji->ab", shares, shares)
        gain = self._covariance @ seen.T @ inverse
        self._state = self._state + gain @ innovation
        kept = np.eye(len(gain)) - gain @ seen
        self._covariance = kept @ self._covariance @ kept.T + gain @ noise @ gain.T
        self._by_scale = kept @ self._by_scale @ kept.T
        self._by_scale[1] += gain @ noise @ gain.T
        self._scale = self._scale + np.clip(np.linalg.solve(self._information, gradient), -0.5, 0.5)

    def _moved(
        self, time: float, state: np.ndarray, covariance: np.ndarray, by_scale: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """State and covariance at a later time; the derivatives of the covariance by the scales move in place."""
        at = self._time
        while at < time - SAME_TIME * self._period:
            begins = [*self._arrivals, *(arrival + self._period for arrival in self._arrivals)]
            later = [begin for begin in begins if at + SAME_TIME * self._period < begin < time]
            until = min([time, *later])
            end = at + (until - at) / np.ceil((until - at) / STEP)
            command, rate = self._acting((at + end) / 2)
            state, errors = self._prediction.step(state, covariance, command, rate, end - at)
            walked = np.exp(self._scale[0]) * (end - at) * self._walk
            covariance = errors @ covariance @ errors.T + walked
            if by_scale is not None:
                by_scale[:] = errors @ by_scale @ errors.T
                by_scale[0] += walked
            at = end
        if not np.isfinite(state).all():
            raise SimulationError(f"the observer has lost the robot: its prediction for {time:.3f} s is not finite")
        return state, covariance

    def _acting(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """The command at a time, and what the joint PID takes for its rate."""
        newest = max(k for k, arrival in enumerate(self._arrivals) if arrival <= time)
        before = self._commands[max(newest - 1, 0)]
        change = self._commands[newest] - before
        done = min((time - self._arrivals[newest]) / self._period, 1.0) if self._linear else 1.0
        return before + done * change, change / self._period
