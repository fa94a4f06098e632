"""Law `computed_torque`: torques of the inverse dynamics in pose space, closed by vision.

    torque = mean over a frame of ID(p, p_dot, p_ddot),   p = r - e,   e_ddot + Kd e_dot + Kp e = 0
    Kp = bandwidth^2, Kd = 2 damping bandwidth

with the way back p from where the robot is into the desired motion r. A torque acts for one frame, which is why its
mean over that time counts. With an observer the way begins where the robot will be as the torque arrives, what the
observer finds that the model does not know is taken off, and dry friction is that of the way back: near rest its joints
often turn the other way than those of the desired motion, and a torque for these is wrong by twice the Coulomb torque.
Without, the way begins at the last measured pose with the difference of the last two, an integral takes the place of
the disturbance, and dry friction is that of the desired motion: that of a rate half a frame old chatters.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import expm

from dynamics.closed_loop.drives import Drives
from dynamics.closed_loop.problem import EveryFrame
from dynamics.control.inverse_dynamics import Motion, spans
from dynamics.control.law import Assignment, Feedback, LawInLoop
from dynamics.control.observer import Estimate
from dynamics.kinematics.chart import Chart

INTEGRAL = 0.2
"""Of the gain Ki = INTEGRAL bandwidth^3, without observer."""

FOLLOWED = 1.0
"""How fast the disturbance is taken off, over the bandwidth: noise of it that is faster would only shake the robot."""

Command = Callable[[int, float, np.ndarray | None], np.ndarray]


def error_map(feedback: Feedback) -> np.ndarray:
    """d/dt (2, 2) of the error of a coordinate and its rate on the way back."""
    w = feedback.bandwidth
    return np.array([[0.0, 1.0], [-(w**2), -2 * feedback.damping * w]])


@dataclass(frozen=True)
class WayBack:
    """The motion by which errors (m,), and their rates, at a time, s, die out; with an acceleration (m,) beside."""

    desired: Motion
    chart: Chart
    map: np.ndarray
    begin: float
    error: np.ndarray
    rate: np.ndarray
    beside: np.ndarray | float = 0.0

    def pose(self, t: np.ndarray) -> np.ndarray:
        """Poses (N, 6), m and rad."""
        return self.desired.pose(t) - self.chart.lifted(self._errors(t)[:, 0])

    def pose_rate(self, t: np.ndarray) -> np.ndarray:
        """Their time derivatives (N, 6)."""
        return self.desired.pose_rate(t) - self.chart.lifted(self._errors(t)[:, 1])

    def pose_acceleration(self, t: np.ndarray) -> np.ndarray:
        """Their second time derivatives (N, 6)."""
        back = np.einsum("i,nij->nj", self.map[1], self._errors(t))
        return self.desired.pose_acceleration(t) - self.chart.lifted(back - self.beside)

    def _errors(self, t: np.ndarray) -> np.ndarray:
        """Errors and their rates (N, 2, m)."""
        passed = np.asarray(t) - self.begin
        return np.asarray(expm(self.map * passed[:, None, None]) @ np.stack([self.error, self.rate]))


def computed_torque(assignment: Assignment) -> LawInLoop:
    """Torques for drives that take them. Raises what `Robot.inverse_dynamics` does."""
    drives = replace(assignment.settings.drives, torques=True)
    expected: list[Estimate] = []
    command = _observed(assignment, drives, expected) if assignment.feedback.observer else _measured(assignment)
    return LawInLoop(controller=EveryFrame(command), drives=drives, expected=expected)


def _observed(assignment: Assignment, drives: Drives, expected: list[Estimate]) -> Command:
    watched = assignment.watched(drives)
    share = 1 - np.exp(-FOLLOWED * assignment.feedback.bandwidth * assignment.period)
    taken_off = watched.disturbance

    def command(frame: int, time: float, measured: np.ndarray | None) -> np.ndarray:
        nonlocal taken_off
        expected.append(watched.see(frame, measured))
        at = watched.arrival(frame)
        seen = watched.ahead(at)
        taken_off = taken_off + share * (watched.disturbance - taken_off)
        way = _way_back(assignment, at, seen.coordinates, seen.rates)
        torque = _torque(assignment, way, way, watched.viscous) - taken_off
        watched.issue(frame, torque)
        return torque

    return command


def _measured(assignment: Assignment) -> Command:
    chart, period, feedback = assignment.model.robot.geometry.chart, assignment.period, assignment.feedback
    pose = assignment.desired(0.0)[0]
    before, elapsed, integral = chart.coordinates(pose), 0.0, np.zeros(len(chart.freedoms))
    at_rest = assignment.holding - assignment.model.robot.static_torque(pose, assignment.model.dynamic)
    way = _way_back(assignment, 0.0, before, np.zeros_like(before))

    def command(frame: int, time: float, measured: np.ndarray | None) -> np.ndarray:
        nonlocal before, elapsed, integral, way
        elapsed += period
        if measured is not None:
            now = chart.coordinates(measured)
            rates, before, elapsed = (now - before) / elapsed, now, 0.0
            integral = integral + period * (chart.coordinates(assignment.desired(time)[0]) - now)
            way = _way_back(assignment, time, now, rates)
            way = replace(way, beside=INTEGRAL * feedback.bandwidth**3 * integral)
        arrival = time + assignment.settings.timing.latency_s
        return _torque(assignment, replace(way, begin=arrival), assignment.motion) + at_rest

    return command


def _way_back(assignment: Assignment, time: float, coordinates: np.ndarray, rates: np.ndarray) -> WayBack:
    """From coordinates and rates (m,) at a time."""
    chart, (pose, rate, _) = assignment.model.robot.geometry.chart, assignment.desired(time)
    errors = chart.coordinates(pose) - coordinates, chart.coordinates(rate) - rates
    return WayBack(assignment.motion, chart, error_map(assignment.feedback), time, *errors)


def _torque(assignment: Assignment, way: WayBack, dry: Motion, viscous: np.ndarray | float = 0.0) -> np.ndarray:
    """Mean (n,) over the first frame of a way back, with the dry friction of a motion; viscous (n,): friction of which
    the model does not know."""
    along = spans(assignment.model, way, np.array([way.begin]), assignment.period, dry)
    return np.asarray(along.torque[0] + viscous * (along.end[0] - along.begin[0]) / assignment.period)
