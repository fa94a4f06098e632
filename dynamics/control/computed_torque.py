"""Law `computed_torque`: torques of the inverse dynamics in pose space, closed by vision.

    torque = mean over a frame of ID(p, p_dot, p_ddot),   p = r - e,   e_ddot + Kd e_dot + Kp e = 0
    Kp = bandwidth^2, Kd = 2 damping bandwidth

Here p is the way back from where the robot is into the desired motion r. The mean over a frame
counts, because a torque acts for one frame.

With an observer, the way back begins where the robot will be as the torque arrives. The disturbance
that the observer finds is taken off. Dry friction is that of the way back: near rest, joints often
turn the other way than those of the desired motion, and their torque would be wrong by twice the
Coulomb torque.

Without an observer, the way back begins at the last measured pose, with the difference of the last
two as its rate. An integral takes the place of the disturbance. Dry friction is that of the desired
motion, because the sign of a rate that is half a frame old chatters.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import expm

from dynamics.closed_loop.drives import Drives
from dynamics.closed_loop.loop_settings import EveryFrame
from dynamics.control.inverse_dynamics import Motion, spans
from dynamics.control.law import Assignment, Feedback, LawInLoop
from dynamics.control.observer import Estimate
from dynamics.kinematics.platform import Chart

INTEGRAL = 0.2
"""Factor of the gain Ki = INTEGRAL bandwidth^3 without an observer."""

FOLLOWED = 1.0
"""Rate at which the disturbance is taken off, over the bandwidth. Faster noise only shakes the
robot.
"""

Command = Callable[[int, float, np.ndarray | None], np.ndarray]


def error_map(feedback: Feedback) -> np.ndarray:
    """Matrix (2, 2) of the linear differential equation of an error and its rate on the way
    back.
    """
    w = feedback.bandwidth
    return np.array([[0.0, 1.0], [-(w**2), -2 * feedback.damping * w]])


@dataclass(frozen=True)
class WayBack:
    """Motion along which errors (m,) die out.

    `error` and `rate` are errors and their rates at the time `begin`, s. `beside` is an
    acceleration (m,) that is added.
    """

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
        """Pose rates (N, 6)."""
        return self.desired.pose_rate(t) - self.chart.lifted(self._errors(t)[:, 1])

    def pose_acceleration(self, t: np.ndarray) -> np.ndarray:
        """Pose accelerations (N, 6)."""
        back = np.einsum("i,nij->nj", self.map[1], self._errors(t))
        return self.desired.pose_acceleration(t) - self.chart.lifted(back - self.beside)

    def _errors(self, t: np.ndarray) -> np.ndarray:
        """Errors and their rates (N, 2, m)."""
        passed = np.asarray(t) - self.begin
        return np.asarray(
            expm(self.map * passed[:, None, None]) @ np.stack([self.error, self.rate])
        )


def computed_torque(assignment: Assignment) -> LawInLoop:
    """Law for drives that take torques. Its controller raises what `Robot.inverse_dynamics`
    raises.
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
    """Controller without an observer."""
    chart = assignment.model.robot.geometry.chart
    period = assignment.period
    feedback = assignment.feedback
    pose = assignment.desired(0.0)[0]
    before = chart.coordinates(pose)
    elapsed = 0.0
    integral = np.zeros(len(chart.freedoms))
    # a wrong model of the torque at rest is known from the start, where the robot stands
    at_rest = assignment.holding - assignment.model.robot.static_torque(
        pose, assignment.model.dynamic
    )
    way = _way_back(assignment, 0.0, before, np.zeros_like(before))

    def command(frame: int, time: float, measured: np.ndarray | None) -> np.ndarray:
        nonlocal before, elapsed, integral, way
        elapsed += period
        if measured is not None:
            now = chart.coordinates(measured)
            rates = (now - before) / elapsed
            before = now
            elapsed = 0.0
            integral = integral + period * (chart.coordinates(assignment.desired(time)[0]) - now)
            way = _way_back(assignment, time, now, rates)
            way = replace(way, beside=INTEGRAL * feedback.bandwidth**3 * integral)
        arrival = time + assignment.settings.timing.latency_s
        return _torque(assignment, replace(way, begin=arrival), assignment.motion) + at_rest

    return command


def _way_back(
    assignment: Assignment, time: float, coordinates: np.ndarray, rates: np.ndarray
) -> WayBack:
    """Way back from coordinates and rates (m,) at a time, s."""
    chart = assignment.model.robot.geometry.chart
    pose, rate, _ = assignment.desired(time)
    errors = chart.coordinates(pose) - coordinates, chart.coordinates(rate) - rates
    return WayBack(assignment.motion, chart, error_map(assignment.feedback), time, *errors)


def _torque(
    assignment: Assignment, way: WayBack, dry: Motion, viscous: np.ndarray | float = 0.0
) -> np.ndarray:
    """Mean torque (n,) over the first frame of a way back, with the dry friction of a motion.

    `viscous` (n,) is friction that the model does not know.
    """
    along = spans(assignment.model, way, np.array([way.begin]), assignment.period, dry)
    return np.asarray(
        along.torque[0] + viscous * (along.end[0] - along.begin[0]) / assignment.period
    )
