"""What the plain integrator of the loop works on: command, state, and the equation of motion evaluated at a state."""

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Command:
    """U(t) = value + slope t (6,), rad, and U_dot as the joint PID sees it; with their derivatives (6, columns), see
    `sensitivity`.
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
    """The equation of motion (`rigid_body.equation_of_motion`) at a state; error = U - theta in rad, torques in N m."""

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
