"""The Jacobians of eq. 7-16 and 29 by finite differences, and their closed-form rates by automatic derivatives."""

import casadi as ca
import numpy as np
import pytest

from dynamics.kinematics import jacobians
from dynamics.kinematics import jacobians as jacobian_rates
from dynamics.kinematics.inverse_kinematics import leg_vectors, platform_arms
from dynamics.kinematics.rotation import pose_rate_to_twist, rotation_matrix, twist_bias
from dynamics.parameters import RIGID_BODY

PER_LEG = {  # Jacobian of one leg and its closed-form rate
    "J_a1": (lambda leg, arm: jacobians.crank_leverage(leg), jacobian_rates.crank_leverage_rate),
    "J_a2": (jacobians.link_row, jacobian_rates.link_row_rate),
    "J_ad": (jacobians.joint_row, jacobian_rates.joint_row_rate),
    "J_au": (jacobians.crank_centre_rows, jacobian_rates.crank_centre_rows_rate),
    "J_a": (jacobians.crank_jacobian, jacobian_rates.crank_jacobian_rate),
    "J_bd": (jacobians.link_angular_rows, jacobian_rates.link_angular_rows_rate),
    "J_bu": (jacobians.link_centre_rows, jacobian_rates.link_centre_rows_rate),
    "J_b": (jacobians.link_jacobian, jacobian_rates.link_jacobian_rate),
}


@pytest.fixture(scope="module")
def symbols():
    return ca.SX.sym("pose", 6), ca.SX.sym("twist", 6)


def evaluated(inputs, expression, *values):
    function = ca.Function("f", inputs, [ca.densify(expression)])
    return np.array([np.array(function(*row)) for row in zip(*values, strict=True)])


@pytest.mark.parametrize("name", PER_LEG)
def test_rate_of_every_leg_jacobian_equals_the_automatic_derivative(robot, states, symbols, name):
    """Eq. A1-A6, corrected where they slip, against CasADi's derivatives, 100 random states: 1e-10 of the largest."""
    pose, twist = symbols
    closed, automatic = [], []
    for leg, arm in zip(leg_vectors(robot.geometry, pose), platform_arms(robot.geometry, pose), strict=True):
        value, rate = PER_LEG[name]
        closed.append(rate(jacobian_rates.moving_leg(leg, arm, twist)))
        automatic.append(ca.jtimes(value(leg, arm), pose, ca.solve(pose_rate_to_twist(pose), twist)))
    ours = evaluated([pose, twist], ca.vertcat(*closed), states.pose, states.twist)
    theirs = evaluated([pose, twist], ca.vertcat(*automatic), states.pose, states.twist)
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-10 * max(1.0, np.abs(theirs).max()))
    assert np.abs(theirs).max() > 1e-4


@pytest.mark.parametrize("slip", ["A5", "A6"])
def test_forms_as_printed_are_not_the_derivative(robot, states, symbols, slip):
    """The printed sign in eq. A5 and the printed vector in eq. A6 miss the automatic derivative by more than 0.01."""
    pose, twist = symbols
    leg, arm = leg_vectors(robot.geometry, pose)[0], platform_arms(robot.geometry, pose)[0]
    moving = jacobian_rates.moving_leg(leg, arm, twist)
    if slip == "A5":
        name, square = "J_bd", ca.dot(leg.link, leg.link)
        change = 2 * ca.horzcat(ca.SX.zeros(3, 3), ca.skew(leg.link) @ ca.skew(moving.arm_rate)) / square
    else:
        name, change = "J_bu", -ca.skew(moving.link_rate / 2) @ jacobians.link_angular_rows(leg, arm)
    value, rate = PER_LEG[name]
    automatic = ca.jtimes(value(leg, arm), pose, ca.solve(pose_rate_to_twist(pose), twist))
    printed = rate(moving) + change
    assert np.abs(evaluated([pose, twist], printed - automatic, states.pose, states.twist)).max() > 0.01


def test_bias_of_the_euler_rates_is_the_automatic_derivative(symbols, states):
    """What is left of the twist's rate without pose acceleration (eq. 38), against T_dot pose_dot (1e-10)."""
    pose, rate = symbols
    ours = evaluated([pose, rate], twist_bias(pose, rate), states.pose, states.twist)
    theirs = evaluated([pose, rate], ca.jtimes(pose_rate_to_twist(pose), pose, rate) @ rate, states.pose, states.twist)
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-10 * max(1.0, np.abs(theirs).max()))
    assert np.abs(theirs).max() > 1e-4


