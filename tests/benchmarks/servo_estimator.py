"""Output error with 14 unknowns: `identify`'s bounded Gauss-Newton on exact sensitivities, after a linear start.

The start is the least-squares solution of the torque balance of the joints that slip: with a known servo the torque
follows from commands and poses, and is linear in the unknowns.
"""

import time
from dataclasses import dataclass

import numpy as np

import dynamics
from identify.estimation.bounded_least_squares import StopCriteria, minimise
from identify.estimation.warm_start import SLIPPING_SHARE
from identify.filtering import filtered_derivatives, zero_phase_filter
from tests.benchmarks.servo_experiment import (
    FREE,
    POSITION_STD,
    QUATERNION_STD,
    RATE_HZ,
    felt_commands,
    parameters,
    robot,
    run,
    servo_gains,
    span,
)

# Half the angle of a small turn is the vector part of its quaternion.
POSE_STD = np.repeat([POSITION_STD, 2 * QUATERNION_STD], 3)
CUTOFF_HZ, EVERY, EDGE = 10.0, 10, 100
CRITERIA = StopCriteria(cost_tolerance=1e-4, parameter_tolerance=1e-3, max_iterations=30)
SMALLEST_SHARE = 1e-3


@dataclass(frozen=True)
class Estimate:
    """Values (14,), half-widths (14,) of their 95 % intervals, and wall time of both, s."""

    values: np.ndarray
    half_widths: np.ndarray
    seconds: float


@dataclass(frozen=True)
class ServoProblem:
    """Whitened pose residuals of the model under the logged commands; see `bounded_least_squares.Problem`."""

    commands: np.ndarray
    measured: np.ndarray

    def cost(self, free):
        try:
            return float(np.sum(((run(free, self.commands).pose - self.measured) / POSE_STD) ** 2))
        except dynamics.DynamicsError:
            return np.inf

    def linearise(self, free):
        model = run(free, self.commands, sensitivities=True)
        residual = ((model.pose - self.measured) / POSE_STD).ravel()
        jacobian = (model.pose_sensitivity @ span() / POSE_STD[:, None]).reshape(-1, len(FREE))
        triangle = np.linalg.qr(np.column_stack([jacobian, residual]), mode="r")
        return float(residual @ residual), triangle[: len(FREE), : len(FREE)], triangle[: len(FREE), len(FREE)]


def estimate(commands, measured, guess):
    """The 14 unknowns of one run: commands and measured poses (frames, 6), a first guess (14,)."""
    began = time.perf_counter()
    lower = SMALLEST_SHARE * guess
    start = np.maximum(linear_start(commands, measured), lower)
    problem = ServoProblem(commands, measured)
    solution = minimise(problem, start, lower, guess, CRITERIA)
    _, factor, _ = problem.linearise(solution.parameters)
    half_widths = 1.96 * standard_deviations(factor)
    return Estimate(solution.parameters, half_widths, time.perf_counter() - began)


def standard_deviations(factor):
    """Those (14,) of a fit with the triangular factor R (14, 14) of its whitened Jacobian."""
    inverse = np.linalg.inv(factor)
    return np.sqrt(np.sum(inverse**2, axis=1))


def linear_start(commands, measured):
    """The 14 unknowns by least squares on the joints' torque balance, at every tenth filtered pose."""
    filtered = filtered_derivatives(measured, RATE_HZ, CUTOFF_HZ)
    pose, rate, acceleration = (values[EDGE:-EDGE:EVERY] for values in filtered)
    twist, twist_dot = robot().twist(pose, rate), robot().twist_dot(pose, rate, acceleration)
    jacobian = robot().joint_jacobian(pose)
    torque_map = np.linalg.solve(jacobian.transpose(0, 2, 1), robot().regressor(pose, twist, twist_dot))
    velocity = np.einsum("nij,nj->ni", jacobian, twist)
    torque = servo_torque(commands, robot().inverse_kinematics(pose), velocity)
    slipping = np.abs(velocity) > SLIPPING_SHARE * velocity.std(axis=0)
    known = parameters(np.zeros(len(FREE)))[:64]
    matrix, right = (torque_map @ span()[:64])[slipping], (torque - torque_map @ known)[slipping]
    return np.linalg.lstsq(matrix, right, rcond=None)[0]


def servo_torque(commands, angle, velocity):
    """Torque (n, 6) of the servo at the instants of the start; a held command counts as the mean before and after."""
    lp, ld = servo_gains()
    smooth = zero_phase_filter(felt_commands(commands), RATE_HZ, CUTOFF_HZ)
    held = (smooth + np.roll(smooth, 1, axis=0)) / 2
    return lp * (held[EDGE:-EDGE:EVERY] - angle) - ld * velocity
