"""Every kind of leg and every built-in robot, and one that mixes legs: against Pinocchio, and
consistent in itself.
"""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import dynamics
from dynamics.closed_loop import (
    FrameTiming,
    LoopSettings,
    Reference,
    ServoGains,
    differentiate_servo,
    simulate_servo,
    stability,
)
from dynamics.errors import RobotFileError
from dynamics.inertia import travel_states
from dynamics.legs import KINDS
from dynamics.legs.leg import Leg
from dynamics.robot_functions import CASADI
from dynamics.workspace import check_motion
from tests.dynamics.conftest import MIXED, SLOW_ROBOTS, Loop, States, derivative, mixed_robot

BOX = np.repeat([0.010, 0.040], 3)
FULL_BOX = np.repeat([0.015, 0.050], 3)
SCALES = BOX, np.repeat([0.1, 0.5], 3), np.repeat([1.0, 5.0], 3)  # of pose, twist and twist rate

SERVO = ServoGains(0.3, 0.001, 2.4)  # of the paper
# For what is made of the equations of all legs in the same way.
FEW = ("delta3", "rss6", "ups6")
few_robots = pytest.mark.parametrize(
    "robot",
    [
        name if name in FEW else pytest.param(name, marks=pytest.mark.thorough)
        for name in (*dynamics.built_in_robots(), MIXED)
    ],
    indirect=True,
    scope="module",
)


@pytest.fixture(
    scope="module", params=[*SLOW_ROBOTS, pytest.param(MIXED, marks=pytest.mark.thorough)]
)
def robot(request, tmp_path_factory):
    if request.param == MIXED:
        return mixed_robot(tmp_path_factory.getbasetemp())
    return dynamics.load_robot(request.param)


@pytest.fixture(scope="module")
def values(robot):
    """All parameters: those that play the truth, with other numbers in every body than its file
    has.
    """
    found = robot.parameter_sets.get("truth", robot.parameter_sets["guess"]).vector.copy()
    found[robot.layout.rigid] *= np.random.default_rng(3).uniform(0.7, 1.4, robot.layout.rigid.stop)
    return found


@pytest.fixture(scope="module")
def states(robot):
    """200 random poses in the box, twists and twist rates, as far as the platform can have them."""
    rng, free = np.random.default_rng(8), robot.geometry.chart.basis @ robot.geometry.chart.basis.T
    drawn = [rng.uniform(-1, 1, (200, 6)), *rng.standard_normal((2, 200, 6))]
    away, twist, twist_dot = (
        part * scale @ free for part, scale in zip(drawn, SCALES, strict=True)
    )
    return States(robot.home_pose + away, twist, twist_dot)


def test_forward_dynamics_agrees_with_pinocchios_closed_chain(robot, values, states):
    """twist_dot of 60 random states, torques and bodies to 1e-9 of its size; friction enters as
    joint torque.
    """
    pytest.importorskip("pinocchio")
    from tests.closed_chain import ClosedChain

    own, layout = values[robot.layout.dynamic], robot.layout
    chain, rng = ClosedChain(robot, own), np.random.default_rng(5)
    largest = 1 + np.abs(robot.static_torque(robot.home_pose, own)).max()
    poses, twists = states.pose[:60], states.twist[:60]
    torques = 2 * largest * rng.standard_normal((60, layout.joints))
    ours = robot.forward_dynamics(poses, twists, torques, own)
    for pose, twist, torque, acceleration in zip(poses, twists, torques, ours, strict=True):
        rate = robot.joint_jacobian(pose) @ twist
        state = chain.state(
            pose, twist, torque - own[layout.coulomb] * np.sign(rate) - own[layout.viscous] * rate
        )
        gap, speed = chain.closure(state)
        assert gap < 1e-14
        assert speed < 1e-14
        theirs = chain.twist_dot(state)
        assert np.abs(acceleration - theirs).max() <= 1e-9 * np.abs(theirs).max()


