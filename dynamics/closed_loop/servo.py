"""The visual servo of eq. 30, sampled at the frames: the plain twin of `visual_servo.c`."""

import casadi as ca
import numpy as np

from dynamics.closed_loop.problem import Reference, ServoGains


class VisualServo:
    """U = J_theta [kp e + kd e_dot + ki integral(e)], the error e taken at the time of exposure.

    The pose rate is the difference of the last two good measurements (before the first: what the start names); the
    integral is the sum of the errors times the frame period. Lost frames leave both alone.
    """

    def __init__(
        self,
        functions: dict[str, ca.Function],
        gains: ServoGains,
        period: float,
        last_measured: np.ndarray,
        integral: np.ndarray,
        d_integral: np.ndarray,
    ) -> None:
        self._functions = functions
        self._gains = gains
        self._period = period
        self._integral = integral.copy()
        self._previous = last_measured
        self._d_integral, self._d_previous = d_integral.copy(), np.zeros_like(d_integral)
        self._elapsed = 0.0

    @property
    def integral(self) -> np.ndarray:
        """Sum of the errors times the frame period (6,), m s and rad s."""
        return self._integral.copy()

    @property
    def integral_tangent(self) -> np.ndarray:
        """Derivatives of `integral`, (6, columns)."""
        return self._d_integral.copy()

    def next_frame(self) -> None:
        """Let one frame period pass."""
        self._elapsed += self._period

    def command(self, frame: int, reference: Reference, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Command (6,), rad, of a good measurement (6,); and the demanded pose rate (6,) it came from."""
        gains = self._gains
        jacobian = np.asarray(self._functions["pose_jacobian"](measured), dtype=float)
        with np.errstate(over="ignore", invalid="ignore"):  # the loop refuses a command that is not finite
            error = reference.poses[frame] - measured
            rate = (measured - self._previous) / self._elapsed
            self._integral += self._period * error
            demand = gains.kp * error + gains.kd * (reference.rates[frame] - rate) + gains.ki * self._integral
            command = jacobian @ demand
        self._previous = measured
        return command, demand

    def command_tangent(self, measured: np.ndarray, demand: np.ndarray, d_measured: np.ndarray) -> np.ndarray:
        """Derivative (6, columns) of the command, given that of the measurement; see `sensitivity`."""
        gains = self._gains
        self._d_integral -= self._period * d_measured
        d_rate = (d_measured - self._d_previous) / self._elapsed
        d_demand = -gains.kp * d_measured - gains.kd * d_rate + gains.ki * self._d_integral
        self._d_previous = d_measured
        jacobian = np.asarray(self._functions["pose_jacobian"](measured), dtype=float)
        by_pose = np.asarray(self._functions["rate_map_derivative"](measured, demand), dtype=float)
        return jacobian @ d_demand + by_pose @ d_measured

    def measured_now(self) -> None:
        """A good measurement was taken in this frame."""
        self._elapsed = 0.0
