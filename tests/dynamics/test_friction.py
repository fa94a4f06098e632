"""Friction: its laws, closed forms of one joint, the choice of sticking joints, and what the whole robot does."""

import itertools

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dynamics.closed_loop.motion import Command, State
from dynamics.closed_loop.problem import LENGTH, FrictionLaw
from dynamics.closed_loop.stick_slip import StickSlipMotion
from dynamics.rigid_body import equation_of_motion as model
from tests.dynamics.conftest import BOX, at_rest

MASS, STIFFNESS, COULOMB = 0.8, 20.0, 1.0
FREQUENCY = np.sqrt(STIFFNESS / MASS)
BY_START = LENGTH + 1  # the column of the start position, behind those of the parameters and of the step
COLUMNS = LENGTH + 2
STRIBECK = FrictionLaw("stribeck", static_ratio=1.5, stribeck_velocity=0.2)
LAWS = [FrictionLaw(), FrictionLaw("smoothed", smoothing_velocity=0.1), STRIBECK]


def _one_joint_functions():
    """Six masses without coupling or gravity: theta = pose, M = rigid[0] times the unit matrix."""
    zero, column = np.zeros((6, 6)), np.zeros((6, 1))

    def columns(acceleration):
        result = np.zeros((6, 52))
        result[:, 0] = acceleration
        return result

    return {
        "equation_of_motion": lambda q, v, rigid: (rigid[0] * np.eye(6), column, np.eye(6), column, q[:, None]),
        "motion_derivatives": lambda q, v, a, torque, rigid: (zero, zero, columns(a), zero, zero),
        "rate_map_derivative": lambda q, v: zero,
    }


def _one_joint(tangent=None, law=None):
    parameters = np.zeros(67)
    parameters[0], parameters[52:58], parameters[64] = MASS, COULOMB, STIFFNESS
    return StickSlipMotion(_one_joint_functions(), parameters, law or FrictionLaw(), tangent)


def _command(slope=0.0):
    rows = np.zeros((6, COLUMNS))
    ramp = np.array([slope, 0, 0, 0, 0, 0])
    return Command(np.zeros(6), ramp, np.zeros(6), rows, rows, rows)


def _displaced(x):
    return State(np.array([x, 0, 0, 0, 0, 0.0]), np.zeros(6), np.zeros(6))


def _oscillator(t, x0, k=STIFFNESS, fc=COULOMB, mass=MASS):
    """Position of m x_ddot = -k x - fc sign(x_dot) from rest at x0 > fc / k: each half swing loses 2 fc / k."""
    centre, half = fc / k, np.pi * np.sqrt(mass / k)
    start, side = x0, 1.0
    while t > half and abs(start) > centre:
        start, side, t = 2 * side * centre - start, -side, t - half
    if abs(start) <= centre:
        return start
    return side * centre + (start - side * centre) * np.cos(t * np.sqrt(k / mass))


def test_level_of_friction_has_its_slope_and_stribeck_goes_from_breakaway_to_coulomb():
    """At rest the breakaway torque, far above the Stribeck velocity the Coulomb torque, and odd in the velocity."""
    for law, direction in itertools.product(LAWS, (1.0, -1.0)):
        v, side = direction * np.linspace(0.01, 1.0, 40), np.full(40, direction)
        numeric = (law.dry_level(v + 1e-6, side) - law.dry_level(v - 1e-6, side)) / 2e-6
        np.testing.assert_allclose(law.dry_slope(v, side), numeric, atol=1e-8, err_msg=law.name)
    for velocity, level in ((0.0, 1.5), (0.2, 1 + 0.5 / np.e), (5.0, 1.0)):
        for side in (1, -1):
            found = STRIBECK.dry_level(np.array([side * velocity]), np.array([float(side)]))
            assert found == pytest.approx(side * level)


@pytest.mark.parametrize("half_swings", [0.4, 1.5, 2.7, 3.3, 8.0])
def test_one_joint_swings_and_comes_to_rest_as_in_closed_form(half_swings):
    """A mass on a spring with dry friction: position to 1e-10 m in every half swing, and where it stays for good."""
    x0, time = 0.33, half_swings * np.pi / FREQUENCY
    motion = _one_joint()
    end = motion.segment(_displaced(x0), _command(), time, round(400 * half_swings))
    np.testing.assert_allclose(end.pose[0], _oscillator(time, x0), rtol=0, atol=1e-10)
    np.testing.assert_array_equal(end.pose[1:], 0)
    if half_swings > 4:  # x0 = 6.6 centres: at rest after three half swings
        assert motion.mode[0] == 0
        assert end.rate[0] == 0


