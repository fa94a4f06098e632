"""D-optimality of the output error, in the simulated closed loop and in its linearisation.

Let J = d(poses)/d(p parameters) be the sensitivities of the closed loop at the initial guess and
Sigma the covariance that the sensor states. With the prior (initial guess, the scenario's prior of
single parameters, scale anchor),

    W = sum over frames J^T Sigma^-1 J + prior,
    D = (det(P W P))^(1 / (2 p)),    P = diag(prior standard deviations).

D is the factor by which the experiment reduces the prior standard deviations, as a geometric mean
over all directions of the parameter space. It has no unit. The motion that the sensor's noise
causes through the servo is neglected.

The simulation gives D of a trajectory, but no exact derivative of D with respect to the trajectory.
Searches therefore use D in the loop linearised about rest at home. Let s = i omega, C = kp + kd s +
ki / s the servo, L = lp + ld s + li / s the joint PID, and t_d the latency plus half a frame of
hold. An error d of the joint torques moves the pose x by

    x = -S d,
    S = (J_ad^-T M E s^2 + F_v J_theta s + d(holding torque)/dx + L J_theta (1 + C exp(-s t_d)))^-1,

with the mass matrix M and the viscous friction F_v. J_ad maps twists to joint rates, J_theta maps
pose rates to joint rates, and E maps pose rates to twists. The pose follows a reference x_d as

    x = T x_d,    T = S L J_theta C exp(-s t_d).

Only viscous friction is included. Poses, wrenches and Jacobians are along the platform's
coordinates.

The robot thus follows each harmonic of the trajectory with a known lag, and the sensitivities are
filtered columns of the torque regressor along that motion. Let Y be the regressor's Fourier
coefficients at a harmonic, Xi the dynamic parameters, tau = Y Xi the torques, and e = tau / L the
joint error that the PID needs for them. Then

    d(pose)/d(Xi) = -S Y,    d(pose)/d(lp, li, ld) = S (e, e / s, e s).

One steady-state period represents the whole run, so the transient at the start is neglected. The
terms of cascaded drives beyond those of a PID are also neglected.
"""

from dataclasses import dataclass
from functools import partial

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from cmmsim.visibility import expected_covariance
from dynamics import Robot
from dynamics.closed_loop import LoopFailure, LoopSettings, differentiate_servo
from dynamics.parameters import JOINT_PID
from identify.arrays import Array, agreed
from identify.errors import TrajectoryError
from identify.estimation.prior import StartingGuess, model_guess
from identify.estimation.scale_anchor import MEASURING, default_std, measured_parameter
from identify.excitation.criteria import Criterion, smoothing_of
from identify.excitation.trajectory_unknowns import (
    RESPONSE_BITS,
    Unknowns,
    log_determinant,
    regressor,
    sample_times,
    tracked_motion,
)
from identify.model.model_side import ModelSide, model_side
from identify.scenario import Scenario
from identify.scenario.sections import Identification
from identify.trajectory import FourierTrajectory


def information(robot: Robot, scenario: Scenario, unknowns: Unknowns, typical: Array) -> Criterion:
    """Return D as a criterion.

    Searches use D of the linearised loop. Their results are judged by D of the simulated loop.
    """
    covariance = expected_covariance(
        scenario.sensor, robot.home_pose, scenario.pose_method, changes=scenario.sensor_changes
    )
    times = scenario.timing.frame_times(scenario.excitation.duration_s)
    known = knowledge(model_side(robot, scenario), scenario.identification, times, covariance)
    value, smooth = (
        log_linear_information(robot, unknowns, known, v) for v in (None, smoothing_of(robot))
    )
    return Criterion(value, smooth, judge=partial(log_information, robot, known))


@dataclass(frozen=True)
class Knowledge:
    """Knowledge before the run.

    start                Name of the parameter set of the guess.
    guess                Initial guess of the parameters.
    settings             Settings of the loop around the model.
    times (N,)           Times of the frames of the run, s.
    covariance (6, 6)    Covariance of a measured pose, m and rad.
    scaled_prior (p, p)  Information of the prior in units of its standard deviations.
    """

    start: str
    guess: StartingGuess
    settings: LoopSettings
    times: Array
    covariance: Array
    scaled_prior: Array


