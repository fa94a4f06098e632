"""Robots with elastic joints for the plain integrator of `stick_slip`: the twin of `elastic_joints.c`.

With the motor angles as six more coordinates, and the motors as the joints that friction acts on, an elastic robot is
one more system M q_ddot + b = J^T (torque - friction); see `joint_elasticity`.
"""

import numpy as np

from dynamics.closed_loop.elasticity import JointElasticity
from dynamics.closed_loop.loop_motion import MotionFunctions, State
from dynamics.closed_loop.problem import StartState


def elastic_functions(functions: MotionFunctions, elasticity: JointElasticity) -> MotionFunctions:
    """The functions of a robot, with `equation_of_motion` in twelve coordinates: pose, motor angles."""

    def equation_of_motion(pose: np.ndarray, rate: np.ndarray, rigid: np.ndarray) -> tuple[np.ndarray, ...]:
        carried = elasticity.beyond_the_springs(rigid)
        terms = functions["equation_of_motion"](pose[:6], rate[:6], carried)
        mass, bias, jacobian, _, angle = (np.asarray(term, dtype=float) for term in terms)
        motor, motor_rate = pose[6:, None], rate[6:, None]
        wound = motor_rate - jacobian @ rate[:6, None]
        spring = elasticity.stiffness * (motor - angle) + elasticity.damping * wound
        whole = np.zeros((12, 12))
        whole[:6, :6], whole[6:, 6:] = mass, elasticity.motor_inertia * np.eye(6)
        at_motors = np.hstack([np.zeros((6, 6)), np.eye(6)])
        return whole, np.vstack([bias - jacobian.T @ spring, spring]), at_motors, np.zeros((6, 1)), motor

    return {**functions, "equation_of_motion": equation_of_motion}


def with_motors(state: State, start: StartState) -> State:
    """The state of a start in twelve coordinates."""
    assert start.motor_angle is not None
    assert start.motor_rate is not None
    return State(
        np.concatenate([state.pose, start.motor_angle]),
        np.concatenate([state.rate, start.motor_rate]),
        state.integral,
    )
