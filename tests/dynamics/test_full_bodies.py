"""Bodies with ten inertial parameters: against Pinocchio, and against bodies with four."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dynamics
from dynamics.errors import ParameterError, RobotFileError
from dynamics.parameter_units import of_all_legs
from dynamics.parameters import own_passive_parameters, passive_parameters
from dynamics.pseudo_inertia import (
    about_centre,
    body_fault,
    from_log_cholesky,
    full_body,
    inertial_parameters,
    log_cholesky,
    log_cholesky_slope,
    nearest_body,
    pseudo_inertia,
)
from dynamics.rigid_body.equation_of_motion import (
    equation_of_motion,
    motion_derivatives,
    stop_derivatives,
)
from dynamics.rigid_body.passive_friction import SLOW
from tests.dynamics.conftest import MIXED, mixed_robot

SCALES = np.repeat([0.01, 0.04], 3), np.repeat([0.1, 0.5], 3), np.repeat([1.0, 5.0], 3)


def drawn_bodies(robot, rng):
    """Full bodies (bodies, 10) of masses and moments like those of a robot, off their centres by
    some millimetres, with axes of inertia in any direction.

    Links between two balls are symmetric about their length, so that they do not begin to spin.
    """
    found = []
    for own in robot.layout.bodies_of(robot.nominal_parameters):
        second = np.diag(own[4:7].mean() * rng.uniform(0.2, 0.8, 3))
        axes = Rotation.random(random_state=rng).as_matrix()
        inertia = axes @ (np.trace(second) * np.eye(3) - second) @ axes.T
        found.append(full_body(own[0] + 0.01, 0.01 * rng.standard_normal(3), inertia))
    for leg, own in zip(robot.geometry.legs, robot.layout.of_leg, strict=True):
        if leg.type in ("rss", "parallelogram", "pss"):
            mass, _, _, along, xx, _, zz, *_ = found[own[-1]]
            found[own[-1]] = np.array([mass, 0, 0, along, xx, xx, zz, 0, 0, 0])
    return np.array(found)


# Every kind of leg; the legs of a mixed robot are those of pus6, pss6 and ups6.
EVERY_KIND = [
    *("delta3", "rrr3"),
    *(pytest.param(name, marks=pytest.mark.slow) for name in ("rus6", MIXED)),
    *(pytest.param(name, marks=pytest.mark.thorough) for name in ("rss6", "pss6", "pus6", "ups6")),
]
every_kind = pytest.mark.parametrize("full", EVERY_KIND, indirect=True, scope="module")
REST = [
    pytest.param(name, marks=pytest.mark.thorough)
    for name in ("rrr3", "rus6", "pss6", "pus6", "ups6")
]
# For what adds up legs, of which test_families.py has every kind.
two_kinds = pytest.mark.parametrize(
    "full", ["delta3", "rss6", *REST], indirect=True, scope="module"
)


@pytest.fixture(scope="module")
def full(request, tmp_path_factory):
    """A robot with full bodies only and friction in all passive joints, its parameters, and 8
    states that its platform can have.
    """
    mixed = request.param == MIXED
    robot = (
        mixed_robot(tmp_path_factory.getbasetemp()) if mixed else dynamics.load_robot(request.param)
    ).with_full_bodies(["all"])
    robot = robot.with_passive_friction(passive_parameters(robot.geometry.legs))
    rng = np.random.default_rng(1)
    values = robot.nominal_parameters.copy()
    values[robot.layout.inertial] = robot.layout.rigid_of(drawn_bodies(robot, rng))
    values[robot.layout.passive] = rng.uniform(0.01, 0.1, len(robot.layout.passive_names))
    free = robot.geometry.chart.basis @ robot.geometry.chart.basis.T
    away, twist, gain = (rng.uniform(-1, 1, (8, 6)) * scale @ free for scale in SCALES)
    return robot, values, (robot.home_pose + away, twist, gain)


class ByCasadi:
    """The kinematics of a robot that is not compiled for so few questions."""

    def __init__(self, robot):
        self.home_pose = robot.home_pose
        self._joints, self._jacobian = map(robot.casadi, ("inverse_kinematics", "joint_jacobian"))

    def inverse_kinematics(self, pose):
        return self._joints(pose)[0].full().ravel()

    def joint_jacobian(self, pose):
        return self._jacobian(pose).full()


@pytest.mark.slow
@every_kind
def test_regressor_and_motion_are_those_of_pinocchios_closed_chain(full):
    """Every column to 1e-9 of its size over all states; accelerations to 1e-9 of theirs."""
    pytest.importorskip("pinocchio")
    from tests.closed_chain import ClosedChain

    robot, values, states = full
    regressor, forward, jacobian = (
        robot.casadi(name) for name in ("regressor", "forward_dynamics", "joint_jacobian")
    )
    layout, free = robot.layout, robot.geometry.chart.basis
    frictionless = np.array(values)
    frictionless[layout.inertial.stop :] = 0
    chain = ClosedChain(robot, values, moving=ByCasadi(robot))
    rest = np.zeros((2, 6))
    holding = robot.casadi("inverse_dynamics")(robot.home_pose, *rest, values).full()
    torques = (1 + 2 * np.abs(holding).max()) * np.random.default_rng(5).standard_normal(
        (len(states[0]), layout.joints)
    )
    errors, sizes = [], []
    for pose, twist, torque in zip(*states[:2], torques, strict=True):
        state = chain.state(pose, twist, torque)
        assert max(chain.closure(state)) < 1e-14
        a = chain.acceleration(state)
        theirs = chain.platform_acceleration(state, a)
        ours = forward(pose, twist, torque, frictionless).full().ravel()
        assert np.abs(ours - theirs).max() <= 1e-9 * np.abs(theirs).max()
        speeds = np.transpose([chain.state(pose, one, torque).v for one in free.T])
        columns = chain.regressor(state, a, speeds).reshape(free.shape[1], -1)
        wrenches = free.T @ regressor(pose, twist, theirs).full()
        errors.append(np.abs(wrenches[:, layout.inertial] - columns))
        sizes.append(np.abs(columns))
        torque_found = np.linalg.solve((jacobian(pose).full() @ free).T, wrenches @ frictionless)
        np.testing.assert_allclose(torque_found, torque, atol=1e-9 * np.abs(torque).max())
    worst, size = np.max(errors, axis=(0, 1)), np.max(sizes, axis=(0, 1))
    # A parameter without any effect has a column of rounding errors alone.
    assert (worst <= 1e-9 * size + 1e-13 * size.max()).all()


@pytest.mark.slow
@two_kinds
def test_mass_and_coriolis_matrix_and_equation_of_motion_are_one_dynamics(full):
    """M twist_dot + C twist + G is the wrench of the regressor; M_dot - 2 C is skew-symmetric; the
    equation of motion of the integrator has the same forces; its derivatives are differences.
    """
    robot, values, states = full
    names = "regressor", "mass_matrix", "coriolis_matrix", "gravity_wrench"
    regressor, mass, coriolis, gravity = (robot.casadi(name) for name in names)
    layout, free = robot.layout, robot.geometry.chart.basis
    inertial = values.copy()
    inertial[layout.inertial.stop :] = 0
    motion = equation_of_motion(robot.geometry).whole
    derivatives = motion_derivatives(robot.geometry).whole
    for pose, twist, gain in zip(*states, strict=True):
        wrench = regressor(pose, twist, gain).full() @ inertial
        c = coriolis(pose, twist, values).full()
        parts = mass(pose, values).full() @ gain + c @ twist
        parts = parts + gravity(pose, values).full().ravel()
        np.testing.assert_allclose(
            free.T @ parts, free.T @ wrench, atol=1e-9 * np.abs(wrench).max()
        )
        step = 1e-5
        rate = robot.casadi("mass_matrix")
        along = np.concatenate([twist[:3], _angle_rates(pose, twist[3:])])
        m_dot = (rate(pose + step * along, values) - rate(pose - step * along, values)).full()
        skew = free.T @ (m_dot / (2 * step) - 2 * c) @ free
        assert np.abs(skew + skew.T).max() < 1e-5 * np.abs(c).max()
    q = free.T @ (states[0][0] - robot.home_pose)
    speed, gain = free.T @ states[1][0], free.T @ states[2][0]
    torque, rigid = np.ones(layout.joints), values[layout.rigid]

    def balance(q, speed):
        m, b, jacobian = (part.full() for part in motion(q, speed, rigid)[:3])
        return m @ gain + b.ravel() - jacobian.T @ torque

    found = [part.full() for part in derivatives(q, speed, gain, torque, rigid)]
    for way, exact in enumerate(found[:2]):
        for k, step in enumerate(1e-6 * np.eye(len(q))):
            ends = [
                [q + sign * step, speed] if way == 0 else [q, speed + sign * step]
                for sign in (1, -1)
            ]
            slope = (balance(*ends[0]) - balance(*ends[1])) / 2e-6
            np.testing.assert_allclose(exact[:, k], slope, atol=1e-6 * np.abs(exact).max())
    linear = found[2] @ rigid - motion(q, speed, rigid)[2].full().T @ torque
    np.testing.assert_allclose(linear, balance(q, speed), atol=1e-9 * np.abs(linear).max())


def _angle_rates(pose, omega):
    """Rates of the angles for an angular velocity, by differences of rotations."""
    step = 1e-7
    turned = Rotation.from_rotvec(step * omega) * Rotation.from_euler("XYZ", pose[3:])
    return (turned.as_euler("XYZ") - pose[3:]) / step


@pytest.mark.slow
@every_kind
def test_friction_of_passive_joints_takes_the_power_of_their_relative_rotation(full):
    """With the angular velocities of the chain that Pinocchio gets: viscous c |w|^2, which as a
    quadratic form in the twist is the whole wrench; dry c |w|^2 / sqrt(|w|^2 + SLOW^2).
    """
    pytest.importorskip("pinocchio")
    from tests.closed_chain import MOTIONS, base_from_platform, crank_motions

    robot, values, (poses, twists, _) = full
    layout, free = robot.layout, robot.geometry.chart.basis @ robot.geometry.chart.basis.T
    wrench, inverse, jacobian = (
        robot.casadi(name) for name in ("friction_wrench", "inverse_kinematics", "joint_jacobian")
    )
    passive = values.copy()
    passive[: layout.inertial.stop] = passive[layout.rigid.stop :] = 0
    constants = dict(zip(layout.passive_names, values[layout.passive], strict=True))
    rng = np.random.default_rng(3)
    for pose, first in zip(poses, twists, strict=True):
        for twist in (first, *(rng.standard_normal((3, 6)) @ free)):
            theta, rates = inverse(pose)[0].full().ravel(), (jacobian(pose).full() @ twist)
            turn, power = base_from_platform(pose), 0.0
            for number, leg in enumerate(robot.geometry.legs):
                arm = turn @ leg.platform_joint
                at, moving = pose[:3] + arm, twist[:3] + np.cross(twist[3:], arm)
                motions = MOTIONS.get(leg.type, crank_motions)(
                    leg, theta[number], rates[number], at, moving
                )
                spins = [np.zeros(3), *(omega for _, omega in motions[:2]), twist[3:]]
                joints = [f"{body.name}_joint" for body in leg.bodies] + ["platform_joint"]
                bars = 2 if leg.type == "parallelogram" else 1
                for place, (joint, inner, outer) in enumerate(
                    zip(joints, spins[:-1], spins[1:], strict=True)
                ):
                    size = np.linalg.norm(outer - inner)
                    many = bars if place else 1
                    power += many * constants.get(f"{joint}.viscous", 0.0) * size**2
                    dry = constants.get(f"{joint}.coulomb", 0.0)
                    power += many * dry * size**2 / np.hypot(size, SLOW)
            ours = twist @ wrench(pose, twist, passive).full().ravel()
            np.testing.assert_allclose(ours, power, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "full", ["delta3", pytest.param("rss6", marks=pytest.mark.thorough)], indirect=True
)
def test_a_passive_joint_of_one_leg_has_its_share_of_the_friction_of_all_legs(full):
    """The friction of all legs is the sum of that of single legs, which begin with its value."""
    robot, values, (poses, twists, _) = full
    shared = robot.layout.passive_names
    own = [
        name for name in own_passive_parameters(robot.geometry.legs) if of_all_legs(name) in shared
    ]
    single = robot.with_passive_friction(own)
    assert single.layout.passive_names == tuple(own)
    converted = robot.layout.converted(values, single.layout)
    assert converted[single.layout.passive].min() > 0
    back = single.layout.converted(converted, robot.layout)
    np.testing.assert_allclose(back, values, rtol=1e-14)
    one = np.zeros((len(own), len(converted)))
    one[:, single.layout.passive] = np.diag(converted[single.layout.passive])
    alone = values.copy()
    alone[: robot.layout.inertial.stop] = alone[robot.layout.rigid.stop :] = 0
    for pose, twist in zip(poses[:3], twists[:3], strict=True):
        parts = [single.casadi("friction_wrench")(pose, twist, row).full().ravel() for row in one]
        whole = robot.casadi("friction_wrench")(pose, twist, alone).full().ravel()
        np.testing.assert_allclose(np.sum(parts, axis=0), whole, atol=1e-9 * np.abs(whole).max())
        assert all(twist @ part > 0 for part in parts)


@pytest.mark.slow
def test_a_full_body_without_first_moments_and_products_is_a_centred_body(robot, states):
    full = robot.with_full_bodies(["platform", "link3"])
    assert full.layout.full == tuple(name in ("platform", "link3") for name in robot.layout.bodies)
    assert full.with_full_bodies(()).layout == robot.layout
    values = robot.parameter_sets["truth"].dynamic
    torques = np.ones(6)
    other = full.casadi("forward_dynamics")
    for pose, twist in zip(states.pose[:20], states.twist[:20], strict=True):
        centred = robot.forward_dynamics(pose, twist, torques, values)
        found = other(pose, twist, torques, full.parameter_sets["truth"].dynamic).full().ravel()
        np.testing.assert_allclose(found, centred, rtol=1e-10)
    np.testing.assert_array_equal(
        full.layout.converted(full.parameter_sets["truth"].dynamic, robot.layout), values
    )


def test_a_body_exists_where_its_mass_can_be_made_of_points():
    """Random points with positive masses give a pseudo-inertia, the sum of their outer products."""
    rng = np.random.default_rng(2)
    for _ in range(50):
        points, masses = rng.standard_normal((6, 3)), rng.uniform(0.1, 1, 6)
        square = sum(
            m * (p @ p * np.eye(3) - np.outer(p, p)) for m, p in zip(masses, points, strict=True)
        )
        first = masses @ points
        body = np.array(
            [masses.sum(), *first, *np.diagonal(square), square[0, 1], square[0, 2], square[1, 2]]
        )
        ones = np.column_stack([points, np.ones(6)])
        np.testing.assert_allclose(
            pseudo_inertia(body), ones.T @ np.diag(masses) @ ones, atol=1e-12
        )
        np.testing.assert_allclose(inertial_parameters(pseudo_inertia(body)), body, atol=1e-12)
        np.testing.assert_allclose(from_log_cholesky(log_cholesky(body)), body, atol=1e-11)
        np.testing.assert_allclose(full_body(body[0], *about_centre(body)), body, atol=1e-12)
        at = log_cholesky(body)
        slopes = [
            (from_log_cholesky(at + step) - from_log_cholesky(at - step)) / 2e-6
            for step in 1e-6 * np.eye(10)
        ]
        np.testing.assert_allclose(log_cholesky_slope(at), np.transpose(slopes), atol=1e-7)
        assert body_fault(body) == ""
        assert np.linalg.eigvalsh(pseudo_inertia(from_log_cholesky(rng.standard_normal(10))))[0] > 0
        impossible = body + 3 * np.abs(body) * (np.arange(10) == 4 + rng.integers(3))
        assert "exceeds the sum of the others" in body_fault(impossible)
        nearest = nearest_body(impossible, 1e-6)
        assert np.linalg.eigvalsh(pseudo_inertia(nearest))[0] > 0
        np.testing.assert_allclose(nearest[:4], impossible[:4], rtol=1e-12)
        np.testing.assert_allclose(nearest_body(body, 1e-12), body, atol=1e-10)


def test_full_bodies_of_a_robot_file(load_changed):
    """Read and written; refused by name if they cannot exist or the file says that they are
    centred.
    """
    platform = "platform = { mass = 23.5, Ixx = 0.161, Iyy = 0.144, Izz = 0.337 }"
    ten = "platform = { mass = 24.0, mcz = 0.7, Ixx = 0.2, Iyy = 0.2, Izz = 0.35, Ixy = 0.01 }"
    form = {"travel_limit = ": 'inertia = { platform = "full" }\ntravel_limit = '}
    robot = load_changed(form | {platform: ten})
    assert robot.parameter_names[:5] == tuple(
        f"platform.{name}" for name in ("mass", "mcx", "mcy", "mcz", "Ixx")
    )
    np.testing.assert_array_equal(
        robot.parameter_sets["truth"].dynamic[:10], [24, 0, 0, 0.7, 0.2, 0.2, 0.35, 0.01, 0, 0]
    )
    assert robot.layout.unit("platform.mcz") == "kg m"
    with pytest.raises(
        RobotFileError,
        match=r"platform\.mcz = 0\.7, but platform is centred; .* inertia = \"full\"",
    ):
        load_changed({platform: ten})
    with pytest.raises(
        RobotFileError,
        match=r"platform cannot exist: the least principal moment about the centre of mass \[.*0\.125 *\] m is -0\.185, below 0",
    ):
        load_changed(form | {platform: ten.replace("0.7", "3.0")})
    with pytest.raises(
        RobotFileError,
        match=r"no body 'plate'; valid: all, platform, crank, link, or a body such as link6",
    ):
        load_changed({"travel_limit = ": 'inertia = { plate = "full" }\ntravel_limit = '})
    with pytest.raises(RobotFileError, match=r"crank1 cannot exist: Izz 0\.000605 > Ixx"):
        load_changed({"travel_limit = ": 'inertia = "full"\ntravel_limit = '})
    with pytest.raises(
        ParameterError, match=r"platform\.mcz = nan kg m is not allowed, must be finite$"
    ):
        robot.layout.check(np.where(np.arange(70) == 3, np.nan, robot.nominal_parameters))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "delta3",
        *(
            pytest.param(name, marks=pytest.mark.thorough)
            for name in ("rrr3", "rss6", "rus6", "pss6", "pus6", "ups6")
        ),
    ],
)
def test_full_bodies_cost_few_more_operations_than_centred_ones(name):
    """At most 1.6 times as many, in the equation of motion and in its derivatives."""
    robot = dynamics.load_robot(name)
    full = robot.with_full_bodies(["all"])
    for function in (equation_of_motion, motion_derivatives, stop_derivatives):
        ours, theirs = (function(one.geometry).whole.n_instructions() for one in (full, robot))
        assert ours <= 1.6 * theirs, function.__name__
