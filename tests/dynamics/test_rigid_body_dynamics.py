"""The virtual-work model: identities between its parts, and energy."""

import numpy as np
import pytest

from tests.dynamics.conftest import base_from_platform, derivative

LINK_INERTIA = [4 + 24 + 4 * leg + 1 for leg in range(6)]  # index of link Ixx; Iyy follows


@pytest.fixture(params=["initial", "identified"])
def parameters(request, robot):
    return robot.parameter_sets[request.param].dynamic


@pytest.fixture
def round_links(robot):
    """Table 2 with Ixx = Iyy in every link, so that the missing spin of the link's axes does not matter."""
    values = robot.parameter_sets["identified"].dynamic.copy()
    for index in LINK_INERTIA:
        values[index + 1] = values[index]
    return values


def test_mass_matrix_is_symmetric_and_positive_definite(robot, states, parameters):
    """At 100 random poses, with both parameter sets of the paper."""
    mass = robot.mass_matrix(states.pose, parameters)
    np.testing.assert_allclose(mass, mass.transpose(0, 2, 1), atol=1e-12)
    assert np.linalg.eigvalsh(mass).min() > 0.1
    assert len(robot.parameter_names) == len(robot.nominal_parameters) == 64
    np.testing.assert_array_equal(
        robot.mass_matrix(states.pose), robot.mass_matrix(states.pose, robot.parameter_sets["initial"].dynamic)
    )


def test_parts_regressor_and_inverse_dynamics_agree(robot, states, parameters):
    """M twist_dot + C twist + G + friction, from the paper's 6x6 Jacobians, equals Gamma Xi and J^T torque, formed
    from the motion of the platform joints alone: two derivations of one wrench."""
    pose, twist, twist_dot = states.pose, states.twist, states.twist_dot
    mass, coriolis = robot.mass_matrix(pose, parameters), robot.coriolis_matrix(pose, twist, parameters)
    parts = (mass @ twist_dot[..., None] + coriolis @ twist[..., None])[..., 0]
    parts += robot.gravity_wrench(pose, parameters) + robot.friction_wrench(pose, twist, parameters)
    scale = np.abs(parts).max()
    np.testing.assert_allclose(robot.regressor(pose, twist, twist_dot) @ parameters, parts, atol=1e-12 * scale)
    torque = robot.inverse_dynamics(pose, twist, twist_dot, parameters)
    wrench = (robot.joint_jacobian(pose).transpose(0, 2, 1) @ torque[..., None])[..., 0]
    np.testing.assert_allclose(wrench, parts, atol=1e-12 * scale)


def test_forward_dynamics_inverts_inverse_dynamics(robot, states, parameters):
    """forward(inverse(twist_dot)) = twist_dot to 1e-11 relative, in a batch and one by one."""
    pose, twist, twist_dot = states.pose, states.twist, states.twist_dot
    torque = robot.inverse_dynamics(pose, twist, twist_dot, parameters)
    back = robot.forward_dynamics(pose, twist, torque, parameters)
    np.testing.assert_allclose(back, twist_dot, atol=1e-11 * np.abs(twist_dot).max())
    single = robot.forward_dynamics(pose[3], twist[3], torque[3], parameters)
    np.testing.assert_allclose(single, back[3], rtol=1e-12)


def test_batches_equal_single_calls(robot, states, parameters):
    """Every method gives for row n of a batch what it gives for that row alone; parameters may be a batch too."""
    pose, twist, twist_dot = states.pose[:4], states.twist[:4], states.twist_dot[:4]
    sets = parameters * np.array([[1.0], [1.1], [1.2], [1.3]])
    calls = {
        "inverse_kinematics": (pose,),
        "joint_jacobian": (pose,),
        "pose_jacobian": (pose,),
        "mass_matrix": (pose, sets),
        "coriolis_matrix": (pose, twist, sets),
        "gravity_wrench": (pose, sets),
        "friction_wrench": (pose, twist, sets),
        "regressor": (pose, twist, twist_dot),
        "inverse_dynamics": (pose, twist, twist_dot, sets),
        "forward_dynamics": (pose, twist, twist_dot, sets),
    }
    for name, arguments in calls.items():
        batch = getattr(robot, name)(*arguments)
        rows = [getattr(robot, name)(*row) for row in zip(*arguments, strict=True)]
        np.testing.assert_allclose(batch, rows, rtol=1e-13, atol=1e-13, err_msg=name)
        none = getattr(robot, name)(*[argument[:0] for argument in arguments])
        assert none.shape == (0, *batch.shape[1:]), name


def _energies(robot, legs_at, pose_at, values):
    """Kinetic energy at t = 0 and height energy, body by body, from numerically differentiated centres and axes."""
    gravity = -robot.geometry.gravity

    def body(index, centre):
        mass = values[4 * index]
        speed = derivative(centre)
        return mass * speed @ speed / 2, mass * gravity @ centre(0.0)

    kinetic, height = body(0, lambda t: pose_at(t)[:3])
    turn = base_from_platform(pose_at(0.0)).T @ derivative(lambda t: base_from_platform(pose_at(t)))
    omega = np.array([turn[2, 1], turn[0, 2], turn[1, 0]])
    kinetic += omega @ (values[1:4] * omega) / 2
    theta_dot = derivative(lambda t: robot.inverse_kinematics(pose_at(t)))
    for leg in range(6):
        crank = body(1 + leg, lambda t, leg=leg: (lambda p: p.tip[leg] - p.crank[leg] / 2)(legs_at(pose_at(t))))
        link = body(7 + leg, lambda t, leg=leg: (lambda p: (p.tip[leg] + p.joint[leg]) / 2)(legs_at(pose_at(t))))
        kinetic += crank[0] + link[0] + values[4 * (1 + leg) + 3] * theta_dot[leg] ** 2 / 2
        height += crank[1] + link[1]
        along = lambda t, leg=leg: (lambda p: p.joint[leg] - p.tip[leg])(legs_at(pose_at(t)))  # noqa: E731
        l = along(0.0)
        spin = np.cross(l, derivative(along)) / (l @ l)
        x = np.cross(robot.geometry.crank_axes[leg], l)
        x /= np.linalg.norm(x)
        y = np.cross(l, x) / np.linalg.norm(l)
        inertia = values[4 * (7 + leg) + 1 : 4 * (7 + leg) + 3]
        kinetic += inertia @ np.array([spin @ x, spin @ y]) ** 2 / 2
    return kinetic, height


