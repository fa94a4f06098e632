"""Linear warm start: a linear fit that provides a start close to the optimum.

The closed-loop equation is linear in all unknowns, so a linear fit determines them. Let U be the
logged commands, theta the joint coordinates of the measured poses, Gamma the regressor of the
dynamic parameters Xi, J_ad the Jacobian of the joints, and lp, li and ld the gains. At every
instant

    J_ad^-T Gamma(pose, twist, twist_dot) Xi
        - lp (U - theta) - ld (U_dot - theta_dot) - li integral(U - theta) = z

with z (n,) the torque of the integrators at the start. Poses are filtered and differentiated. For a
platform with fewer degrees of freedom, the equation holds along its coordinates. Each row is the
torque balance of one joint. Its dry friction is known only while the joint slips, so rows of joints
near rest are left out. The equation is homogeneous. The scale anchor and, weakly, the initial guess
determine the common factor.

This equation is for the PID. In other laws of the drives, multiplying all gains by one factor also
multiplies the torque by this factor. The torque is therefore the sum of all gains, each times the
derivative of the torque with respect to this gain. The derivatives of a cascade depend on ratios of
the gains, taken from the previous fit.

One standard deviation of a common error of the poses or of the geometry shifts theta by e. An error
of the latency, of the zeros or of the scale shifts U instead. In the equation, shifts are
multiplied by lp and their integrals by li. With the gains lp0 and li0 of the initial guess, the
errors of the rows are lp0 e and li0 integral(e). They last for the whole run, and are marginalised
(`record.stored_common_errors`).
"""

from collections.abc import Mapping

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.optimize import lsq_linear

from dynamics.closed_loop import FrameTiming
from dynamics.closed_loop.command_schedule import acting_times
from dynamics.closed_loop.drives import JointLaw, gain_columns
from identify.arrays import Array, triangular_factor
from identify.estimation.bounds import SMALLEST_SHARE, least_values
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.estimation.prior import StartingGuess
from identify.estimation.scale_anchor import ScaleAnchor
from identify.filtering import filtered_derivatives, zero_phase_filter
from identify.model.loop_model import LoopModel
from identify.record.stored_common_errors import LATENCY, SCALE, ZERO, Marginal
from identify.scenario import Filter

# Fraction of the record left out at either end, where filtered derivatives are inaccurate.
EDGE_FRACTION = 0.02
# Speed above which a joint counts as slipping, as a fraction of its velocity's standard deviation.
SLIPPING_SHARE = 0.5
# Number of solutions of a fit. Each is weighted by the RMS residual of the previous one.
REWEIGHTINGS = 3


def linear_warm_start(problem: OutputErrorProblem) -> Array:
    """Fit parameters (p,) to the measured poses and commands of the problem's runs.

    Each run has its own unknown torques at the start. The effect of a known payload and commanded
    torques are on the right-hand side. The RMS residual is estimated from the fit, so that the
    initial guess has the right weight.
    """
    guess = problem.guess
    noise = 0.1
    count = len(guess.values)
    layout = guess.layout
    drives = problem.runs[0].settings.drives
    law = drives.joint_law(layout.split(guess.values)[3])
    matrix, right_side, common = _stacked(problem, law)
    least = least_values(layout)
    lower = np.concatenate([least, np.full(matrix.shape[1] - count, -np.inf)])
    rows = _condensed(matrix, right_side, common)
    for _ in range(REWEIGHTINGS):
        whitened = rows / noise
        if common.shape[1]:
            whitened = Marginal.of(common / noise).whiten(whitened)
        solution = bounded_fit(whitened[:, :-1], whitened[:, -1], guess, problem.anchor, lower)
        residual = whitened @ np.append(solution, -1.0)
        noise = max(noise * float(np.sqrt(np.sum(residual**2) / len(right_side))), 1e-9)
        if law.lx.any():  # the columns of a cascade depend on the gains
            found = np.maximum(solution[:count], SMALLEST_SHARE * guess.values)
            law = drives.joint_law(layout.split(found)[3])
            matrix, right_side, common = _stacked(problem, law)
            rows = _condensed(matrix, right_side, common)
    return np.maximum(solution[:count], least)


def _condensed(matrix: Array, right: Array, common: Array) -> Array:
    """Return the matrix and the right-hand side of equations as one array (rows, u + 1).

    Without common errors, the array is reduced to its triangular factor, which is equivalent.
    """
    return np.column_stack([matrix, right]) if common.shape[1] else triangular_factor(matrix, right)