def knowledge(
    side: ModelSide, settings: Identification, times: Array, covariance: Array
) -> Knowledge:
    """Return the knowledge before a run: the model's initial guess, its prior and the anchor.

    The run has frames at times (N,) [s], and poses have the covariance (6, 6).
    """
    layout = side.robot.layout
    guess = model_guess(side.robot, side.model, settings)
    prior = np.eye(len(layout.names))
    anchor = settings.scale_anchor
    if anchor in MEASURING:
        index = layout.names.index(measured_parameter(anchor, layout))
        std = settings.anchor_std or default_std(anchor, layout)
        # The matrix is in units of the prior standard deviations.
        prior[index, index] += (guess.std[index] / std) ** 2
    start = side.model.start_parameters
    return Knowledge(start, guess, side.settings, times, covariance, prior)


def log_information(robot: Robot, known: Knowledge, trajectory: FourierTrajectory) -> float:
    """Return ln D of a trajectory.

    Raises TrajectoryError if the model with the initial guess is unstable on this trajectory.
    """
    reference = trajectory.reference(known.times)
    try:
        run = differentiate_servo(robot, known.guess.values, reference, known.settings)
    except LoopFailure as error:
        raise TrajectoryError(
            "no D-criterion: the closed loop with the parameters model.start_parameters = "
            f"{known.start!r} is unstable on this trajectory: {error}"
        ) from error
    assert run.pose_sensitivity is not None
    whitener = np.linalg.inv(np.linalg.cholesky(known.covariance))
    count = len(known.guess.std)
    rows = (whitener @ run.pose_sensitivity).reshape(-1, count) * known.guess.std
    return float(np.linalg.slogdet(rows.T @ rows + known.scaled_prior)[1] / (2 * count))


ComplexArray = NDArray[np.complex128]

STEP = 1e-5  # step [m, rad] of the difference quotient of the holding torque


def pid_response(robot: Robot, parameters: Array, s: ComplexArray) -> ComplexArray:
    """Return L (K, q) [N m/rad or N/m] of the joint PID with `parameters` (p,) at s (K,) [1/s].

    q is the number of joints if each has its own gains, else 1.
    """
    lp, li, ld = parameters[robot.layout.joint_pid].reshape(-1, len(JOINT_PID)).T
    s = s[:, None]
    return np.asarray(lp + ld * s + li / s)


def torque_response(
    robot: Robot, parameters: Array, settings: LoopSettings, s: ComplexArray
) -> ComplexArray:
    """Return S (K, m, n), coordinates per torque or force, at s = i omega (K,) [1/s].

    The parameters have shape (p,). No entry of s may be zero.
    """
    home = robot.home_pose
    xi = parameters[robot.layout.dynamic]
    basis = robot.geometry.chart.basis
    to_twist = robot.twist(np.tile(home, (len(basis.T), 1)), basis.T).T
    joint_rates = robot.coordinate_jacobian(home)
    inertia = np.linalg.solve(
        (robot.joint_jacobian(home) @ basis).T, basis.T @ robot.mass_matrix(home, xi) @ to_twist
    )
    steps = STEP * basis.T
    stiffness = (
        robot.static_torque(home + steps, xi) - robot.static_torque(home - steps, xi)
    ).T / (2 * STEP)
    # The last digits of the quotient differ between processors, so it is rounded.
    stiffness = agreed(stiffness, RESPONSE_BITS)
    damping = parameters[robot.layout.viscous][:, None] * joint_rates
    loop = pid_response(robot, parameters, s) * (1 + servo_response(settings, s))[:, None]
    total = np.multiply.outer(s**2, inertia) + np.multiply.outer(s, damping) + stiffness
    return np.asarray(np.linalg.inv(total + loop[:, :, None] * joint_rates))


def tracking_response(
    robot: Robot, parameters: Array, settings: LoopSettings, s: ComplexArray
) -> ComplexArray:
    """Return T (K, m, m) from desired to actual coordinates. See `torque_response`."""
    gain = pid_response(robot, parameters, s) * servo_response(settings, s)[:, None]
    drive = gain[:, :, None] * robot.coordinate_jacobian(robot.home_pose)
    return np.asarray(torque_response(robot, parameters, settings, s) @ drive)


