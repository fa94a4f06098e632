"""Law `computed_torque`: torques of the inverse dynamics, with feedback of the measured pose.

    torque = mean over a frame of ID(p, p_dot, p_ddot),   p = r - e,   e_ddot + Kd e_dot + Kp e = 0
    Kp = bandwidth^2, Kd = 2 damping bandwidth

ID is the inverse dynamics, r is the desired motion, and p is the recovery motion, which leads from
the present pose of the robot into r. e is the desired minus the recovery motion. The torque is the
mean over a frame period, because it acts for that time.

With an observer, the recovery motion begins at the state predicted for the arrival of the torque.
The estimated disturbance is subtracted. The signs of dry friction are those of the recovery motion.
Near rest, joints often move against the desired motion, whose signs would then make the torque
wrong by twice the Coulomb torque.

Without an observer, the recovery motion begins at the newest measured pose. Its rate is the
difference of the newest two poses divided by the time between them. An integral of the error, and
the error of the modelled torque at the start, replace the disturbance. The signs of dry friction
are those of the desired motion, because the measured rates are half a frame old, and their signs
would chatter.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import expm

from dynamics.closed_loop.drives import Drives
from dynamics.closed_loop.loop_settings import EveryFrame
from dynamics.control.inverse_dynamics import Motion, spans
from dynamics.control.law_interface import Assignment, Feedback, LawInLoop
from dynamics.control.observer import Estimate
from dynamics.kinematics.platform import Chart

INTEGRAL_FACTOR = 0.2  # factor of the gain Ki = INTEGRAL_FACTOR bandwidth^3 without an observer
# Rate, 1/s, at which the subtracted disturbance follows the estimate, divided by the bandwidth,
# rad/s. A higher rate would mainly pass noise on to the robot.
FOLLOWING_RATE = 1.0

Command = Callable[[int, float, np.ndarray | None], np.ndarray]


def error_map(feedback: Feedback) -> np.ndarray:
    """Matrix (2, 2) from a decaying error and its rate to their time derivatives."""
    w = feedback.bandwidth
    return np.array([[0.0, 1.0], [-(w**2), -2 * feedback.damping * w]])


@dataclass(frozen=True)
class DecayingErrors:
    """Recovery motion, along which errors (m,) decay.

    `error` and `rate` are the errors, desired minus actual, m and rad, and their rates at the time
    `begin`, s. `map` is that of `error_map`. `correction` is an additional acceleration (m,) of the
    platform, m/s^2 and rad/s^2.
    """

    desired: Motion
    chart: Chart
    map: np.ndarray
    begin: float
    error: np.ndarray
    rate: np.ndarray
    correction: np.ndarray | float = 0.0

    def pose(self, t: np.ndarray) -> np.ndarray:
        """Poses (N, 6), m and rad."""
        return self.desired.pose(t) - self.chart.lifted(self._errors(t)[:, 0])

    def pose_rate(self, t: np.ndarray) -> np.ndarray:
        """Pose rates (N, 6)."""
        return self.desired.pose_rate(t) - self.chart.lifted(self._errors(t)[:, 1])

    def pose_acceleration(self, t: np.ndarray) -> np.ndarray:
        """Pose accelerations (N, 6)."""
        error_acceleration = np.einsum("i,nij->nj", self.map[1], self._errors(t))
        return self.desired.pose_acceleration(t) - self.chart.lifted(
            error_acceleration - self.correction
        )

    def _errors(self, t: np.ndarray) -> np.ndarray:
        """Errors and their rates (N, 2, m)."""
        elapsed = np.asarray(t) - self.begin
        return np.asarray(
            expm(self.map * elapsed[:, None, None]) @ np.stack([self.error, self.rate])
        )


def computed_torque(assignment: Assignment) -> LawInLoop:
    """Law for drives that take torques.

    Its controller raises the same errors as `Robot.inverse_dynamics`, and SimulationError if the
    observer diverges.
    """
    drives = replace(assignment.settings.drives, torques=True)
    expected: list[Estimate] = []
    command = (
        _observed(assignment, drives, expected)
        if assignment.feedback.observer
        else _measured(assignment)
    )
    return LawInLoop(controller=EveryFrame(command), drives=drives, expected=expected)


def _observed(assignment: Assignment, drives: Drives, expected: list[Estimate]) -> Command:
    """Controller with an observer, whose estimates are appended to `expected`."""
    observer = assignment.watched(drives)
    # fraction of its difference from the estimate that `subtracted` loses in a frame
    fraction = 1 - np.exp(-FOLLOWING_RATE * assignment.feedback.bandwidth * assignment.period)
    subtracted = observer.disturbance

    def command(frame: int, time: float, measured: np.ndarray | None) -> np.ndarray:
        nonlocal subtracted
        expected.append(observer.see(frame, measured))
        arrival = observer.arrival(frame)
        predicted = observer.ahead(arrival)
        subtracted = subtracted + fraction * (observer.disturbance - subtracted)
        recovery = _decaying_errors(assignment, arrival, predicted.coordinates, predicted.rates)
        torque = _torque(assignment, recovery, recovery, observer.viscous) - subtracted
        observer.issue(frame, torque)
        return torque

    return command


def _measured(assignment: Assignment) -> Command:
    """Controller without an observer."""
    chart = assignment.model.robot.geometry.chart
    period = assignment.period
    feedback = assignment.feedback
    pose = assignment.desired(0.0)[0]
    last = chart.coordinates(pose)
    elapsed = 0.0
    integral = np.zeros(len(chart.freedoms))
    # error of the modelled torque at rest, which is known from the torque at the start
    at_rest = assignment.holding - assignment.model.robot.static_torque(
        pose, assignment.model.dynamic
    )
    recovery = _decaying_errors(assignment, 0.0, last, np.zeros_like(last))

    def command(frame: int, time: float, measured: np.ndarray | None) -> np.ndarray:
        nonlocal last, elapsed, integral, recovery
        elapsed += period
        if measured is not None:
            now = chart.coordinates(measured)
            rates = (now - last) / elapsed
            last = now
            elapsed = 0.0
            integral = integral + period * (chart.coordinates(assignment.desired(time)[0]) - now)
            recovery = _decaying_errors(assignment, time, now, rates)
            recovery = replace(
                recovery, correction=INTEGRAL_FACTOR * feedback.bandwidth**3 * integral
            )
        arrival = time + assignment.settings.timing.latency_s
        return _torque(assignment, replace(recovery, begin=arrival), assignment.motion) + at_rest

    return command


def _decaying_errors(
    assignment: Assignment, time: float, coordinates: np.ndarray, rates: np.ndarray
) -> DecayingErrors:
    """Recovery motion from coordinates and rates (m,) at a time, s."""
    chart = assignment.model.robot.geometry.chart
    pose, rate, _ = assignment.desired(time)
    errors = chart.coordinates(pose) - coordinates, chart.coordinates(rate) - rates
    return DecayingErrors(assignment.motion, chart, error_map(assignment.feedback), time, *errors)


def _torque(
    assignment: Assignment, recovery: DecayingErrors, dry: Motion, viscous: np.ndarray | float = 0.0
) -> np.ndarray:
    """Mean torque (n,) over the first frame of a recovery motion, N m or N.

    The signs of dry friction are those of the motion `dry`. `viscous` (n,) are coefficients of
    viscous friction, N m s/rad or N s/m, in addition to those of the model.
    """
    span = spans(assignment.model, recovery, np.array([recovery.begin]), assignment.period, dry)
    return np.asarray(span.torque[0] + viscous * (span.end[0] - span.begin[0]) / assignment.period)