def _stacked(problem: OutputErrorProblem, law: JointLaw) -> tuple[Array, Array, Array]:
    """Return the equations of all runs, N m or N.

    The results are the matrix (rows, p + n runs), the right-hand side (rows,), and the effects of
    common errors (rows, k). Under torque commands, the matrix is (rows, p), and there are no common
    errors. Rows of joints that do not slip are left out.
    """
    matrices = []
    right_sides = []
    common = []
    runs = [run.on_grid() for run in problem.runs]
    layout = runs[0].robot.layout
    count = len(layout.names)
    joints = layout.joints
    for number, run in enumerate(runs):
        balance, slipping = joint_balance(run, run.without_gaps(), problem.low_pass, law)
        columns = balance[slipping]
        if run.settings.drives.torques:
            # Commanded torques do not depend on gains, so they are on the right-hand side.
            columns[:, layout.joint_pid] = 0.0
            matrices.append(columns[:, :count])
            torque, _, _ = effective_command(run, problem.low_pass)
            right_sides.append(torque[slipping] - columns[:, :count] @ run.payload)
            common.append(np.zeros((len(columns), 0)))
            continue
        matrix = np.zeros((len(columns), count + joints * len(runs)))
        matrix[:, :count] = columns[:, :count]
        matrix[:, count + joints * number :][:, :joints] = columns[:, count:]
        matrices.append(matrix)
        right_sides.append(-columns[:, :count] @ run.payload)
        common.append(_common_torques(run, problem.guess, problem.low_pass)[slipping])
    return np.concatenate(matrices), np.concatenate(right_sides), np.concatenate(common)


def _common_torques(run: LoopModel, guess: StartingGuess, low_pass: Filter) -> Array:
    """Return the torques (N, n, 2 k), N m or N, that common errors add to every joint's balance.

    The torques are for one standard deviation of each of k errors of poses, geometry and loop, with
    the gains of the initial guess. The parts by the proportional gain come first, and then those by
    the integral gain.
    """
    common = run.common
    moved = []
    if common.names:
        moved.append(run.robot.pose_jacobian(run.reference.poses) @ common.modes)
    if common.geometry:
        moved.append(common.geometry.joints(run.without_gaps()))
    if common.loop_std:
        command, rate, _ = effective_command(run, low_pass)
        moved.append(_moved_commands(common.loop_std, command, rate))
    if not moved:
        return np.zeros((*run.logged.shape, 0))
    lp, li, _ = guess.layout.split(guess.values)[3].T[:, :, None]
    angle = np.concatenate(moved, axis=2)
    integral = running_integral(angle, run.settings.timing.frame_rate_hz)
    return np.concatenate([lp * angle, li * integral], axis=2)


def _moved_commands(stds: Mapping[str, float], command: Array, rate: Array) -> Array:
    """Return the changes (N, n, k) of commands (N, n) by one standard deviation of each error.

    The errors are those of the latency, of the scale, and of the zeros of the joints in their
    order. Errors of friction move no command: an offset of friction is part of the torques at the
    start, and the other constants act at rest. rate (N, n): rate of the commands.
    """
    zeros = iter(np.eye(command.shape[1]))
    changes = np.zeros((*command.shape, len(stds)))
    for k, (name, std) in enumerate(stds.items()):
        if name.startswith(ZERO):
            changes[:, :, k] = std * next(zeros)
        elif name in (LATENCY, SCALE):
            changes[:, :, k] = std * (rate if name == LATENCY else command)
    return changes


