"""Linear warm start: the closed-loop equation is linear in everything unknown, so one fit starts
the search close by.

With the logged commands U and the joint coordinates theta of the measured poses, at every instant

    J_ad^-T Gamma(pose, twist, twist_dot) Xi - lp (U - theta) - ld (U_dot - theta_dot) - li
    integral(U - theta) = z

with z the torque the integrators held at the start (n,). Poses are filtered and differentiated, and
of those of a platform with fewer freedoms its coordinates count, along which the wrench Gamma Xi is
balanced. Each row is the balance of one joint, whose dry friction is known only while it slips:
rows of joints near rest are left out. The equation is homogeneous: the scale anchor, and weakly the
starting guess, decide the common factor.

That is the PID. In other laws of the drives the torque is in proportion to the gains, too, and so
the sum of its derivatives by these, times these; those of a cascade depend on ratios of the gains,
for which the latest fit stands.

What all poses of a run have in common, or a geometry that is known only so well, moves theta by e
d, with d of standard deviation one; an error of the latency moves U by the way that it makes in
that time. That stands in the equation with lp and with li: as errors of the rows that go on along a
run, lp0 e and li0 integral(e) with the gains of the starting guess, they are marginalised
(`record.common_errors`).
"""

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.optimize import lsq_linear
from scipy.signal import lfilter

from dynamics import Robot
from dynamics.closed_loop.command_schedule import acting_times
from dynamics.closed_loop.drives import JointLaw
from identify.arrays import Array, triangular_factor
from identify.estimation.bounds import SMALLEST_SHARE
from identify.estimation.output_error import OutputErrorProblem
from identify.estimation.prior import StartingGuess
from identify.estimation.scale_anchor import ScaleAnchor
from identify.filtering import filtered_derivatives, zero_phase_filter
from identify.model.loop_model import LoopModel
from identify.record.common_errors import Marginal
from identify.scenario import Scenario

EDGE_FRACTION = 0.02
"""Share of the record left out at either end, where filtered derivatives are poor."""

SLIPPING_SHARE = 0.5
"""A joint counts as slipping above this share of its RMS velocity."""

REWEIGHTINGS = 3
"""Solutions of the fit: each takes the size of the residual from the one before."""


def linear_warm_start(problem: OutputErrorProblem, scenario: Scenario) -> Array:
    """Parameters (p,) fitted to the measured poses and commands of the problem's runs.

    Each run has its own starting torques; what a known payload adds stands on the right side, as do
    torques that were commanded. The residual's size is estimated from the fit itself, so that the
    starting guess counts as much as it should.
    """
    guess = problem.guess
    noise = 0.1
    count = len(guess.values)
    pid = guess.layout.joint_pid
    drives = problem.runs[0].settings.drives
    law = drives.joint_law(guess.values[pid])
    matrix, right, common = _stacked(problem, scenario, law)
    lower = np.concatenate([np.zeros(count), np.full(matrix.shape[1] - count, -np.inf)])
    rows = _condensed(matrix, right, common)
    for _ in range(REWEIGHTINGS):
        whitened = rows / noise
        if common.shape[1]:
            whitened = Marginal.of(common / noise).whiten(whitened)
        solution = bounded_fit(whitened[:, :-1], whitened[:, -1], guess, problem.anchor, lower)
        noise = max(
            noise
            * float(np.sqrt(np.sum((whitened @ np.append(solution, -1.0)) ** 2) / len(right))),
            1e-9,
        )
        if law.lx:
            law = drives.joint_law(np.maximum(solution[:count], SMALLEST_SHARE * guess.values)[pid])
            matrix, right, common = _stacked(problem, scenario, law)
            rows = _condensed(matrix, right, common)
    return np.maximum(solution[:count], 0.0)


def _condensed(matrix: Array, right: Array, common: Array) -> Array:
    """Equations with their right side behind them (rows, u + 1); where errors are independent,
    their triangular factor, which says the same at any noise."""
    return np.column_stack([matrix, right]) if common.shape[1] else triangular_factor(matrix, right)