def test_parts_regressor_and_both_dynamics_agree(robot, values, states):
    """M twist_dot + C twist + G + friction is Gamma Xi; where the platform can move, J^T torque;
    and forward dynamics inverts inverse dynamics. M is symmetric and positive definite for what the
    platform can do."""
    (pose, twist, twist_dot), own = (
        (states.pose, states.twist, states.twist_dot),
        values[robot.layout.dynamic],
    )
    free, mass = robot.geometry.chart.basis, robot.mass_matrix(states.pose, own)
    np.testing.assert_allclose(mass, mass.transpose(0, 2, 1), atol=1e-12)
    assert np.linalg.eigvalsh(free.T @ mass @ free).min() > 0.1
    parts = (
        mass @ twist_dot[..., None] + robot.coriolis_matrix(pose, twist, own) @ twist[..., None]
    )[..., 0]
    parts += robot.gravity_wrench(pose, own) + robot.friction_wrench(pose, twist, own)
    scale = np.abs(parts).max()
    np.testing.assert_allclose(
        (robot.regressor(pose, twist, twist_dot) @ own), parts, atol=1e-12 * scale
    )
    torque = robot.inverse_dynamics(pose, twist, twist_dot, own)
    wrench = (robot.joint_jacobian(pose).transpose(0, 2, 1) @ torque[..., None])[..., 0]
    np.testing.assert_allclose(wrench @ free, parts @ free, atol=1e-12 * scale)
    back = robot.forward_dynamics(pose, twist, torque, own)
    np.testing.assert_allclose(back, twist_dot, atol=1e-11 * np.abs(twist_dot).max())


def test_forward_kinematics_inverts_inverse_kinematics(robot, states):
    """Quadratically from home: within a few steps."""
    found = robot.solve_forward_kinematics(robot.inverse_kinematics(states.pose))
    np.testing.assert_allclose(found.pose, states.pose, atol=1e-11)
    assert found.converged.all()
    assert found.residual.max() < 1e-12
    assert 2 <= found.iterations.max() <= 8


def test_joint_rates_and_accelerations_are_derivatives_of_joint_coordinates(robot, values):
    """Along a smooth motion, by finite differences: J_theta, its rate, and d(J_theta g)/dq."""
    free, rng = robot.geometry.chart.basis, np.random.default_rng(2)
    m, rigid = free.shape[1], values[robot.layout.rigid][None]
    amplitude, frequency, phase = 0.5 * BOX @ free, rng.uniform(1, 2, m), rng.uniform(0, 6, m)
    home, fixed = robot.coordinates(robot.home_pose), rng.standard_normal((1, m))

    def motion(t):
        wave = amplitude * np.exp(1j * (frequency * t + phase))
        q, rate = home + wave.imag, (frequency * wave).real
        return robot.functions["equation_of_motion"](q[None], rate[None], rigid)

    def along(direction):
        return lambda s: robot.coordinate_jacobian(robot.pose(home + s * direction)) @ fixed[0]

    wave = amplitude * np.exp(1j * phase)
    rate, gain = (frequency * wave).real, -(frequency**2 * wave).imag
    jacobian, bend = motion(0.0)[2][0], motion(0.0)[3][0, :, 0]
    rates = derivative(lambda t: motion(t)[4][0, :, 0])
    np.testing.assert_allclose(jacobian @ rate, rates, atol=1e-9 * np.abs(rates).max())
    speed = derivative(
        lambda t: motion(t)[2][0] @ (frequency * amplitude * np.cos(frequency * t + phase))
    )
    np.testing.assert_allclose(jacobian @ gain + bend, speed, atol=1e-9 * np.abs(speed).max())
    ours = robot.functions["rate_map_derivative"](home[None], fixed)[0][0]
    numeric = np.column_stack([derivative(along(unit)) for unit in np.eye(m)])
    np.testing.assert_allclose(ours, numeric, atol=1e-8 * np.abs(ours).max())


