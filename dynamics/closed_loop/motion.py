"""What the plain integrator works on: command, state, equation of motion; of rigid and of elastic joints.

Robots with elastic joints for the plain integrator of `stick_slip`: the twin of `elastic_joints.c`.
With the motor angles as six more coordinates, and the motors as the joints that friction acts on, an elastic robot is
one more system M q_ddot + b = J^T (torque - friction); see `joint_elasticity`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dynamics.closed_loop.elasticity import JointElasticity
from dynamics.closed_loop.problem import StartState

# What the plain integrator of the loop works on: command, state, and the equation of motion evaluated at a state.


MotionFunctions = Mapping[str, Callable[..., Any]]
"""What the integrator evaluates, by the names of `pose_space_motion`: CasADi functions, or ones made from them."""


@dataclass(frozen=True)
class Command:
    """U(t) = value + slope t (6,), rad, and U_dot as the joint PID sees it; with their derivatives (6, columns), see
    `step_sensitivity`.
    """

    value: np.ndarray
    slope: np.ndarray
    rate: np.ndarray
    d_value: np.ndarray
    d_slope: np.ndarray
    d_rate: np.ndarray


@dataclass(frozen=True)
class State:
    """Pose, pose rate and joint PID integral, (6,) each; or their derivatives, (6, columns) each.

    With elastic joints pose and rate are those of the platform and then of the motors, (12,) each.
    """

    pose: np.ndarray
    rate: np.ndarray
    integral: np.ndarray

    def moved(self, slope: "State", h: float) -> "State":
        """The state after a time h at a constant slope."""
        return State(self.pose + h * slope.pose, self.rate + h * slope.rate, self.integral + h * slope.integral)


@dataclass
class Evaluation:
    """The equation of motion at one state: see `pose_space_motion`. error = U - theta in rad, torques in N m."""

    state: State
    time: float
    mass: np.ndarray
    bias: np.ndarray
    jacobian: np.ndarray
    bias_acceleration: np.ndarray
    error: np.ndarray
    velocity: np.ndarray
    torque: np.ndarray
    net_torque: np.ndarray = field(default_factory=lambda: np.zeros(6))
    stick_force: np.ndarray = field(default_factory=lambda: np.zeros(6))
    acceleration: np.ndarray = field(default_factory=lambda: np.zeros(6))


def compliance(at: Evaluation, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """J M^-1 J^T (n, n) of some joints, and M^-1 J^T (6, n)."""
    response = np.linalg.solve(at.mass, at.jacobian[joints].T)
    return at.jacobian[joints] @ response, response


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