def _stacked(
    problem: OutputErrorProblem, scenario: Scenario, law: JointLaw
) -> tuple[Array, Array, Array]:
    """Equations of all runs: matrix (rows, p + n runs), right side (rows,) and common errors (rows,
    k), N m or N.
    """
    matrices = []
    right = []
    common = []
    runs = problem.runs
    layout = runs[0].robot.layout
    count = len(layout.names)
    joints = layout.joints
    for place, run in enumerate(runs):
        latencies = run.latencies
        balance, slipping = joint_balance(
            run.robot, run.without_gaps(), run.logged, scenario, law, latencies
        )
        columns = balance[slipping]
        if run.settings.drives.torques:
            columns[:, layout.joint_pid] = 0.0
            matrices.append(columns[:, :count])
            felt = effective_command(run.logged, scenario, latencies)[0][slipping]
            right.append(felt - columns[:, :count] @ run.payload)
            common.append(np.zeros((len(columns), 0)))
            continue
        matrix = np.zeros((len(columns), count + joints * len(runs)))
        matrix[:, :count] = columns[:, :count]
        matrix[:, count + joints * place :][:, :joints] = columns[:, count:]
        matrices.append(matrix)
        right.append(-columns[:, :count] @ run.payload)
        common.append(_common_torques(run, problem.guess, scenario)[slipping])
    return np.concatenate(matrices), np.concatenate(right), np.concatenate(common)


def _common_torques(run: LoopModel, guess: StartingGuess, scenario: Scenario) -> Array:
    """What common errors of the poses and errors of geometry and latency, each of one standard
    deviation, add to the balance of every joint (N, n, k), N m or N, with the gains of the starting
    guess."""
    poses, (lp, li, _) = run.without_gaps(), guess.values[guess.layout.joint_pid]
    by_pose = (
        run.robot.pose_jacobian(run.reference.poses) @ run.common.modes
        if run.common.names
        else None
    )
    by_geometry = run.common.geometry.joints(poses) if run.common.geometry else None
    latency_std = run.common.latency_std
    by_latency = None
    if latency_std:
        by_latency = (
            latency_std * effective_command(run.logged, scenario, run.latencies)[1][:, :, None]
        )
    moved = [part for part in (by_pose, by_geometry, by_latency) if part is not None]
    if not moved:
        return np.zeros((*run.logged.shape, 0))
    angle = np.concatenate(moved, axis=2)
    return np.concatenate(
        [lp * angle, li * running_integral(angle, scenario.timing.frame_rate_hz)], axis=2
    )


def joint_balance(
    robot: Robot,
    measured: Array,
    commands: Array,
    scenario: Scenario,
    law: JointLaw,
    latencies: Array | None = None,
) -> tuple[Array, NDArray[np.bool_]]:
    """Torque balance of every joint (N, n, p + n) of poses (N, 6) and commands (N, n), and where it
    slips (N, n).

    law: of the drives; latencies (N,): of the commands, s, None: that of the timing.

    Columns: the dynamic parameters, which give the joint's torque, then lp, li, ld and the starting
    torques, which give the controller's with the opposite sign; N m or N per unit of each.
    """
    rate_hz = scenario.timing.frame_rate_hz
    cutoff_hz = scenario.filter.cutoff_hz
    order = scenario.filter.order
    chart = robot.geometry.chart
    coordinates = filtered_derivatives(chart.coordinates(measured), rate_hz, cutoff_hz, order)
    pose, pose_rate, acceleration = (
        chart.pose(coordinates[0]),
        *(chart.lifted(rows) for rows in coordinates[1:]),
    )
    twist = robot.twist(pose, pose_rate)
    twist_dot = robot.twist_dot(pose, pose_rate, acceleration)
    regressor = chart.projected(robot.regressor(pose, twist, twist_dot))
    torque_map = np.linalg.inv(robot.joint_jacobian(pose) @ chart.basis).transpose(0, 2, 1)
    angle = robot.inverse_kinematics(pose)
    velocity = np.einsum("nij,nj->ni", robot.joint_jacobian(pose), twist)
    command, command_rate, integral = effective_command(commands, scenario, latencies)
    angle_integral = running_integral(angle, rate_hz)
    count = len(measured)
    joints = robot.layout.joints
    start = np.broadcast_to(-np.eye(joints), (count, joints, joints))
    rate = low_pass(law.rate_weight * command_rate - velocity, law.filter_time, rate_hz)
    pid = np.stack([command - angle, integral - angle_integral, rate], axis=2)
    by_gains = law.reads * pid - law.lx_by * angle[:, :, None]
    columns = np.concatenate([torque_map @ regressor, -by_gains, start], axis=2)
    slipping = np.abs(velocity) > SLIPPING_SHARE * velocity.std(axis=0)
    edge = max(1, round(EDGE_FRACTION * count))
    slipping[:edge] = slipping[count - edge :] = False
    return columns, slipping


