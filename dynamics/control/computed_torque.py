"""Law `computed_torque`: torques of the inverse dynamics at where the robot is, in pose space, closed by vision.

    torque = ID(q, q_dot, r_ddot + Kd (r_dot - q_dot) + Kp (r - q)),   Kp = bandwidth^2, Kd = 2 damping bandwidth

so that a model that is right leaves r - q as a linear oscillator, each coordinate for itself. A torque acts for one
frame, which is why the part that the desired motion takes is its mean over that time, and dry friction is that of the
desired motion: that of the measured velocity chatters. With an observer q and q_dot are those at which the torque
arrives, and what the observer finds that the model does not know is taken off; without, q is the last measured pose,
q_dot the difference of the last two, and an integral takes the place of the disturbance.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dynamics.closed_loop.drives import Drives
from dynamics.closed_loop.problem import EveryFrame
from dynamics.control.inverse_dynamics import spans
from dynamics.control.law import Assignment, LawInLoop
from dynamics.control.observer import Estimate

INTEGRAL = 0.2
"""Of the gain Ki = INTEGRAL bandwidth^3, without observer."""

FOLLOWED = 0.5
"""How fast the disturbance is taken off, over the bandwidth: what dry friction does is over before it is seen."""

Command = Callable[[int, float, np.ndarray | None], np.ndarray]


def computed_torque(assignment: Assignment) -> LawInLoop:
    """Torques for drives that take them. Raises what `Robot.inverse_dynamics` does."""
    drives = replace(assignment.settings.drives, torques=True)
    expected: list[Estimate] = []
    command = _observed(assignment, drives, expected) if assignment.feedback.observer else _measured(assignment)
    return LawInLoop(controller=EveryFrame(command), drives=drives, expected=expected)


def _observed(assignment: Assignment, drives: Drives, expected: list[Estimate]) -> Command:
    watched, robot = assignment.watched(drives), assignment.model.robot
    share = 1 - np.exp(-FOLLOWED * assignment.feedback.bandwidth * assignment.period)
    taken_off = watched.disturbance

    def command(frame: int, time: float, measured: np.ndarray | None) -> np.ndarray:
        nonlocal taken_off
        expected.append(watched.see(frame, measured))
        at = watched.arrival(frame)
        seen = watched.ahead(at)
        correction = _correction(assignment, at, seen.coordinates, seen.rates)
        taken_off = taken_off + share * (watched.disturbance - taken_off)
        turning = robot.coordinate_jacobian(robot.geometry.chart.pose(seen.coordinates)) @ seen.rates
        torque = np.asarray(_planned(assignment, at) + correction - taken_off + watched.viscous * turning)
        watched.issue(frame, torque)
        return torque

    return command


def _measured(assignment: Assignment) -> Command:
    chart, period = assignment.model.robot.geometry.chart, assignment.period
    pose = assignment.desired(0.0)[0]
    before, elapsed, integral = chart.coordinates(pose), 0.0, np.zeros(len(chart.freedoms))
    at_rest = assignment.holding - assignment.model.robot.static_torque(pose, assignment.model.dynamic)
    correction = np.zeros(len(at_rest))

    def command(frame: int, time: float, measured: np.ndarray | None) -> np.ndarray:
        nonlocal before, elapsed, integral, correction
        elapsed += period
        if measured is not None:
            now = chart.coordinates(measured)
            rates, before, elapsed = (now - before) / elapsed, now, 0.0
            integral = integral + period * (chart.coordinates(assignment.desired(time)[0]) - now)
            correction = _correction(assignment, time, now, rates, integral)
        return np.asarray(_planned(assignment, time + assignment.settings.timing.latency_s) + correction + at_rest)

    return command


def _planned(assignment: Assignment, time: float) -> np.ndarray:
    """Mean torque (n,) of the desired motion over the frame from a time on."""
    return spans(assignment.model, assignment.motion, np.array([time]), assignment.period).torque[0]


def _correction(
    assignment: Assignment, time: float, q: np.ndarray, rates: np.ndarray, integral: np.ndarray | float = 0.0
) -> np.ndarray:
    """What the torque (n,) at coordinates and rates (m,) has to be beside that of the desired motion at a time;
    integral (m,): of the error."""
    chart, feedback, model = assignment.model.robot.geometry.chart, assignment.feedback, assignment.model
    pose, rate, acceleration = assignment.desired(time)
    error, error_rate, w = chart.coordinates(pose) - q, chart.coordinates(rate) - rates, feedback.bandwidth
    wanted = w**2 * error + 2 * feedback.damping * w * error_rate + INTEGRAL * w**3 * integral
    poses, moving = np.stack([chart.pose(q), pose]), np.stack([chart.lifted(rates), rate])
    no_dry = np.zeros((2, model.robot.layout.joints))
    torque = model.torque(poses, moving, np.stack([acceleration + chart.lifted(wanted), acceleration]), no_dry)
    return np.asarray(torque[0] - torque[1])
