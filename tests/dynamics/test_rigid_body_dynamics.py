"""The virtual-work model: identities between its parts, and energy."""

import inspect

import numpy as np
import pytest

from dynamics import fast_forward_dynamics
from tests.dynamics.conftest import METHODS, base_from_platform, derivative, link_axes


@pytest.fixture(params=["guess", "truth"])
def parameters(request, robot):
    return robot.parameter_sets[request.param].dynamic


def test_parts_regressor_and_inverse_dynamics_agree(robot, states, parameters):
    """M twist_dot + C twist + G + friction, from the paper's 6x6 Jacobians, equals Gamma Xi and J^T
    torque, formed from the motion of the platform joints alone: two derivations of one wrench, with
    other parameters at each state. M is symmetric and positive definite; at rest there is no
    friction (sign(0) = 0)."""
    pose, twist, twist_dot = states.pose, states.twist, states.twist_dot
    parameters = parameters * np.random.default_rng(6).uniform(0.5, 2, (len(pose), 64))
    mass, coriolis = (
        robot.mass_matrix(pose, parameters),
        robot.coriolis_matrix(pose, twist, parameters),
    )
    np.testing.assert_allclose(mass, mass.transpose(0, 2, 1), atol=1e-12)
    assert np.linalg.eigvalsh(mass).min() > 0.1
    parts = (mass @ twist_dot[..., None] + coriolis @ twist[..., None])[..., 0]
    parts += robot.gravity_wrench(pose, parameters) + robot.friction_wrench(pose, twist, parameters)
    scale = np.abs(parts).max()
    by_regressor = (robot.regressor(pose, twist, twist_dot) @ parameters[..., None])[..., 0]
    np.testing.assert_allclose(by_regressor, parts, atol=1e-12 * scale)
    torque = robot.inverse_dynamics(pose, twist, twist_dot, parameters)
    wrench = (robot.joint_jacobian(pose).transpose(0, 2, 1) @ torque[..., None])[..., 0]
    np.testing.assert_allclose(wrench, parts, atol=1e-12 * scale)
    np.testing.assert_array_equal(robot.friction_wrench(pose, 0 * twist, parameters), 0)
    assert len(robot.parameter_names) == len(robot.nominal_parameters) == 64
    defaults = robot.mass_matrix(pose, robot.parameter_sets["guess"].dynamic)
    np.testing.assert_array_equal(robot.mass_matrix(pose), defaults)


def test_forward_dynamics_inverts_inverse_dynamics(robot, states, parameters):
    """forward(inverse(twist_dot)) = twist_dot to 1e-11 relative, in a batch, one by one and by the
    fast function.
    """
    pose, twist, twist_dot = states.pose, states.twist, states.twist_dot
    torque = robot.inverse_dynamics(pose, twist, twist_dot, parameters)
    back = robot.forward_dynamics(pose, twist, torque, parameters)
    np.testing.assert_allclose(back, twist_dot, atol=1e-11 * np.abs(twist_dot).max())
    fast = fast_forward_dynamics(robot, parameters)
    for row, expected in zip(zip(pose, twist, torque, strict=True), back, strict=True):
        single = robot.forward_dynamics(*row, parameters)
        np.testing.assert_allclose(single, expected, rtol=1e-12)
        np.testing.assert_array_equal(fast(*row), single)
    gains = robot.parameter_sets["guess"].joint_pid
    with_gains = fast_forward_dynamics(robot, np.concatenate([parameters, gains]))
    np.testing.assert_array_equal(with_gains(*row), single)


def test_batches_equal_single_calls(robot, states, parameters):
    """Every method gives for row n of a batch what it gives for that row alone; parameters may be a
    batch too.
    """
    given = {
        "pose": states.pose[:4],
        "parameters": parameters * np.array([[1.0], [1.1], [1.2], [1.3]]),
    }
    given |= dict.fromkeys(("twist", "pose_rate"), states.twist[:4])
    given |= dict.fromkeys(("twist_dot", "pose_acceleration", "torque"), states.twist_dot[:4])
    for name in METHODS:
        arguments = [
            given[argument] for argument in inspect.signature(getattr(robot, name)).parameters
        ]
        batch = getattr(robot, name)(*arguments)
        rows = [getattr(robot, name)(*row) for row in zip(*arguments, strict=True)]
        np.testing.assert_allclose(batch, rows, rtol=1e-13, atol=1e-13, err_msg=name)
        none = getattr(robot, name)(*[argument[:0] for argument in arguments])
        assert none.shape == (0, *batch.shape[1:]), name