def test_mass_matrix_gives_the_kinetic_energy_of_the_13_bodies(robot, legs_at, motion, parameters):
    """1/2 v^T M v equals the sum over platform, cranks and links, moved by finite differences (1e-9 relative)."""
    for t in (0.1, 0.5, 1.3):
        kinetic, _ = _energies(robot, legs_at, lambda d, t=t: motion.pose(t + d), parameters)
        twist = robot.twist(motion.pose(t), motion.rate(t))
        mass = robot.mass_matrix(motion.pose(t), parameters)
        np.testing.assert_allclose(twist @ mass @ twist / 2, kinetic, rtol=1e-9)


def test_gravity_wrench_is_the_gradient_of_the_height_energy(robot, legs_at, motion, parameters):
    """G . v equals the rate of sum(m g z) over the 13 bodies, differentiated numerically."""
    for t in (0.1, 0.5, 1.3):
        power = derivative(
            lambda d, t=t: np.array(_energies(robot, legs_at, lambda e: motion.pose(t + d), parameters)[1])
        )
        twist = robot.twist(motion.pose(t), motion.rate(t))
        np.testing.assert_allclose(robot.gravity_wrench(motion.pose(t), parameters) @ twist, power, rtol=1e-9)


def _mass_rate(robot, motion, t, values):
    return derivative(lambda d: robot.mass_matrix(motion.pose(t + d), values))


def test_mass_rate_less_twice_coriolis_is_skew(robot, motion, round_links):
    """M_dot - 2 C is skew-symmetric, M_dot by finite differences; so is its quadratic form zero."""
    for t in np.linspace(0, 3, 7):
        twist = robot.twist(motion.pose(t), motion.rate(t))
        rate = _mass_rate(robot, motion, t, round_links)
        skew = rate - 2 * robot.coriolis_matrix(motion.pose(t), twist, round_links)
        assert abs(twist @ skew @ twist) < 1e-11
        np.testing.assert_allclose(skew, -skew.T, atol=1e-9 * np.abs(rate).max())


def test_links_without_spin_break_the_energy_balance_by_a_known_amount(robot, legs_at, motion, parameters):
    """A link that never spins (eq. 12) but keeps its x axis normal to the crank axis is no rigid body if Ixx != Iyy:
    v^T (M_dot - 2 C) v is then 2 spin (Ixx - Iyy) omega_x omega_y, where spin is how fast the axes turn about z."""
    for t in (0.2, 0.9):
        pose, twist = motion.pose(t), robot.twist(motion.pose(t), motion.rate(t))
        skew = _mass_rate(robot, motion, t, parameters) - 2 * robot.coriolis_matrix(pose, twist, parameters)
        expected = 0.0
        for leg in range(6):

            def axes(d, leg=leg, t=t):
                place = legs_at(motion.pose(t + d))
                z = (place.joint[leg] - place.tip[leg]) / robot.geometry.link_length
                x = np.cross(robot.geometry.crank_axes[leg], z)
                x /= np.linalg.norm(x)
                return np.column_stack([x, np.cross(z, x), z])

            turn = axes(0.0).T @ derivative(axes)
            omega_x, omega_y, spin = turn[2, 1], turn[0, 2], turn[1, 0]
            ixx, iyy = parameters[LINK_INERTIA[leg]], parameters[LINK_INERTIA[leg] + 1]
            expected += 2 * spin * (ixx - iyy) * omega_x * omega_y
        np.testing.assert_allclose(twist @ skew @ twist, expected, atol=2e-11)


def test_friction_follows_the_joint_velocity(robot, states, parameters):
    """Friction power is the sum of f_c |theta_dot| + f_v theta_dot^2, and friction vanishes at rest (sign(0) = 0)."""
    theta_dot = (robot.joint_jacobian(states.pose) @ states.twist[..., None])[..., 0]
    power = np.sum(robot.friction_wrench(states.pose, states.twist, parameters) * states.twist, axis=1)
    expected = np.abs(theta_dot) @ parameters[52:58] + theta_dot**2 @ parameters[58:64]
    np.testing.assert_allclose(power, expected, rtol=1e-11, atol=1e-13)
    np.testing.assert_array_equal(robot.friction_wrench(states.pose, 0 * states.twist, parameters), 0)


def test_wrench_is_linear_in_the_parameters(robot, states):
    """Each column of the regressor is the wrench of one parameter alone: J^T times the torque of a unit change."""
    pose, twist, twist_dot = states.pose[0], states.twist[0], states.twist_dot[0]
    base = robot.nominal_parameters
    regressor, jacobian = robot.regressor(pose, twist, twist_dot), robot.joint_jacobian(pose)
    for index in range(64):
        more = base.copy()
        more[index] += 1.0
        change = robot.inverse_dynamics(pose, twist, twist_dot, more) - robot.inverse_dynamics(pose, twist, twist_dot)
        np.testing.assert_allclose(jacobian.T @ change, regressor[:, index], atol=1e-10)