def test_one_joint_breaks_away_when_the_spring_pulls_enough():
    """Pulled by a spring whose end moves steadily, the mass stays until k v t = f_c, then follows its closed form."""
    speed = 0.1
    breakaway = COULOMB / (STIFFNESS * speed)
    motion = _one_joint()
    before = motion.segment(_displaced(0.0), _command(speed), 0.999 * breakaway, 7)
    np.testing.assert_array_equal(before.pose, 0)
    assert motion.events == 0
    after = 0.8 * np.pi / FREQUENCY
    end = _one_joint().segment(_displaced(0.0), _command(speed), breakaway + after, 400)
    expected = speed * (after - np.sin(FREQUENCY * after) / FREQUENCY)
    np.testing.assert_allclose(end.pose[0], expected, atol=1e-10)
    np.testing.assert_allclose(end.rate[0], speed * (1 - np.cos(FREQUENCY * after)), atol=1e-9)


def test_a_joint_that_stops_and_goes_on_within_one_step_is_noticed():
    """Velocity 0.04 - 2 t + 20 t^2 without friction's hold would dip below zero and be positive again at t = 0.1:
    one step over it finds both events, the stop and the breakaway, as fifty steps do."""
    start = State(np.zeros(6), 0.04 * np.eye(6)[0], np.zeros(6))
    rows, unit = np.zeros((6, COLUMNS)), np.eye(6)[0]
    pull = Command((COULOMB - 2 * MASS) / STIFFNESS * unit, 40 * MASS / STIFFNESS * unit, np.zeros(6), rows, rows, rows)
    ends = []
    for steps in (1, 50):
        motion = _one_joint()
        motion.mode[0] = 1
        ends.append(motion.segment(start, pull, 0.1, steps))
        assert motion.events == 2
    np.testing.assert_allclose(ends[0].pose, ends[1].pose, atol=5e-6)  # without the events: 6e-4 off


@pytest.mark.parametrize("half_swings", [0.6, 1.5, 2.6, 5.0])
def test_one_joint_sensitivities_are_derivatives_of_the_closed_form(half_swings):
    """Through reversals and the final stop: d(position) by spring, dry friction, mass and start position against the
    closed form; once the mass is stuck for good, where it started counts still, with the sign of the last swing."""
    x0, time = 0.33, half_swings * np.pi / FREQUENCY
    tangent = State(*np.zeros((3, 6, COLUMNS)))
    tangent.pose[0, BY_START] = 1
    motion = _one_joint(tangent)
    motion.segment(_displaced(x0), _command(), time, round(200 * half_swings))
    h = 1e-5
    for column, name, value in ((64, "k", STIFFNESS), (52, "fc", COULOMB), (0, "mass", MASS), (BY_START, "x0", x0)):
        above, below = (_oscillator(time, **{"x0": x0, name: value + side * h}) for side in (1, -1))
        exact = (above - below) / (2 * h)
        np.testing.assert_allclose(motion.tangent.pose[0, column], exact, atol=1e-8, err_msg=name)


def _first_half_swing(x0, time):
    """scipy's solution from rest at x0 > breakaway, until it comes to rest for the first time."""

    def motion(t, state):
        friction = -COULOMB * (1 + 0.5 * np.exp(-((state[1] / 0.2) ** 2)))
        return [state[1], (-STIFFNESS * state[0] - friction) / MASS]

    def stops(t, state):
        return state[1] if t > 1e-6 else -1.0

    stops.terminal, stops.direction = True, 1
    solved = solve_ivp(motion, (0, time), [x0, 0.0], events=stops, rtol=1e-12, atol=1e-13)
    return solved.y[0, -1], bool(solved.t_events[0].size)


@pytest.mark.parametrize("time", [0.1, 0.4, 2.0])
def test_one_joint_under_stribeck_friction_moves_as_scipy_says(time):
    """Released from 0.11 m it swings once and stays: what is left pulls less than the breakaway torque."""
    motion = _one_joint(law=STRIBECK)
    end = motion.segment(_displaced(0.11), _command(), time, round(800 * time))
    expected, stopped = _first_half_swing(0.11, time)
    np.testing.assert_allclose(end.pose[0], expected, atol=1e-8)
    assert (motion.mode[0] == 0) == stopped


@pytest.mark.parametrize(("pull", "moves"), [(1.49, False), (1.51, True)])
def test_one_joint_breaks_away_at_the_static_torque(pull, moves):
    """Between Coulomb and breakaway torque it sticks; just above it starts."""
    motion = _one_joint(law=STRIBECK)
    end = motion.segment(_displaced(pull * COULOMB / STIFFNESS), _command(), 0.05, 10)
    assert (end.rate[0] != 0) == moves


def _friction_at_rest(mass, bias, jacobian, drift, torque, limit):
    """Acceleration by trying all 3^6 combinations of stuck and starting joints; exactly one is consistent."""
    found = []
    for modes in itertools.product((-1, 0, 1), repeat=6):
        modes = np.array(modes)
        stuck = np.flatnonzero(modes == 0)
        n = len(stuck)
        matrix = np.block([[mass, jacobian[stuck].T], [jacobian[stuck], np.zeros((n, n))]])
        right = np.concatenate([jacobian.T @ (torque - modes * limit) - bias, -drift[stuck]])
        solution = np.linalg.solve(matrix, right)
        joint_acceleration = jacobian @ solution[:6] + drift
        if (np.abs(solution[6:]) < limit[stuck]).all() and (modes * joint_acceleration >= 0)[modes != 0].all():
            found.append((modes, solution[:6]))
    assert len(found) == 1
    return found[0]


