"""Gains of each joint: the loop against linear control theory and MuJoCo, and its derivatives."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal

import dynamics
from dynamics import Robot, closed_loop
from dynamics.closed_loop import Drives, FrameTiming, LoopSettings, ServoGains, stability
from dynamics.closed_loop.drives import JointLaw, gain_columns, joint_law
from dynamics.control.feedforward import feedforward
from dynamics.engines.mjcf import mjcf_text
from dynamics.engines.mjcf_import import robot_of_mjcf
from dynamics.errors import RobotFileError, SimulationError
from dynamics.parameter_set import ParameterSet
from dynamics.robot_file import RobotDescription, parsed_robot
from dynamics.robot_text import robot_text
from identify.verification.against_mujoco import compare_engines
from tests.dynamics.conftest import Loop, assert_same, at_rest
from tests.dynamics.test_control import FAST, NOISE, follow, size
from tests.dynamics.test_sensitivities import _assert_derivative

SHARES = np.array([[1.0, 0.9, 1.1], [1.1, 1.2, 0.9], [0.85, 1.0, 1.2]])


def unequal(robot: Robot) -> np.ndarray:
    """Identified parameters with gains that differ by some 10 % between the joints."""
    own = robot.with_own_gains()
    values = own.parameter_sets["truth"].vector.copy()
    shares = np.tile(SHARES, (own.layout.joints // len(SHARES), 1))
    values[own.layout.joint_pid] *= shares.ravel()
    return values


@pytest.fixture(scope="module")
def own(robot) -> Loop:
    """Loop of the reference robot with unequal gains."""
    return Loop(robot.with_own_gains(), unequal(robot))


def test_the_layout_has_the_gains_of_one_joint_after_another(robot):
    own = robot.with_own_gains()
    assert own.layout.joint_pid_names[:4] == ("joint1.lp", "joint1.li", "joint1.ld", "joint2.lp")
    assert len(own.layout.names) == 64 + 18
    assert own.layout.unit("joint2.li") == "N m/(rad s)"
    shared = robot.parameter_sets["guess"].joint_pid
    np.testing.assert_array_equal(own.parameter_sets["guess"].joint_pid, np.tile(shared, 6))
    back = own.with_own_gains(False)
    assert back.layout == robot.layout
    np.testing.assert_array_equal(back.parameter_sets["guess"].joint_pid, shared)
    assert own.with_own_gains() is own
    assert own.geometry != robot.geometry
    assert own.geometry.digest == robot.geometry.digest


def test_gains_that_become_shared_are_the_mean_of_all_joints(robot):
    own = robot.with_own_gains().with_parameters(unequal(robot))
    shared = own.with_own_gains(False).parameter_sets["guess"].joint_pid
    each = unequal(robot)[own.layout.joint_pid].reshape(6, 3)
    np.testing.assert_allclose(shared, each.mean(axis=0), rtol=1e-15)


@pytest.mark.parametrize("law", ["pid", "cascade"])
def test_equal_gains_of_each_joint_are_shared_gains_to_the_bit(loop, law):
    """All that the run records. The derivatives by the gains of all joints sum to the shared ones."""
    own = Loop(
        loop.robot.with_own_gains(),
        np.append(loop.parameters[:64], np.tile(loop.parameters[64:], 6)),
    )
    drives = Drives(law=law, torque_limit=3.4)
    settings = loop.settings(drives=drives)
    each, shared = (one.run(45, settings, sensitivities=True) for one in (own, loop))
    for name in ("pose", "torque", "command", "joint_integral"):
        np.testing.assert_array_equal(getattr(each, name), getattr(shared, name))
    np.testing.assert_allclose(
        each.pose_sensitivity[..., :64], shared.pose_sensitivity[..., :64], rtol=0, atol=1e-15
    )
    summed = each.pose_sensitivity[..., 64:].reshape(45, 6, 6, 3).sum(axis=2)
    np.testing.assert_allclose(summed, shared.pose_sensitivity[..., 64:], rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize("case", ["pid", "pi", "cascade", "limited cascade"])
def test_sensitivities_are_finite_differences_of_the_run(own, case):
    """Of gains of the first, a middle and the last joint, under logged commands."""
    law = case.removeprefix("limited ")
    drives = Drives(law=law, torque_limit=None if law == case else 3.3)
    settings = own.settings(latency_s=0.7 / 60, drives=drives)
    reference = own.reference(45, scale=2.0)
    commands = own.run(reference, settings).command

    def run(values, sensitivities=False):
        return own.run(reference, settings, values, sensitivities=sensitivities, commands=commands)

    base = run(own.parameters, sensitivities=True)
    for joint in (0, 2, 5):
        for kind in range(3):
            index = 64 + 3 * joint + kind
            ours = base.pose_sensitivity[:, :, index]
            if not drives.joint_law(np.ones(3)).reads[kind]:
                assert not ours.any()
                continue
            _assert_derivative(run, own.parameters, index, ours, 1e-5 if law != case else 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("law", ["pd", "cascade"])
def test_compiled_and_plain_runs_agree(own, law):
    settings = own.settings(latency_s=0.01, drives=Drives(law=law, torque_limit=4.0))
    assert_same(*own.both(own.reference(4), settings, sensitivities=True))


def test_repeats_are_single_runs_of_unequal_gains(own):
    noises = 1e-5 * np.random.default_rng(0).standard_normal((3, 20, 6))
    given = own.robot, own.parameters, own.reference(20), own.settings()
    together = closed_loop.repeat_servo(*given, noises)
    for noise, run in zip(noises, together, strict=True):
        np.testing.assert_allclose(run.pose, own.run(20, noise=noise).pose, rtol=0, atol=1e-12)


def linear_loop(robot: Robot, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Matrices of the loop near home, by differences of the robot's methods.

    The state has coordinates, rates and integrals. The inputs are the commands and their rates.
    """
    home, dynamic = robot.home_pose, values[robot.layout.dynamic]
    lp, li, ld = values[robot.layout.joint_pid].reshape(-1, 3).T
    viscous = values[robot.layout.viscous]
    free = robot.geometry.chart.basis
    jacobian = robot.coordinate_jacobian(home)
    joints, size = jacobian.shape
    holding = robot.static_torque(home, dynamic)

    def unbalanced(pose: np.ndarray) -> np.ndarray:
        """Generalised force that the torques of home do not hold."""
        torque = robot.static_torque(pose, dynamic) - holding
        return robot.coordinate_jacobian(pose).T @ torque

    step = 1e-5
    stiffness = np.stack(
        [
            (unbalanced(home + step * one) - unbalanced(home - step * one)) / (2 * step)
            for one in free.T
        ],
        axis=1,
    )
    mass = free.T @ robot.mass_matrix(home, dynamic) @ free
    push = np.linalg.solve(mass, jacobian.T)
    system = np.block(
        [
            [np.zeros((size, size)), np.eye(size), np.zeros((size, joints))],
            [
                -np.linalg.solve(mass, stiffness) - push * lp @ jacobian,
                -push * (ld + viscous) @ jacobian,
                push * li,
            ],
            [-jacobian, np.zeros((joints, size)), np.zeros((joints, joints))],
        ]
    )
    none = np.zeros((size, joints))
    by_command = np.vstack([none, push * lp, np.eye(joints)])
    by_rate = np.vstack([none, push * ld, np.zeros((joints, joints))])
    return system, np.hstack([by_command, by_rate])


