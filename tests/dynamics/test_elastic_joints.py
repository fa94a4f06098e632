"""What the loop integrates, joints rigid or elastic, against energy and an ODE solver on the
twist-space model.
"""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

from dynamics import closed_loop, load_robot
from dynamics.closed_loop import JointElasticity
from tests.dynamics.conftest import at_rest

GRAVITY = 9.81
LAYOUT = load_robot("rss6").layout
CRANK_IZZ = [LAYOUT.names.index(f"crank{leg}.Izz") for leg in range(1, 7)]
SOFT = JointElasticity(stiffness=500.0, motor_inertia=3e-4, damping=0.02)


@pytest.fixture(scope="module")
def frictionless(identified):
    """The truth without dry friction, all cranks heavier than a motor."""
    values = identified.copy()
    values[LAYOUT.coulomb] = 0.0
    values[CRANK_IZZ] = 6e-4
    return values


def _potential(pose, motors, stiffness, parameters, robot, legs_at):
    """Energy of gravity and springs, J, from heights and crank angles; rods have their centres at
    mid-length.
    """
    legs = legs_at(pose)
    crank_mass, link_mass = parameters[4:28:4], parameters[28:52:4]
    tip, joint, foot = legs.tip[:, 2], legs.joint[:, 2], robot.geometry.base_joints[:, 2]
    heights = (
        parameters[0] * pose[2] + crank_mass @ (foot + tip) / 2 + link_mass @ (tip + joint) / 2
    )
    return GRAVITY * heights + stiffness / 2 * np.sum(
        (motors - robot.inverse_kinematics(pose)) ** 2
    )


def _least_energy(start, *arguments):
    """Pose at which the energy has no slope, by MINPACK on differences over 20 um and 20 urad."""
    scale = 1e-4

    def slope(x):
        moves = 0.2 * np.vstack([np.eye(6), -np.eye(6)])
        energies = [_potential(start + scale * (x + move), *arguments) for move in moves]
        return np.array(energies[:6]) - energies[6:]

    return start + scale * fsolve(slope, np.zeros(6), xtol=1e-10)


def test_the_equilibrium_and_a_load_on_it_are_at_the_pose_of_least_energy(
    loop, robot, frictionless, legs_at
):
    """In equilibrium nothing moves. Motors held where they are, 8 kg put on the platform: after the
    vibration has died the sum of the energies of gravity and springs is least; the cranks have
    given way by torque over stiffness."""
    stiff_loop, settings = frictionless.copy(), loop.settings(steps=80, elasticity=SOFT)
    stiff_loop[64:] = 40.0, 200.0, 0.5
    pose = robot.home_pose + np.array([2e-3, -1e-3, 1e-3, 0.01, -0.005, 0.01])
    start = closed_loop.equilibrium(robot, stiff_loop, pose, settings.servo, elasticity=SOFT)
    least = _least_energy(
        pose + 1e-5, start.motor_angle, SOFT.stiffness, stiff_loop[:64], robot, legs_at
    )
    np.testing.assert_allclose(least, pose, atol=1e-8)
    reference = at_rest(pose, 300)
    np.testing.assert_allclose(
        loop.run(at_rest(pose, 20), settings, frictionless).pose, reference.poses[:20], atol=1e-13
    )
    loaded = stiff_loop.copy()
    loaded[0] += 8.0
    commands = np.tile(start.commands[0], (300, 1))
    run = loop.run(reference, settings, loaded, start=start, commands=commands)
    np.testing.assert_allclose(run.motor_angle[-1], commands[0], atol=1e-8)
    sunk = _least_energy(pose, commands[0], SOFT.stiffness, loaded[:64], robot, legs_at)
    assert np.abs(sunk - pose)[2] > 1e-4
    np.testing.assert_allclose(run.pose[-1], sunk, atol=1e-8)
    given_way = run.motor_angle[-1] - robot.inverse_kinematics(run.pose[-1])
    np.testing.assert_allclose(
        given_way, robot.static_torque(run.pose[-1], loaded[:64]) / SOFT.stiffness, atol=1e-8
    )


@pytest.mark.parametrize("el", [SOFT, None], ids=["elastic", "rigid"])
def test_motion_is_that_of_the_twist_space_model(loop, robot, identified, frictionless, el):
    """Three frames of moving commands against DOP853 on forward dynamics (eq. 40) under joint PID
    (eq. 31): with the springs as its actuators, or with smoothed dry friction in rigid joints."""
    frames, smoothing = 3, None if el else 0.05
    values = frictionless if el else identified
    settings = loop.settings(steps=200, elasticity=el, smoothing_velocity=smoothing)
    run = loop.run(
        frames, settings, values, commands=0.02 * np.sin(np.arange(frames))[:, None] * np.ones(6)
    )
    lp, li, ld = values[64:]
    carried, coulomb, viscous = values[:64].copy(), values[LAYOUT.coulomb], values[LAYOUT.viscous]
    carried[52:] = 0.0
    if el:
        carried[CRANK_IZZ] -= el.motor_inertia

    def slope(t, x, command, command_rate):
        pose, twist, motor, rate, integral = x.reshape(5, 6)
        crank, crank_rate = robot.inverse_kinematics(pose), robot.joint_jacobian(pose) @ twist
        motor, rate = (motor, rate) if el else (crank, crank_rate)
        torque = (
            lp * (command - motor) + ld * (command_rate - rate) + li * integral - viscous * rate
        )
        torque -= 0 if el else coulomb * np.tanh(rate / smoothing)
        spring = el.stiffness * (motor - crank) + el.damping * (rate - crank_rate) if el else torque
        motion = (
            robot.pose_rate(pose, twist),
            robot.forward_dynamics(pose, twist, spring, carried),
        )
        return np.concatenate(
            [*motion, rate, (torque - spring) / SOFT.motor_inertia, command - motor]
        )

    start, before = run.start, run.start.commands[-1]
    motor, rest = (start.motor_angle if el else np.zeros(6)), np.zeros(6)
    x = np.concatenate([start.pose, rest, motor, rest, start.joint_integral])
    for k in range(frames - 1):
        command = run.command[k]
        inputs = (command, (command - before) * 60.0)
        solution = solve_ivp(slope, (0, 1 / 60), x, "DOP853", args=inputs, rtol=1e-10, atol=1e-12)
        x, before = solution.y[:, -1], command
        pose, twist, motor, rate, _ = x.reshape(5, 6)
        np.testing.assert_allclose(run.pose[k + 1], pose, atol=1e-10)
        np.testing.assert_allclose(
            robot.twist(run.pose[k + 1], run.pose_rate[k + 1]), twist, atol=1e-8
        )
        if el:
            np.testing.assert_allclose(run.motor_angle[k + 1], motor, atol=1e-9)
            np.testing.assert_allclose(run.motor_rate[k + 1], rate, atol=1e-6)


def test_stiff_springs_give_the_rigid_run_to_first_order(loop, frictionless):
    """The difference halves with the compliance: the order between stiffnesses of 1, 2 and 4e4 N
    m/rad is 1.
    """
    rigid, misses = loop.run(30, loop.settings(steps=80), frictionless), []
    for stiffness in (1e4, 2e4, 4e4):
        settings = loop.settings(steps=200, elasticity=JointElasticity(stiffness, 3e-4, 0.02))
        misses.append(np.abs(loop.run(30, settings, frictionless).pose - rigid.pose).max())
    np.testing.assert_allclose(np.log2(misses[0] / np.array(misses[1:])), [1, 2], atol=0.02)