@few_robots
def test_sensitivities_of_a_run_are_its_finite_differences(robot, values):
    """By every parameter to 1e-6 of the largest, over 40 frames with stick and slip; what has no
    effect has none.
    """
    free, names, unit = robot.geometry.chart.basis, robot.layout.names, np.eye(len(values))
    given = Loop(robot, values).reference(40)
    away, rates = ((part @ free) @ free.T for part in (given.poses - robot.home_pose, given.rates))
    reference, settings = (
        Reference(robot.home_pose + away, rates),
        LoopSettings(SERVO, FrameTiming(60.0)),
    )
    base = differentiate_servo(robot, values, reference, settings)

    def miss(index, movement):
        ours = base.pose_sensitivity[:, :, index]
        step = min(movement / np.abs(ours).max(), 0.4 * abs(values[index]))
        runs = {
            n: simulate_servo(robot, values + n * step * unit[index], reference, settings)
            for n in (-2, -1, 1, 2)
        }
        # the poses have a kink where another event comes in
        same = len({run.events for run in runs.values()}) == 1
        first, second = (runs[n].pose - runs[-n].pose for n in (1, 2))
        return (
            np.abs(ours - (8 * first - second) / (12 * step)).max() / np.abs(ours).max()
            if same
            else np.inf
        )

    assert base.events > 1
    for index, name in enumerate(names):
        if np.abs(base.pose_sensitivity[:, :, index]).max() * values[index] > 1e-14:
            assert any(miss(index, movement) <= 1e-6 for movement in (1e-7, 1e-8, 1e-9)), name
        else:
            other = simulate_servo(robot, values * (1 + 0.4 * unit[index]), reference, settings)
            np.testing.assert_allclose(other.pose, base.pose, atol=1e-13, err_msg=name)


def test_joint_coordinates_are_nan_exactly_where_a_leg_cannot_reach(robot):
    rng, m = np.random.default_rng(6), len(robot.coordinate_names)
    away = rng.uniform(-1, 1, (500, m)) * (np.repeat([0.25, 0.5], 3) @ robot.geometry.chart.basis)
    poses = robot.pose(robot.coordinates(robot.home_pose) + away)
    coordinates, reach = robot.functions["inverse_kinematics"](poses)
    np.testing.assert_array_equal(np.isnan(coordinates), ~(reach > 0))
    assert (reach <= 1).all()
    assert 50 < (reach > 0).sum() < reach.size - 50


@pytest.mark.parametrize("count", [4, 10], ids=["centred", "full"])
@pytest.mark.parametrize("kind", KINDS)
def test_forces_mass_and_coriolis_of_a_leg_are_one_virtual_work(kind, count):
    """Closed forms are those of `Leg` to 1e-12 where the leg can move; the force at rest, mass
    acceleration and C velocity add up to the force."""
    name = {"rss": "rss6", "parallelogram": "delta3", "rrr": "rrr3"}.get(kind, f"{kind}6")
    robot, rng = dynamics.load_robot(name), np.random.default_rng(4)
    leg, at_home = robot.geometry.legs[1], robot.geometry.joints_at(robot.home_pose)[1]
    symbols = [ca.SX.sym(label, 3) for label in ("position", "velocity", "acceleration")]
    own, gravity = [ca.SX.sym("rigid", count) for _ in range(2)], ca.DM([0.4, -0.3, -9.81])
    at, moving, _ = symbols
    outputs = [
        *(leg.force(*symbols, own, gravity), Leg.force(leg, *symbols, own, gravity)),
        *(leg.mass(at, own), Leg.mass(leg, at, own), leg.coriolis(at, moving, own)),
        leg.force(at, 0 * moving, 0 * moving, own, gravity),
    ]
    function = ca.Function("leg", [*symbols, *own], outputs)
    planar = np.array([1, 1, leg.chart != "planar"])
    for _ in range(50):
        position = at_home + 0.02 * planar * rng.standard_normal(3)
        velocity, acceleration = planar * rng.standard_normal((2, 3))
        found = function(position, velocity, acceleration, *rng.uniform(0.1, 1, (2, count)))
        force, by_work, mass, mass_by_work, coriolis, holding = (np.array(value) for value in found)
        grown = holding[:, 0] + mass @ acceleration + coriolis @ velocity
        ours, other, of_parts = (planar * part for part in (force[:, 0], by_work[:, 0], grown))
        np.testing.assert_allclose(ours, other, atol=1e-12 * np.abs(ours).max())
        np.testing.assert_allclose(ours, of_parts, atol=1e-12 * np.abs(ours).max())
        within = np.outer(planar, planar)
        np.testing.assert_allclose(
            within * mass, within * mass_by_work, atol=1e-12 * np.abs(mass).max()
        )