def test_sticking_joints_are_those_of_the_friction_problem(robot, identified):
    """At rest under random torques around balance, the joints that start, their sides and the first acceleration are
    those found by trying all 729 combinations."""
    rng = np.random.default_rng(4)
    functions = {function.name(): function for function in model.motion_functions(robot.geometry)}
    for _ in range(8):
        pose, rest = robot.home_pose + BOX * rng.uniform(-1, 1, 6), np.zeros(6)
        values = functions["equation_of_motion"](pose, rest, identified[:52])
        mass, bias, jacobian, drift, angle = (np.asarray(value, dtype=float) for value in values)
        torque = np.linalg.solve(jacobian.T, bias[:, 0]) + 2 * identified[52:58] * rng.standard_normal(6)
        modes, acceleration = _friction_at_rest(mass, bias[:, 0], jacobian, drift[:, 0], torque, identified[52:58])
        motion = StickSlipMotion(functions, identified, FrictionLaw())
        integral = (torque) / identified[65]
        rows = np.zeros((6, COLUMNS))
        end = motion.segment(State(pose, rest, integral), Command(angle[:, 0], rest, rest, rows, rows, rows), 1e-6, 1)
        np.testing.assert_array_equal(motion.mode, modes)
        np.testing.assert_allclose(end.rate / 1e-6, acceleration, atol=1e-4 * np.abs(acceleration).max() + 1e-9)


def test_platform_stays_below_breakaway_and_moves_when_the_integrator_reaches_it(loop, robot, identified):
    """A minute with joint 3 loaded up to 0.6 of its dry friction: the pose does not change by one bit, no event. With
    lp d + li d t growing, it holds until that reaches f_c, to the frame; the other joints stay stuck."""
    lp, li, _ = identified[64:]
    reference = at_rest(robot.home_pose, 3600)
    below, beyond = (loop.run(reference, commands=np.tile(d * np.eye(6)[2], (3600, 1))) for d in (3e-5, 1e-4))
    load = np.abs(below.torque[:, 2] - below.torque[0, 2]).max() + lp * 3e-5
    assert 0.5 < load / identified[54] < 0.8
    np.testing.assert_array_equal(below.pose, reference.poses)
    np.testing.assert_array_equal(below.pose_rate, 0)
    assert below.events == 0
    # The jump of the first command also acts through U_dot, but during frame 0 only and below breakaway.
    breakaway = (identified[54] - lp * 1e-4) / (li * 1e-4)
    moved = np.flatnonzero(np.abs(beyond.pose - robot.home_pose).max(axis=1))[0]
    assert moved - 1 <= breakaway * 60 <= moved
    others = np.delete(robot.inverse_kinematics(beyond.pose[: moved + 3]), 2, axis=1)
    np.testing.assert_allclose(others, 0, atol=1e-12)


def test_integrator_is_of_order_four(loop):
    """With exact friction and its events, halving the step divides the error by 16 (order 3.5 to 4.5), twice."""
    reference = loop.reference(60)
    finest = loop.run(reference, loop.settings(steps=128))
    runs = [loop.run(reference, loop.settings(steps=n)) for n in (8, 16, 32)]
    assert all(run.events == finest.events > 20 for run in runs)
    errors = [np.abs(run.pose - finest.pose).max() for run in runs]
    orders = np.log2([errors[0] / errors[1], errors[1] / errors[2]])
    assert ((orders > 3.5) & (orders < 4.5)).all(), (errors, orders)
    assert errors[0] < 1e-8


def test_smoothed_law_tends_to_the_exact_one(loop):
    """The difference shrinks in proportion to the smoothing velocity, and is below 5 um and 25 urad at 0.5 mrad/s."""
    reference = loop.reference(60)
    exact = loop.run(reference, loop.settings(steps=32))
    differences = []
    for velocity, steps in ((4e-3, 64), (2e-3, 128), (1e-3, 256), (5e-4, 512)):
        settings = loop.settings(smoothing_velocity=velocity, steps=steps)
        smoothed = loop.run(reference, settings)
        assert smoothed.events == 0
        differences.append(np.abs(smoothed.pose - exact.pose).max(axis=0))
    differences = np.array(differences)
    ratios = differences[:-1].max(axis=1) / differences[1:].max(axis=1)
    assert ((ratios > 1.5) & (ratios < 2.7)).all(), ratios
    assert (differences[-1] < [5e-6] * 3 + [2.5e-5] * 3).all(), differences[-1]


def test_robot_without_dry_friction_runs_without_events(loop, robot):
    """Table 1 has no friction: no event, and the exact law equals the smoothed one to rounding."""
    laws, parameters = (loop.settings(), loop.settings(smoothing_velocity=1e-3)), robot.parameter_sets["initial"].vector
    exact, smoothed = (loop.run(60, law, parameters) for law in laws)
    assert exact.events == 0
    np.testing.assert_allclose(exact.pose, smoothed.pose, atol=1e-13)
