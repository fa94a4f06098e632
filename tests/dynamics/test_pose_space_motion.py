"""The equation of motion that the closed loop integrates, and its derivatives leg by leg."""

import numpy as np
import pytest

from dynamics.rigid_body import equation_of_motion as model
from tests.dynamics.conftest import derivative


@pytest.fixture(scope="module")
def functions(robot):
    return {function.name(): function for function in model.motion_functions(robot.geometry)}


@pytest.fixture
def samples(robot, states):
    """(pose, rate, acceleration, torque) of a few random states."""
    rng = np.random.default_rng(2)
    scale = np.array([0.1, 0.1, 0.1, 0.5, 0.5, 0.5])
    return [
        (pose, scale * a, 10 * scale * b, 5 * c)
        for pose, (a, b, c) in zip(states.pose[:6], rng.standard_normal((6, 3, 6)), strict=True)
    ]


def _evaluate(function, *arguments):
    values = function(*arguments)
    values = values if isinstance(values, tuple) else (values,)
    arrays = [np.asarray(value, dtype=float) for value in values]
    return [array[:, 0] if array.shape[1] == 1 else array for array in arrays]


def _columns(function, h=1e-4):
    return np.column_stack([derivative(lambda d, e=e: function(d * e), h) for e in np.eye(6)])


def test_equation_of_motion_is_the_wrench_balance_in_pose_coordinates(robot, functions, samples, identified):
    """M, b, J_theta, J_theta_dot rate and theta against `Robot` (twist coordinates, 6x6 Jacobians) and differences."""
    rigid = identified[:52]
    frictionless = np.concatenate([rigid, np.zeros(12)])
    for pose, rate, acceleration, _ in samples:
        mass, bias, jacobian, drift, angle = _evaluate(functions["equation_of_motion"], pose, rate, rigid)
        to_twist = np.column_stack([robot.twist(pose, e) for e in np.eye(6)])
        np.testing.assert_allclose(mass, to_twist.T @ robot.mass_matrix(pose, frictionless) @ to_twist, atol=1e-12)
        twist, twist_dot = robot.twist(pose, rate), robot.twist_dot(pose, rate, acceleration)
        torque = robot.inverse_dynamics(pose, twist, twist_dot, frictionless)
        np.testing.assert_allclose(mass @ acceleration + bias, jacobian.T @ torque, atol=1e-10)
        np.testing.assert_allclose(jacobian, robot.pose_jacobian(pose), atol=1e-12)
        np.testing.assert_allclose(angle, robot.inverse_kinematics(pose), atol=1e-14)
        expected = derivative(lambda d, p=pose, r=rate: robot.pose_jacobian(p + d * r) @ r)
        np.testing.assert_allclose(drift, expected, atol=1e-10)


def test_motion_derivatives_are_finite_differences_of_the_residual(functions, samples, identified):
    """d(M q_ddot + b - J^T torque) and d(theta_ddot), by pose, rate and the 52 inertial parameters (1e-7 relative)."""
    rigid = identified[:52]

    def residual(pose, rate, acceleration, torque, values=rigid):
        mass, bias, jacobian, drift, _ = _evaluate(functions["equation_of_motion"], pose, rate, values)
        return np.concatenate([mass @ acceleration + bias - jacobian.T @ torque, jacobian @ acceleration + drift])

    for pose, rate, acceleration, torque in samples:
        by_pose, by_rate, columns, crank_by_pose, crank_by_rate = _evaluate(
            functions["motion_derivatives"], pose, rate, acceleration, torque, rigid
        )
        rest = (acceleration, torque)
        numeric = _columns(lambda d, p=pose, r=rate, rest=rest: residual(p + d, r, *rest))
        np.testing.assert_allclose(np.vstack([by_pose, crank_by_pose]), numeric, rtol=1e-7, atol=1e-7)
        numeric = _columns(lambda d, p=pose, r=rate, rest=rest: residual(p, r + d, *rest))
        np.testing.assert_allclose(np.vstack([by_rate, crank_by_rate]), numeric, rtol=1e-7, atol=1e-7)
        for index in range(52):
            unit = np.zeros(52)
            unit[index] = 1.0
            change = residual(pose, rate, *rest, rigid + unit) - residual(pose, rate, *rest)
            np.testing.assert_allclose(columns[:, index], change[:6], atol=1e-9)


def test_rate_map_derivative_is_the_derivative_of_the_jacobian(robot, functions, samples):
    """d(J_theta g)/d(pose) for constant g, against finite differences of `Robot.pose_jacobian`."""
    for pose, rate, _, _ in samples:
        (by_pose,) = _evaluate(functions["rate_map_derivative"], pose, rate)
        numeric = _columns(lambda d, p=pose, r=rate: robot.pose_jacobian(p + d) @ r)
        np.testing.assert_allclose(by_pose, numeric, atol=1e-8)
