"""Forward and inverse dynamics against Pinocchio: the same robot as a closed chain of 13 bodies with 18 constraints."""

import numpy as np
import pytest

from dynamics.parameters import COULOMB, VISCOUS

pytest.importorskip("pinocchio")


@pytest.fixture
def chain_of(robot):
    """(parameters) -> the robot in Pinocchio."""
    from tests.closed_chain import ClosedChain

    return lambda values: ClosedChain(robot, values)


@pytest.mark.parametrize("name", ["initial", "identified"])
def test_forward_dynamics_agrees_with_pinocchio(robot, many_states, chain_of, name):
    """twist_dot of 300 random states and torques agrees to 1e-9 of its size; friction enters as joint torque."""
    values, states = robot.parameter_sets[name].dynamic, many_states
    chain = chain_of(values)
    torques = 5 * np.random.default_rng(5).standard_normal((300, 6))
    accelerations = robot.forward_dynamics(states.pose, states.twist, torques, values)
    for pose, twist, torque, ours in zip(states.pose, states.twist, torques, accelerations, strict=True):
        theta_dot = robot.joint_jacobian(pose) @ twist
        net = torque - values[COULOMB] * np.sign(theta_dot) - values[VISCOUS] * theta_dot
        state = chain.state(pose, twist, net)
        gap, speed = chain.closure(state)
        assert gap < 1e-14
        assert speed < 1e-14
        theirs = chain.twist_dot(state)
        assert np.abs(ours - theirs).max() <= 1e-9 * np.abs(theirs).max()


def test_torques_of_a_motion_move_pinocchio_that_way(robot, many_states, chain_of):
    """Inverse dynamics without friction, put into Pinocchio's forward dynamics, gives the twist_dot asked for."""
    values, states = robot.parameter_sets["initial"].dynamic, many_states
    chain = chain_of(values)
    torques = robot.inverse_dynamics(states.pose, states.twist, states.twist_dot, values)
    for pose, twist, torque, wanted in zip(states.pose, states.twist, torques, states.twist_dot, strict=True):
        result = chain.twist_dot(chain.state(pose, twist, torque))
        np.testing.assert_allclose(result, wanted, atol=1e-9 * np.abs(wanted).max())
