"""Observer: an extended Kalman filter for the motion of a robot and its drives.

Between two frames, the state follows the model under the commands that have arrived (`prediction`).
At a lost frame, the state only becomes more uncertain. Three kinds of errors are part of the state:
a torque at each joint, which is a random walk; viscous friction, which is constant; and an offset
that all measured poses have in common. The measurements do not determine this offset, but its
uncertainty is included.

During the run, the observer estimates the rate of the random walk, and the ratio of the sensor's
noise to its stated noise. Both are scales of covariances. They are adjusted along the exact
gradient of the likelihood of the innovations.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dynamics.closed_loop.command_schedule import acting_times
from dynamics.closed_loop.loop_settings import LoopSettings
from dynamics.control.inverse_dynamics import Model
from dynamics.control.prediction import Prediction
from dynamics.errors import SimulationError

# Longest step of the prediction, s. Dry friction can reverse a joint within milliseconds.
LONGEST_STEP = 3e-3
PLACE_DOUBT = 1e-4  # standard deviation of the coordinates at the start, m and rad
RATE_DOUBT = 1e-5  # standard deviation of the rates of the coordinates at the start, m/s and rad/s
# Standard deviation of the unknown torque at the start, relative to the torque at rest.
TORQUE_DOUBT = 1e-3
# Standard deviation of the unknown viscous friction, divided by the inertia at the joint, 1/s.
VISCOUS_DOUBT = 5.0
# Ratio of the model error with torque commands to the model error with joint commands. An error by
# a common factor of all parameters has an effect only with torque commands.
TORQUE_COMMAND_FACTOR = 2.0
# Time constant, s, with which information about the scales, from earlier innovations, fades. Far
# from the solution the gradient is different, so that old information slows down convergence.
MEMORY_TIME = 2.0
# Prior information (inverse variance) about the logarithms of the scales of walk and noise.
PRIOR_INFORMATION = (0.3, 200.0)
SAME_TIME = 1e-9  # difference, in frame periods, below which two instants count as the same


@dataclass(frozen=True)
class Estimate:
    """Coordinates and rates (m,) at an instant, with the covariance (m, m) of the coordinates."""

    coordinates: np.ndarray
    rates: np.ndarray
    covariance: np.ndarray


class Observer:
    """Observer of one run. All times are in s.

    At each frame, `see` processes the measured pose, `ahead` predicts, and `issue` stores the
    command. `see` and `ahead` raise SimulationError if the state is no longer finite.

    `model` is the law's model of the robot. `pose` (6,) is the pose at rest at the start, and
    `holding` (n,) is the command that holds it. `latencies` (frames,) are the latencies of the
    commands; the latency of a command is not used before the frame of this command. `noise(frame)`
    is the covariance (6, 6) of a measured pose. `common` (6, 6) is the covariance of the error that
    all measured poses have in common.
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
        self._model = model
        self._noise = noise
        self._drives = settings.drives
        self._linear = timing.hold == "linear"
        self._period = 1 / timing.frame_rate_hz
        frames = np.arange(len(latencies))
        self._arrival = acting_times(frames * self._period, latencies).tolist()
        self._time = 0.0
        self._prediction = Prediction(model, settings)
        self._arrivals = [-np.inf, -np.inf]
        self._commands = [holding, holding]
        self._start(pose, holding, common)

    def _start(self, pose: np.ndarray, holding: np.ndarray, common: np.ndarray) -> None:
        """Set state and covariance at the start."""
        blocks = self._prediction.blocks
        robot = self._model.robot
        static_torque = robot.static_torque(pose, self._model.dynamic)
        basis = robot.geometry.chart.basis
        self._state = np.zeros(blocks.size)
        self._state[blocks.coordinates] = robot.coordinates(pose)
        if self._drives.torques:
            self._state[blocks.torque] = static_torque - holding
        else:
            self._state[blocks.integral] = self._model.held(pose, self._drives)[1]
        torque_scale = np.abs(static_torque).mean()
        # Within a frame period, the random walk changes as much as the error of the model, although
        # this error changes smoothly along a motion.
        walk = np.zeros(blocks.size)
        deviation = np.zeros(blocks.size)
        model_error = TORQUE_COMMAND_FACTOR if self._drives.torques else 1.0
        walk[blocks.torque] = model_error * self._model.doubt * torque_scale * np.sqrt(self._period)
        self._walk = np.diag(walk**2)
        jacobian = robot.coordinate_jacobian(pose)
        mass = basis.T @ robot.mass_matrix(pose, self._model.dynamic) @ basis
        # inertia at each joint while the other joints are free
        inertia = 1 / np.diag(jacobian @ np.linalg.solve(mass, jacobian.T))
        deviation[blocks.coordinates] = PLACE_DOUBT
        deviation[blocks.rates] = RATE_DOUBT
        deviation[blocks.torque] = TORQUE_DOUBT * torque_scale
        deviation[blocks.viscous] = VISCOUS_DOUBT * inertia
        self._covariance = np.diag(deviation**2)
        self._covariance[blocks.offset, blocks.offset] = basis.T @ common @ basis
        # the offset of the sensor is in every measured pose
        self._output_map = np.zeros((len(mass), blocks.size))
        self._output_map[:, blocks.coordinates] = np.eye(len(mass))
        self._output_map[:, blocks.offset] = np.eye(len(mass))
        self._log_scales = np.zeros(2)
        # derivatives of the covariance with respect to the logarithms of the scales
        self._by_scale = np.zeros((2, blocks.size, blocks.size))
        self._information = np.diag(PRIOR_INFORMATION)

    @property
    def scales(self) -> np.ndarray:
        """Estimated factors (2,) of the covariances of the walk and of the sensor's noise."""
        return np.exp(self._log_scales)

    @property
    def disturbance(self) -> np.ndarray:
        """Estimated torque (n,) that acts at the joints in addition to those of the model."""
        return self._state[self._prediction.blocks.torque].copy()

    @property
    def viscous(self) -> np.ndarray:
        """Estimated coefficients (n,) of viscous friction, in addition to those of the model."""
        return self._state[self._prediction.blocks.viscous].copy()

    def see(self, frame: int, pose: np.ndarray | None) -> Estimate:
        """Advance to a frame, and update the state by its measured pose (6,).

        `pose` is None at a lost frame. Returns the estimate before the update.
        """
        time = frame * self._period
        self._state, self._covariance = self._moved(
            time, self._state, self._covariance, self._by_scale
        )
        self._time = time
        expected = self._estimate(self._state, self._covariance)
        if pose is not None:
            self._learn(self._model.robot.coordinates(pose), self._noise(frame))
        return expected

    def arrival(self, frame: int) -> float:
        """Time at which the command of a frame arrives, s."""
        return float(self._arrival[frame])

    def ahead(self, time: float) -> Estimate:
        """Predict coordinates and rates at a later time, s, under the commands issued so far."""
        return self._estimate(*self._moved(time, self._state, self._covariance, None))

    def issue(self, frame: int, command: np.ndarray) -> None:
        """Store the command (n,) of a frame."""
        self._arrivals.append(self.arrival(frame))
        self._commands.append(np.array(command))
        # Old commands are removed, so that the time per frame does not grow during a run.
        del self._arrivals[: -self._kept()], self._commands[: -self._kept()]

    def _kept(self) -> int:
        """Number of commands to keep: at least all that can still act."""
        return 4 + sum(1 for arrival in self._arrivals if arrival > self._time - 2 * self._period)

    def _estimate(self, state: np.ndarray, covariance: np.ndarray) -> Estimate:
        """Coordinates and rates of a state, with the covariance of the coordinates."""
        blocks = self._prediction.blocks
        coordinate_covariance = covariance[blocks.coordinates, blocks.coordinates]
        return Estimate(
            state[blocks.coordinates].copy(),
            state[blocks.rates].copy(),
            coordinate_covariance.copy(),
        )

    def _learn(self, measured: np.ndarray, noise: np.ndarray) -> None:
        """Update the state, the covariance and the scales by measured coordinates (m,)."""
        output_map = self._output_map
        basis = self._model.robot.geometry.chart.basis
        noise = np.exp(self._log_scales[1]) * basis.T @ noise @ basis
        innovation = measured - output_map @ self._state
        inverse = np.linalg.inv(output_map @ self._covariance @ output_map.T + noise)
        by_scale = output_map @ self._by_scale @ output_map.T
        by_scale[1] += noise
        weighted = inverse @ innovation
        ratios = inverse @ by_scale
        # gradient of the log likelihood with respect to the logarithms of the scales
        gradient = 0.5 * (
            np.einsum("i,kij,j->k", weighted, by_scale, weighted)
            - np.trace(ratios, axis1=1, axis2=2)
        )
        prior = np.diag(PRIOR_INFORMATION)
        # information from earlier innovations fades towards the prior information
        self._information = prior + np.exp(-self._period / MEMORY_TIME) * (
            self._information - prior
        )
        self._information += 0.5 * np.einsum("aij,bji->ab", ratios, ratios)
        gain = self._covariance @ output_map.T @ inverse
        self._state = self._state + gain @ innovation
        remaining = np.eye(len(gain)) - gain @ output_map
        # the Joseph form keeps the covariance positive definite in spite of rounding
        self._covariance = remaining @ self._covariance @ remaining.T + gain @ noise @ gain.T
        self._by_scale = remaining @ self._by_scale @ remaining.T
        self._by_scale[1] += gain @ noise @ gain.T
        # a step of at most a half in the logarithm, because the gradient of one frame is noisy
        step = np.linalg.solve(self._information, gradient)
        self._log_scales = self._log_scales + np.clip(step, -0.5, 0.5)

    def _moved(
        self, time: float, state: np.ndarray, covariance: np.ndarray, by_scale: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """State and covariance at a later time, s.

        `by_scale` has the derivatives of the covariance with respect to the scales, and is updated
        in place, or is None.
        """
        now = self._time
        while now < time - SAME_TIME * self._period:
            # a command acts from its arrival on, and a ramp ends one period later
            begins = [*self._arrivals, *(arrival + self._period for arrival in self._arrivals)]
            next_begins = [
                begin for begin in begins if now + SAME_TIME * self._period < begin < time
            ]
            until = min([time, *next_begins])
            # steps of equal length, none longer than LONGEST_STEP
            end = now + (until - now) / np.ceil((until - now) / LONGEST_STEP)
            command, rate = self._acting((now + end) / 2)
            state, errors = self._prediction.step(state, covariance, command, rate, end - now)
            walked = np.exp(self._log_scales[0]) * (end - now) * self._walk
            covariance = errors @ covariance @ errors.T + walked
            if by_scale is not None:
                by_scale[:] = errors @ by_scale @ errors.T
                by_scale[0] += walked
            now = end
        if not np.isfinite(state).all():
            raise SimulationError(
                f"the observer has diverged: its prediction for {time:.3f} s is not finite"
            )
        return state, covariance

    def _acting(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Command at a time, s, and its rate as the joint PID uses it."""
        newest = max(k for k, arrival in enumerate(self._arrivals) if arrival <= time)
        before = self._commands[max(newest - 1, 0)]
        change = self._commands[newest] - before
        done = min((time - self._arrivals[newest]) / self._period, 1.0) if self._linear else 1.0
        return before + done * change, change / self._period