def effective_command(
    commands: Array, scenario: Scenario, latencies: Array | None = None
) -> tuple[Array, Array, Array]:
    """Filtered command as the joints feel it, its rate as the joint PID sees it, and its integral,
    at the frames.

    A held command lags by half a frame, a ramped one by a whole frame; U_dot is the difference of
    two commands, held. latencies (N,): of the commands, s, where they have not all that of the
    timing.
    """
    if latencies is not None:
        return _acted(commands, scenario, latencies)
    timing = scenario.timing
    filtering = scenario.filter
    rate_hz = timing.frame_rate_hz
    period = timing.frame_period_s
    smooth = zero_phase_filter(commands, rate_hz, filtering.cutoff_hz, filtering.order)
    times = np.arange(len(commands)) * period
    spline = make_interp_spline(times, smooth, k=5)
    lag = timing.latency_s + (period if timing.hold == "linear" else period / 2)
    felt = spline(np.clip(times - lag, 0.0, None))
    rate = spline(np.clip(times - timing.latency_s - period, 0.0, None), nu=1)
    return felt, rate, running_integral(felt, rate_hz)


def _acted(commands: Array, scenario: Scenario, latencies: Array) -> tuple[Array, Array, Array]:
    """`effective_command` of commands that each arrive after a latency of its own: filtered rates
    of the integrals of what acts from one arrival to the next."""
    timing = scenario.timing
    filtering = scenario.filter
    rate_hz = timing.frame_rate_hz
    period = timing.frame_period_s
    times = np.arange(len(commands), dtype=float) * period
    arrivals = acting_times(times, latencies)
    newest = np.maximum(np.searchsorted(arrivals, times, side="right") - 1, 0)
    differences = np.diff(commands, axis=0, prepend=commands[:1])

    def felt(values: Array, ramped: float) -> Array:
        def since(which: NDArray[np.intp] | slice, duration: Array) -> Array:
            """Integral of what acts since its arrival: under a ramp of one frame, of so much, it is
            behind at first.
            """
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
        return zero_phase_filter(held, rate_hz, filtering.cutoff_hz, filtering.order)

    command = felt(commands, float(timing.hold == "linear"))
    return command, felt(differences * rate_hz, 0.0), running_integral(command, rate_hz)


def low_pass(samples: Array, time_constant: float, rate_hz: float) -> Array:
    """Samples (N, ...) through a filter of first order (s; 0: none), which knows the first of them
    from before.
    """
    if not time_constant:
        return samples
    half = 0.5 / (rate_hz * time_constant)
    rest = samples[:1]
    return rest + lfilter([half, half], [1 + half, half - 1], samples - rest, axis=0)


def running_integral(samples: Array, rate_hz: float) -> Array:
    """Integral from the first frame to each of samples (N, ...), by a quintic spline."""
    spline = make_interp_spline(np.arange(len(samples)) / rate_hz, samples, k=5)
    integral = spline.antiderivative()
    return integral(np.arange(len(samples)) / rate_hz)


def bounded_fit(
    matrix: Array, right: Array, guess: StartingGuess, anchor: ScaleAnchor, lower: Array
) -> Array:
    """Unknowns (u,) >= lower of whitened equations (rows, u), beside the starting guess and the
    anchor.

    The first p unknowns are the parameters; of those after them nothing is known beforehand.
    """
    size = matrix.shape[1]
    known_size = len(guess.values)
    extra = size - known_size
    triangle = triangular_factor(matrix, right)[:size]
    prior = np.eye(known_size, size) / guess.std[:, None]
    place, measured = anchor.row(guess.layout)
    known = np.vstack([triangle[:, :size], prior, np.pad(place, ((0, 0), (0, extra)))])
    values = np.concatenate([triangle[:, size], guess.values / guess.std, measured])
    scale = np.concatenate([guess.std, np.ones(extra)])
    solved = lsq_linear(known * scale, values, bounds=(lower / scale, np.inf), method="bvls")
    return np.asarray(solved.x * scale, dtype=float)