def test_leg_jacobians_are_the_motion_of_the_bodies(robot, legs_at, motion, numerics, symbols):
    """J_a and J_b times the twist equal the finite-difference motion of crank and link, placed by scipy (1e-9)."""
    pose, _ = symbols
    legs = leg_vectors(robot.geometry, pose)
    both = [
        (jacobians.crank_jacobian(leg, arm), jacobians.link_jacobian(leg, arm))
        for leg, arm in zip(legs, platform_arms(robot.geometry, pose), strict=True)
    ]
    function = ca.Function("bodies", [pose], [ca.vertcat(*[ca.vertcat(*pair) for pair in both])])
    for t in (0.3, 1.1):
        twist = robot.twist(motion.pose(t), motion.rate(t))
        moved = (np.array(function(motion.pose(t))) @ twist).reshape(6, 12)
        place, rate = legs_at(motion.pose(t)), {}
        for name in ("tip", "joint", "crank"):
            rate[name] = numerics.derivative(lambda d, t=t, name=name: getattr(legs_at(motion.pose(t + d)), name))
        link, link_rate = place.joint - place.tip, rate["joint"] - rate["tip"]
        spin = np.cross(link, link_rate) / np.sum(link**2, axis=1, keepdims=True)
        turn = np.cross(place.crank, rate["crank"]) / robot.geometry.crank_length**2
        expected = np.hstack([rate["crank"] / 2, turn, (rate["tip"] + rate["joint"]) / 2, spin])
        np.testing.assert_allclose(moved, expected, atol=1e-9)


def test_two_halves_of_the_loop_jacobian(robot, states, symbols):
    """diag(J_a1) J_ad = J_a2 (eq. 7 and 8)."""
    pose, _ = symbols
    leverage, link = (evaluated([pose], part, states.pose) for part in jacobians.loop_jacobians(robot.geometry, pose))
    np.testing.assert_allclose(leverage * robot.joint_jacobian(states.pose), link, atol=1e-15)


def printed_mass_matrix(geometry, pose, rigid):
    """M (6, 6) as eq. 23 prints it: the sum of J^T M_body J over platform, cranks and links, from their frames."""

    def body(frame, parameters):
        return ca.diagcat(parameters[0] * ca.SX.eye(3), frame @ ca.diag(parameters[1:4]) @ frame.T)

    def unit(vector):
        return vector / ca.norm_2(vector)

    platform, cranks, links = rigid[:4], rigid[4:28].reshape(6, 4), rigid[28:].reshape(6, 4)
    total = body(rotation_matrix(pose[3:6]), platform)
    legs = zip(leg_vectors(geometry, pose), platform_arms(geometry, pose), cranks, links, strict=True)
    for leg, arm, crank_parameters, link_parameters in legs:
        along, down = unit(leg.crank), unit(leg.link)
        across = unit(ca.cross(leg.axis, down))
        crank, link = jacobians.crank_jacobian(leg, arm), jacobians.link_jacobian(leg, arm)
        total += crank.T @ body(ca.horzcat(along, ca.cross(leg.axis, along), leg.axis), crank_parameters) @ crank
        total += link.T @ body(ca.horzcat(across, ca.cross(down, across), down), link_parameters) @ link
    return total


def test_mass_and_coriolis_matrices_from_the_named_jacobians(robot, states, symbols, identified):
    """M as eq. 23 prints it equals the one formed at the platform joints; with its automatic derivative M_dot - 2 C is
    skew-symmetric for links with Ixx = Iyy, so that C holds the rates of those Jacobians."""
    pose, twist = symbols
    values = identified[:64].copy()
    values[[30 + 4 * leg for leg in range(6)]] = values[[29 + 4 * leg for leg in range(6)]]
    printed = printed_mass_matrix(robot.geometry, pose, values[RIGID_BODY])
    mass = robot.mass_matrix(states.pose, values)
    np.testing.assert_allclose(evaluated([pose], printed, states.pose), mass, atol=1e-12)
    rate = ca.jtimes(printed, pose, ca.solve(pose_rate_to_twist(pose), twist))
    skew = evaluated([pose, twist], rate, states.pose, states.twist)
    skew -= 2 * robot.coriolis_matrix(states.pose, states.twist, values)
    np.testing.assert_allclose(skew, -skew.transpose(0, 2, 1), atol=1e-10)
