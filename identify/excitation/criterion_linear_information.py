"""The D-criterion with the loop linearised about home: a function of the unknowns with exact derivatives.

The information of `criterion_information` comes from a simulation and has no exact derivative by the trajectory. In
the linearised loop the robot follows each harmonic of the trajectory with a known lag, and the sensitivities are
filtered columns of the torque regressor along that motion: with Y its Fourier coefficients at a harmonic, tau = Y Xi
the torques and e = tau / L the joint error that the PID needs for them,

    d(pose)/d(Xi) = -S Y,    d(pose)/d(lp, li, ld) = S (e, e / s, e s).

One period in the steady state counts for all, so the start of the run is left out.
"""

import casadi as ca
import numpy as np

from dynamics import Robot
from identify.arrays import Array
from identify.excitation.criterion_information import Knowledge
from identify.excitation.linear_loop import ComplexArray, pid_response, torque_response, tracking_response
from identify.excitation.log_determinant import log_determinant
from identify.excitation.motion import sample_times, torque_regressor, tracked_motion
from identify.excitation.unknowns import Unknowns
from identify.loop_parameters import NAMES
from identify.scenario import Scenario

HARMONICS_SEEN = 8
"""Sensitivities count up to this multiple of the highest harmonic of the trajectory."""


def log_linear_information(
    robot: Robot, unknowns: Unknowns, scenario: Scenario, known: Knowledge, smoothing_rad_s: float | None = None
) -> ca.Function:
    """z -> ln D in the linearised loop; `smoothing_rad_s` as in `criterion_observability`."""
    z = ca.MX.sym("z", unknowns.size)
    rows = sensitivity_spectrum(robot, unknowns, scenario, known.guess.values, z, smoothing_rad_s)
    whitener = np.linalg.inv(np.linalg.cholesky(known.covariance))
    rows = rows @ ca.DM(np.kron(np.eye(2 * len(harmonics(unknowns))), whitener.T))
    frames = scenario.timing.frames(scenario.excitation.duration_s)
    scaled = ca.diag(known.guess.std * np.sqrt(frames / 2)) @ rows
    determinant = log_determinant(len(NAMES))(scaled @ scaled.T + ca.DM(known.scaled_prior))
    return ca.Function("log_linear_information", [z], [determinant / (2 * len(NAMES))], ["z"], ["value"])


def harmonics(unknowns: Unknowns) -> ComplexArray:
    """s = i omega (K,) [1/s] of the harmonics that count."""
    order = np.arange(1, HARMONICS_SEEN * unknowns.harmonics + 1)
    return np.asarray(2j * np.pi * unknowns.fundamental_hz * order, dtype=complex)


def sensitivity_spectrum(
    robot: Robot,
    unknowns: Unknowns,
    scenario: Scenario,
    parameters: Array,
    z: ca.MX,
    smoothing_rad_s: float | None = None,
) -> ca.MX:
    """Fourier coefficients of d(pose)/d(67 parameters), (67, 12 K): six real and six imaginary parts a harmonic.

    A coefficient x_k means Re(x_k exp(s_k t)).
    """
    times, s = sample_times(unknowns.fundamental_hz, unknowns.harmonics), harmonics(unknowns)
    response = torque_response(robot, parameters, scenario, s)
    tracking = tracking_response(robot, parameters, scenario, s[: unknowns.harmonics])
    moved = tracked_motion(unknowns, z, times, tracking)
    sampled = torque_regressor(robot, smoothing_rad_s).map(len(times))(*moved)
    waves = np.exp(-np.outer(times, s)) * 2 / len(times)
    transform = np.stack([waves.real, waves.imag], axis=-1).reshape(len(times), -1)
    spectrum = ca.reshape(ca.reshape(sampled, 64 * 6, len(times)) @ ca.DM(transform), 64, 12 * len(s))
    error = 1 / pid_response(parameters, s)
    torque = ca.DM(parameters[:64]).T @ spectrum
    gains = [torque @ _real_filter(response * f[:, None, None]) for f in (error, error / s, error * s)]
    return ca.vertcat(-spectrum @ _real_filter(response), *gains)


def _real_filter(response: ComplexArray) -> ca.DM:
    """Block-diagonal (12 K, 12 K): rows (Re y_k, Im y_k) times it are (Re x_k, Im x_k) of x_k = response_k y_k."""
    blocks = [np.block([[r.real.T, r.imag.T], [-r.imag.T, r.real.T]]) for r in response]
    return ca.diagcat(*[ca.DM(block) for block in blocks])