@pytest.mark.parametrize("name", ["rrr3", "ups6"])
def test_small_motion_is_that_of_the_linear_loop_of_scipy(name):
    """A step of the commands of all joints, small enough, against `scipy.signal.lsim`."""
    robot = dynamics.load_robot(name).with_own_gains()
    values = unequal(robot)
    values[robot.layout.coulomb] = 0.0
    home, joints = robot.home_pose, robot.layout.joints
    rate_hz, frames, fine = 400.0, 200, 20
    steps = 1e-6 * np.linspace(1, 2, joints)
    none = ServoGains(0.0, 0.0, 0.0)
    settings = LoopSettings(none, FrameTiming(rate_hz), steps_per_frame=8)
    start = closed_loop.equilibrium(robot, values, home, none)
    commands = start.commands[0] + np.tile(steps, (frames, 1))
    run = closed_loop.simulate_commands(robot, values, at_rest(home, frames), settings, commands)
    found = robot.geometry.chart.coordinates(run.pose - home)
    time = np.arange(frames * fine) / (rate_hz * fine)
    # in the law of the drives, a command differs from the one before during one frame
    rates = np.where(time[:, None] < 1 / rate_hz, steps * rate_hz, 0.0)
    inputs = np.hstack([np.tile(steps, (len(time), 1)), rates])
    system, effects = linear_loop(robot, values)
    states = np.eye(len(system))
    loop = scipy.signal.StateSpace(system, effects, states, np.zeros_like(effects))
    expected = scipy.signal.lsim(loop, inputs, time, interp=False)[1][::fine, : found.shape[1]]
    largest = np.abs(expected).max()
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4 * largest)
    # the loop with shared gains is another
    shared = robot.layout.converted_gains(
        values[robot.layout.joint_pid], robot.with_own_gains(False).layout
    )
    values[robot.layout.joint_pid] = np.tile(shared, joints)
    other = closed_loop.simulate_commands(robot, values, at_rest(home, frames), settings, commands)
    apart = robot.geometry.chart.coordinates(other.pose - home) - expected
    assert np.abs(apart).max() > 20 * 1e-4 * largest


@pytest.mark.slow
def test_a_loop_of_unequal_gains_is_that_of_mujoco(robot):
    """Without friction, by MuJoCo's own bodies, constraints and integration."""
    pytest.importorskip("mujoco")
    own = robot.with_own_gains()
    values = unequal(robot)
    values[own.layout.coulomb] = values[own.layout.viscous] = 0.0
    shared = values.copy()
    shared[own.layout.joint_pid] = np.tile(robot.parameter_sets["truth"].joint_pid, 6)
    same, other = (
        np.abs(compare_engines(own, values, given, 0.5).difference).max(axis=0)
        for given in (values, shared)
    )
    assert same[:3].max() < 0.5e-6
    assert same[3:].max() < 5e-6
    assert other[:3].max() > 20 * same[:3].max()
    assert other[3:].max() > 10 * same[3:].max()