def _angular_velocity(axes_at):
    """Of moving axes (..., 3, 3), columns in base axes, at time 0: (..., 3) in those axes."""
    turn = axes_at(0.0).swapaxes(-1, -2) @ derivative(axes_at)
    return np.stack([turn[..., 2, 1], turn[..., 0, 2], turn[..., 1, 0]], axis=-1)


def test_mass_matrix_gives_the_kinetic_energy_and_gravity_the_power_of_the_13_bodies(
    robot, legs_at, motion, parameters
):
    """1/2 v^T M v is the sum over platform, cranks and links, and G . v the rate of sum(m g z),
    with bodies moved by finite differences (1e-9 relative)."""
    masses = parameters[:52:4]

    def centres(pose):
        legs = legs_at(pose)
        return np.vstack([pose[:3], legs.tip - legs.crank / 2, (legs.tip + legs.joint) / 2])

    for t in (0.1, 0.5, 1.3):
        pose, rate, _ = motion(t)
        speeds = derivative(lambda d, t=t: centres(motion(t + d)[0]))
        platform = _angular_velocity(lambda d, t=t: base_from_platform(motion(t + d)[0]))
        cranks = derivative(lambda d, t=t: robot.inverse_kinematics(motion(t + d)[0]))
        links = _angular_velocity(
            lambda d, t=t: link_axes(robot.geometry, legs_at(motion(t + d)[0]))
        )
        kinetic = (
            masses @ np.sum(speeds**2, axis=1)
            + parameters[1:4] @ platform**2
            + parameters[7:28:4] @ cranks**2
        )
        kinetic += parameters[29:52:4] @ links[:, 0] ** 2 + parameters[30:52:4] @ links[:, 1] ** 2
        twist = robot.twist(pose, rate)
        np.testing.assert_allclose(
            twist @ robot.mass_matrix(pose, parameters) @ twist, kinetic, rtol=1e-9
        )
        power = -masses @ speeds @ robot.geometry.gravity
        np.testing.assert_allclose(robot.gravity_wrench(pose, parameters) @ twist, power, rtol=1e-9)


def test_links_without_spin_break_the_energy_balance_by_a_known_amount(
    robot, legs_at, motion, parameters
):
    """A link that never spins (eq. 12) but keeps its x axis normal to the crank axis is no rigid
    body if Ixx != Iyy: v^T (M_dot - 2 C) v is then 2 spin (Ixx - Iyy) omega_x omega_y, where spin
    is how fast the axes turn about z. With Ixx = Iyy in every link M_dot - 2 C is skew-symmetric.
    M_dot is taken by finite differences."""
    round_links = parameters.copy()
    round_links[30:52:4] = round_links[29:52:4]
    for t in np.linspace(0, 3, 7):
        pose, rate, _ = motion(t)
        twist = robot.twist(pose, rate)
        omega = _angular_velocity(
            lambda d, t=t: link_axes(robot.geometry, legs_at(motion(t + d)[0]))
        )
        for values in (parameters, round_links):
            mass_rate = derivative(
                lambda d, t=t, values=values: robot.mass_matrix(motion(t + d)[0], values)
            )
            skew = mass_rate - 2 * robot.coriolis_matrix(pose, twist, values)
            expected = 2 * np.sum((values[29:52:4] - values[30:52:4]) * omega.prod(axis=1))
            np.testing.assert_allclose(twist @ skew @ twist, expected, atol=2e-11)
        assert abs(twist @ skew @ twist) < 1e-11
        np.testing.assert_allclose(skew, -skew.T, atol=1e-9 * np.abs(mass_rate).max())