def servo_response(settings: LoopSettings, s: ComplexArray) -> ComplexArray:
    """Return C exp(-s t_d) (K,) of the visual servo at s (K,) [1/s]."""
    servo = settings.servo
    timing = settings.timing
    delay = np.exp(-s * (timing.latency_s + 1.0 / timing.frame_rate_hz / 2))
    return np.asarray((servo.kp + servo.kd * s + servo.ki / s) * delay)


# Multiple of the trajectory's highest harmonic up to which sensitivities are included.
HARMONICS_SEEN = 8


def log_linear_information(
    robot: Robot, unknowns: Unknowns, known: Knowledge, smoothing: float | None = None
) -> ca.Function:
    """Return the function z -> ln D in the linearised loop.

    For `smoothing` see `log_observability`.
    """
    z = ca.MX.sym("z", unknowns.size)
    rows = sensitivity_spectrum(robot, unknowns, known.settings, known.guess.values, z, smoothing)
    count = len(known.guess.std)
    basis = unknowns.chart.basis
    whitener = np.linalg.inv(np.linalg.cholesky(known.covariance)) @ basis
    rows = rows @ ca.DM(
        np.kron(np.eye(2 * len(harmonics(unknowns))), agreed(whitener.T, RESPONSE_BITS))
    )
    # A harmonic of amplitude x has the mean square |x|^2 / 2 over the frames.
    scaled = ca.diag(known.guess.std * np.sqrt(len(known.times) / 2)) @ rows
    determinant = log_determinant(count)(scaled @ scaled.T + ca.DM(known.scaled_prior))
    return ca.Function("log_linear_information", [z], [determinant / (2 * count)], ["z"], ["value"])


def harmonics(unknowns: Unknowns) -> ComplexArray:
    """Return s = i omega (K,) [1/s] of the included harmonics."""
    order = np.arange(1, HARMONICS_SEEN * unknowns.harmonics + 1)
    return np.asarray(2j * np.pi * unknowns.fundamental_hz * order, dtype=complex)


def sensitivity_spectrum(
    robot: Robot,
    unknowns: Unknowns,
    settings: LoopSettings,
    parameters: Array,
    z: ca.MX,
    smoothing: float | None = None,
) -> ca.MX:
    """Return the Fourier coefficients of d(coordinates)/d(p parameters), (p, 2 m K).

    Each harmonic has m real and m imaginary parts. A coefficient x_k stands for the motion
    Re(x_k exp(s_k t)).
    """
    times = sample_times(unknowns.fundamental_hz, unknowns.harmonics)
    s = harmonics(unknowns)
    response = torque_response(robot, parameters, settings, s)
    tracking = tracking_response(robot, parameters, settings, s[: unknowns.harmonics])
    followed = tracked_motion(unknowns, z, times, tracking)
    sampled = regressor(robot, smoothing, "torque").map(len(times))(*followed)
    waves = np.exp(-np.outer(times, s)) * 2 / len(times)
    transform = np.stack([waves.real, waves.imag], axis=-1).reshape(len(times), -1)
    dynamic = parameters[robot.layout.dynamic]
    joints = robot.layout.joints
    count = len(dynamic)
    waved = ca.reshape(sampled, count * joints, len(times)) @ ca.DM(agreed(transform))
    spectrum = ca.reshape(waved, count, 2 * joints * len(s))
    error = 1 / pid_response(robot, parameters, s)
    torque = ca.DM(dynamic).T @ spectrum
    by_gain = [response * f[:, None, :] for f in (error, error / s[:, None], error * s[:, None])]
    # the gain of one joint acts on the error of this joint alone
    parts = (
        [response_of * own for own in np.eye(joints) for response_of in by_gain]
        if robot.layout.own_gains
        else by_gain
    )
    gains = [torque @ _real_filter(part) for part in parts]
    return ca.vertcat(-spectrum @ _real_filter(response), *gains)


def _real_filter(response: ComplexArray) -> ca.DM:
    """Return the block-diagonal matrix (2 n K, 2 m K) that applies a complex response to real rows.

    It maps rows (Re y_k, Im y_k) to (Re x_k, Im x_k) with x_k = response_k y_k.
    """
    blocks = [
        agreed(np.block([[r.real.T, r.imag.T], [-r.imag.T, r.real.T]]), RESPONSE_BITS)
        for r in response
    ]
    return ca.diagcat(*[ca.DM(block) for block in blocks])