def test_the_linear_loop_agrees_with_that_of_shared_gains_and_differs_with_unequal_ones(robot, own):
    settings, home = own.settings(), robot.home_pose
    equal = robot.with_own_gains().parameter_sets["truth"].vector
    shared = robot.parameter_sets["truth"].vector
    radius = stability.spectral_radius(robot, shared, settings, home)
    assert stability.spectral_radius(own.robot, equal, settings, home) == radius
    assert stability.spectral_radius(own.robot, own.parameters, settings, home) != radius


@pytest.mark.slow
@pytest.mark.parametrize("drive", ["pid", "cascade"])
def test_feedforward_and_observer_know_the_gains_of_each_joint(robot, drive):
    """As the test of shared gains. A feedforward that takes the mean of the gains misses."""
    own = robot.with_own_gains()
    true = ParameterSet(robot.parameter_sets["truth"].dynamic, unequal(robot)[64:])
    own.parameter_sets = own.parameter_sets | {"truth": true}
    given = {"noise": 0 * NOISE, "observer": False, "drive": drive}
    alone = size(follow(own, FAST, None, noise=0 * NOISE, drive=drive)[1])
    fed = size(follow(own, FAST, feedforward, **given)[1])
    assert fed < alone / 1000
    mean = np.append(true.dynamic, np.tile(true.joint_pid.reshape(6, 3).mean(axis=0), 6))
    assert size(follow(own, FAST, feedforward, known=mean, **given)[1]) > 10 * fed
    run, _, expected = follow(own, FAST, feedforward, drive=drive)
    missed = np.array([one.coordinates for one in expected]) - run.pose
    assert size(missed) < 1.4 * np.sqrt(NOISE[0, 0])


def test_gain_columns_are_those_of_the_own_joint():
    by_gains = np.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(gain_columns(by_gains, False), by_gains)
    expected = [[0, 1, 2, 0, 0, 0], [0, 0, 0, 3, 4, 5]]
    np.testing.assert_array_equal(gain_columns(by_gains, True), expected)


def test_the_law_of_one_set_of_gains_is_that_of_all_joints_with_it():
    gains = np.array([10.0, 11.0, 0.1])
    one: JointLaw = joint_law("cascade", gains)
    each = joint_law("cascade", np.tile(gains, (3, 1)))
    np.testing.assert_array_equal(each.lx, np.full(3, one.lx))
    np.testing.assert_array_equal(each.lx_by, np.tile(one.lx_by, (3, 1)))


# Line of the set `guess` in the file of the reference robot.
SHARED = "joint_pid = { lp = 10.0, li = 12.0, ld = 0.1 }"


def test_a_robot_file_states_one_value_a_leg_and_is_written_again(load_changed):
    text = "joint_pid = { lp = [10, 11, 12, 13, 14, 15], li = 10.0, ld = 0.1 }"
    found = load_changed({SHARED: text})
    assert found.layout.own_gains
    gains = found.parameter_sets["guess"].joint_pid.reshape(6, 3)
    np.testing.assert_array_equal(gains[:, 0], [10, 11, 12, 13, 14, 15])
    np.testing.assert_array_equal(gains[:, 1], 10.0)
    # the other set has one value, which each joint has
    assert np.ptp(found.parameter_sets["truth"].joint_pid.reshape(6, 3), axis=0).max() == 0
    for robot in (found, found.with_own_gains(False).with_own_gains()):
        description = RobotDescription(robot.name, robot.geometry, robot.parameter_sets)
        again = parsed_robot(robot_text(description), "it")
        assert again.geometry == robot.geometry
        for name, values in robot.parameter_sets.items():
            np.testing.assert_array_equal(again.parameter_sets[name].vector, values.vector)


def test_a_list_of_a_wrong_length_is_refused(load_changed):
    words = r"parameters\.guess\.joint_pid\.li needs one value or 6 values, got 2"
    with pytest.raises(RobotFileError, match=words):
        load_changed({SHARED: "joint_pid = { lp = 10, li = [1.0, 2.0], ld = 0.1 }"})


def test_own_gains_are_exported_to_mjcf_and_imported(robot, tmp_path):
    pytest.importorskip("mujoco")
    own = robot.with_own_gains().with_parameters(unequal(robot))
    path = tmp_path / "own.xml"
    path.write_text(mjcf_text(own, allow_unphysical_inertia=True), encoding="utf-8")
    found, _ = robot_of_mjcf(path)
    assert found.geometry.own_gains
    gains = own.parameter_sets["guess"].joint_pid
    np.testing.assert_array_equal(found.parameter_sets["guess"].joint_pid, gains)


def test_a_gain_that_the_law_needs_is_refused_by_the_name_of_its_joint(own):
    values = own.parameters.copy()
    values[64 + 3 * 2 + 1] = 0.0
    with pytest.raises(SimulationError, match=r"joint3\.li is 0"):
        own.run(3, replace(own.settings(), drives=Drives()), values)