def joint_balance(
    run: LoopModel, poses: Array, low_pass: Filter, law: JointLaw
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the torque balance of every joint, and the frames in which joints slip.

    Parameters
    ----------
    run : LoopModel
        Model of the run, with its logged commands.
    poses : ndarray, shape (N, 6)
        Poses of the run without gaps, such as measured poses.
    low_pass : Filter
        Filter of poses and commands.
    law : JointLaw
        Law of the drives.

    Returns
    -------
    columns : ndarray, shape (N, n, p + n)
        Columns of the balance, N m or N per unit of each unknown. The columns of the dynamic
        parameters give the joint's torque. The columns of the gains, and then those of the torques
        at the start, give the controller's torque with the opposite sign.
    slipping : ndarray of bool, shape (N, n)
        True for frames in which a joint slips, except at both ends of the record.
    """
    robot = run.robot
    rate_hz = run.settings.timing.frame_rate_hz
    chart = robot.geometry.chart
    coordinates = filtered_derivatives(
        chart.coordinates(poses), rate_hz, low_pass.cutoff_hz, low_pass.order
    )
    pose = chart.pose(coordinates[0])
    pose_rate = chart.lifted(coordinates[1])
    acceleration = chart.lifted(coordinates[2])
    twist = robot.twist(pose, pose_rate)
    twist_dot = robot.twist_dot(pose, pose_rate, acceleration)
    regressor = chart.projected(robot.regressor(pose, twist, twist_dot))
    torque_map = np.linalg.inv(robot.joint_jacobian(pose) @ chart.basis).transpose(0, 2, 1)
    angle = robot.inverse_kinematics(pose)
    velocity = np.einsum("nij,nj->ni", robot.joint_jacobian(pose), twist)
    command, command_rate, integral = effective_command(run, low_pass)
    angle_integral = running_integral(angle, rate_hz)
    count = len(poses)
    joints = robot.layout.joints
    start = np.broadcast_to(-np.eye(joints), (count, joints, joints))
    rate = first_order(law.rate_weight * command_rate - velocity, law.filter_time, rate_hz)
    pid = np.stack([command - angle, integral - angle_integral, rate], axis=2)
    by_gains = gain_columns(law.reads * pid - law.lx_by * angle[:, :, None], robot.layout.own_gains)
    columns = np.concatenate([torque_map @ regressor, -by_gains, start], axis=2)
    slipping = np.abs(velocity) > SLIPPING_SHARE * velocity.std(axis=0)
    edge = max(1, round(EDGE_FRACTION * count))
    slipping[:edge] = False
    slipping[count - edge :] = False
    return columns, slipping


def effective_command(run: LoopModel, low_pass: Filter) -> tuple[Array, Array, Array]:
    """Return the filtered command that acts on the joints, its rate, and its integral, per frame.

    The rate is that of the joint PID, the held difference of two commands. In addition to the
    latency, a held command lags by half a frame on average, and a ramped command by a whole frame.
    """
    commands = run.logged
    timing = run.settings.timing
    if run.latencies is not None:
        return _acted(commands, timing, low_pass, run.latencies)
    rate_hz = timing.frame_rate_hz
    period = 1.0 / rate_hz
    smooth = zero_phase_filter(commands, rate_hz, low_pass.cutoff_hz, low_pass.order)
    times = np.arange(len(commands)) * period
    spline = make_interp_spline(times, smooth, k=5)
    # Mean lag of the acting command, over the period that follows a command.
    lag = timing.latency_s + (period if timing.hold == "linear" else period / 2)
    acting = spline(np.clip(times - lag, 0.0, None))
    rate = spline(np.clip(times - timing.latency_s - period, 0.0, None), nu=1)
    return acting, rate, running_integral(acting, rate_hz)


def _acted(
    commands: Array, timing: FrameTiming, low_pass: Filter, latencies: Array
) -> tuple[Array, Array, Array]:
    """Return the results of `effective_command` for commands with individual latencies.

    What acts between two arrivals is integrated exactly. The derivative of the integral, filtered,
    is the command or its rate.
    """
    rate_hz = timing.frame_rate_hz
    period = 1.0 / rate_hz
    times = np.arange(len(commands), dtype=float) * period
    arrivals = acting_times(times, latencies)
    newest = np.maximum(np.searchsorted(arrivals, times, side="right") - 1, 0)
    differences = np.diff(commands, axis=0, prepend=commands[:1])

    def acting(values: Array, ramped: float) -> Array:
        """Return the filtered acting values. ramped: 1 if they change in ramps, 0 if in jumps."""

        def since(which: NDArray[np.intp] | slice, duration: Array) -> Array:
            """Return the integral of the acting values over a duration since their arrival."""
            # During the first frame period, a ramp lags behind the command.
            behind = np.minimum(duration, period)
            behind = behind - behind**2 / (2 * period)
            return (
                values[which] * duration[:, None] - (ramped * differences)[which] * behind[:, None]
            )

        so_far = np.vstack([arrivals[0] * values[:1], since(slice(-1), np.diff(arrivals))]).cumsum(
            axis=0
        )
        integral = so_far[newest] + since(newest, times - arrivals[newest])
        held = make_interp_spline(times, integral, k=5).derivative()(times)
        return zero_phase_filter(held, rate_hz, low_pass.cutoff_hz, low_pass.order)

    command = acting(commands, float(timing.hold == "linear"))
    return command, acting(differences * rate_hz, 0.0), running_integral(command, rate_hz)


def first_order(samples: Array, time_constant: float, rate_hz: float) -> Array:
    """Filter samples (N, ...) by a low-pass filter of first order, with a time constant in s.

    A time constant of zero changes nothing. The filter starts in equilibrium with the first sample.
    """
    if not time_constant:
        return samples
    # The filter is discretised by the trapezoidal rule.
    half = 0.5 / (rate_hz * time_constant)
    rest = samples[:1]
    return rest + scipy.signal.lfilter([half, half], [1 + half, half - 1], samples - rest, axis=0)


def running_integral(samples: Array, rate_hz: float) -> Array:
    """Return the integral from the first frame to each of samples (N, ...), by a quintic spline."""
    spline = make_interp_spline(np.arange(len(samples)) / rate_hz, samples, k=5)
    integral = spline.antiderivative()
    return integral(np.arange(len(samples)) / rate_hz)


def bounded_fit(
    matrix: Array, right: Array, guess: StartingGuess, anchor: ScaleAnchor, lower: Array
) -> Array:
    """Return the least-squares solution (u,) >= lower of whitened equations (rows, u).

    The guess and the anchor are added as equations. The first p unknowns are the parameters. The
    others have no prior.
    """
    size = matrix.shape[1]
    known_size = len(guess.values)
    extra = size - known_size
    triangle = triangular_factor(matrix, right)[:size]
    prior = np.eye(known_size, size) / guess.std[:, None]
    anchor_rows, measured = anchor.row(guess.layout)
    known = np.vstack([triangle[:, :size], prior, np.pad(anchor_rows, ((0, 0), (0, extra)))])
    values = np.concatenate([triangle[:, size], guess.values / guess.std, measured])
    scale = np.concatenate([guess.std, np.ones(extra)])
    solved = lsq_linear(known * scale, values, bounds=(lower / scale, np.inf), method="bvls")
    return np.asarray(solved.x * scale, dtype=float)