@pytest.mark.parametrize("name", SLOW_ROBOTS)
def test_built_in_loops_are_stable_at_60_hz_and_at_29_hz_with_a_frame_of_latency(name):
    """With 1.5 times the paper's servo gains; rss6 has the paper's figures, which are only just
    stable or are not.
    """
    robot = dynamics.load_robot(name)
    for which, values in robot.parameter_sets.items():
        for timing in (FrameTiming(60.0), FrameTiming(29.0, 1 / 29)):
            gain = 1.0 if name == "rss6" else 1.5
            servo = ServoGains(gain * SERVO.kp, gain * SERVO.kd, gain * SERVO.ki)
            radius = stability.spectral_radius(
                robot, values.vector, LoopSettings(servo, timing), robot.home_pose
            )
            assert (radius < 1) == ((name, which) != ("rss6", "guess")), (which, timing)


@pytest.mark.parametrize(
    "name", [name for name in SLOW_ROBOTS if "rss6" not in getattr(name, "values", ())]
)
def test_built_in_robots_reach_a_box_about_home_within_all_limits(name):
    """+-15 mm and +-50 mrad in all coordinates at once; within the travel they reach all and are
    nowhere singular.
    """
    robot = dynamics.load_robot(name)
    m = len(robot.coordinate_names)
    corners = np.array(np.meshgrid(*[[-1.0, 0.0, 1.0]] * m)).reshape(m, -1).T * (
        FULL_BOX @ robot.geometry.chart.basis
    )
    extremes = check_motion(robot, robot.pose(robot.coordinates(robot.home_pose) + corners))
    assert extremes.reach.value > 0.1
    check_motion(robot, travel_states(robot, robot.nominal_parameters)[0])
    np.testing.assert_allclose(robot.inverse_kinematics(robot.home_pose), 0, atol=1e-7)


@pytest.mark.parametrize(
    ("name", "moved"), [("ups6", "joint_axis"), ("pus6", "joint_axis"), ("pss6", "base_joint")]
)
def test_a_leg_whose_link_lies_along_an_axis_at_home_is_refused(name, moved):
    """Of a universal joint; or, where it may not spin, of the slider that its moments are counted
    from.
    """
    geometry = dynamics.load_robot(name).geometry
    leg, joint = geometry.legs[2], geometry.joints_at(geometry.home_pose)[2]
    along = (joint - leg.base_joint) / np.linalg.norm(joint - leg.base_joint)
    value = along if moved == "joint_axis" else joint - leg.link_length * leg.slider_axis
    legs = (*geometry.legs[:2], leg.model_copy(update={moved: value}), *geometry.legs[3:])
    with pytest.raises(
        RobotFileError, match=r"leg 3 is singular at the home pose: its \w+ turns by .* rad/m"
    ):
        replace(geometry, legs=legs)


@pytest.mark.slow
@few_robots
def test_casadi_functions_are_the_compiled_ones_and_name_what_they_take(robot, values):
    """At random states, to 1e-12 of the largest entry; derivatives of a function exist."""
    rng = np.random.default_rng(5)
    basis, n = robot.geometry.chart.basis, robot.layout.joints
    free = basis @ basis.T
    pose = robot.home_pose + free @ (BOX * rng.uniform(-1, 1, 6))
    twist, twist_dot = rng.standard_normal((2, 6)) @ free
    given = {"pose": pose, "twist": twist, "twist_dot": twist_dot}
    given |= {"torque": rng.standard_normal(n), "parameters": values[robot.layout.dynamic]}
    for name in CASADI:
        function = robot.casadi(name)
        arguments = [given[one] for one in function.name_in()]
        expected = getattr(robot, name)(*arguments)
        found = function.call(arguments)[0].full().reshape(expected.shape)
        miss = np.abs(found - expected).max()
        assert miss <= 1e-12 * max(1.0, np.abs(expected).max()), name
    by_pose = robot.casadi("inverse_kinematics").factory("by_pose", ["pose"], ["jac:theta:pose"])
    assert np.allclose(by_pose(pose).full(), robot.pose_jacobian(pose), rtol=0, atol=1e-10)
    with pytest.raises(dynamics.DynamicsError, match="unknown CasADi function `mass`; valid: inv"):
        robot.casadi("mass")
