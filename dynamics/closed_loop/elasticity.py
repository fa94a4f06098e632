"""Elastic joints: a torsion spring between each motor and its crank (Spong, J. Dyn. Sys. Meas. Control 109, 1987).

With q the pose, phi the motor angles as they turn the cranks, theta(q) the crank angles:

    spring torque = stiffness (phi - theta) + damping (phi_dot - theta_dot)
    M q_ddot + b = J_theta^T spring torque,    motor inertia phi_ddot = motor torque - friction(phi_dot) - spring torque

Encoder, joint PID and friction sit at the motor. What turns with it is taken out of the cranks' Izz, so that the rigid
robot of the same parameters is the limit of stiff springs.
"""

from dataclasses import dataclass
from math import ceil

import numpy as np

from dynamics.checks import real
from dynamics.closed_loop.friction import FrictionLaw
from dynamics.errors import SimulationError
from dynamics.legs.rss_geometry import LEGS
from dynamics.parameters import BODY_NAMES, INERTIAL, RIGID_BODY, RIGID_BODY_NAMES, split_parameters
from dynamics.robot import Robot

LARGEST_STEP = 1.0
"""Largest eigenvalue times step of Runge-Kutta; it is unstable from 2.8 on."""

CRANK_IZZ = np.array([RIGID_BODY_NAMES.index(f"crank{leg}.Izz") for leg in range(1, LEGS + 1)])


@dataclass(frozen=True)
class JointElasticity:
    """Stiffness (N m/rad) and damping (N m s/rad) of every joint's spring; inertia (kg m^2) of every motor.

    Raises SimulationError for a stiffness or an inertia that is not > 0, a damping < 0, or one that is not finite.
    """

    stiffness: float
    motor_inertia: float
    damping: float = 0.0

    def __post_init__(self) -> None:
        real("joint stiffness", self.stiffness, SimulationError, above=0, unit=" N m/rad")
        real("motor inertia", self.motor_inertia, SimulationError, above=0, unit=" kg m^2")
        real("joint damping", self.damping, SimulationError, least=0, unit=" N m s/rad")

    def beyond_the_springs(self, rigid: np.ndarray) -> np.ndarray:
        """Parameters of the rigid bodies (52,) that the springs carry: the cranks without their motors."""
        carried = np.array(rigid)
        carried[CRANK_IZZ] -= self.motor_inertia
        return carried

    def steps_needed(
        self, robot: Robot, parameters: np.ndarray, pose: np.ndarray, frame_period: float, friction: FrictionLaw
    ) -> int:
        """Steps of integration a frame (s) that follow the fastest motion around a pose (6,), for parameters (67,).

        It is the largest eigenvalue of the joints and motors under joint PID and friction, linearised at rest.
        Raises SimulationError where the motors are more than the cranks' inertia.
        """
        self._check_motors(robot, parameters)
        jacobian = robot.joint_jacobian(pose)
        carried = robot.mass_matrix(pose, parameters[:64]) - self.motor_inertia * jacobian.T @ jacobian
        per_inertia = np.zeros((12, 12))
        per_inertia[:6, :6] = jacobian @ np.linalg.solve(carried, jacobian.T)
        per_inertia[6:, 6:] = np.eye(6) / self.motor_inertia
        _, coulomb, viscous, (lp, _, ld) = split_parameters(parameters)
        dry = coulomb * friction.dry_slope(np.zeros(6), np.ones(6))
        stiffness = _coupled(self.stiffness, np.full(6, lp))
        damping = _coupled(self.damping, ld + viscous + dry)
        motion = np.block([[np.zeros((12, 12)), np.eye(12)], [-per_inertia @ stiffness, -per_inertia @ damping]])
        return max(1, ceil(frame_period * float(np.abs(np.linalg.eigvals(motion)).max()) / LARGEST_STEP))

    def _check_motors(self, robot: Robot, parameters: np.ndarray) -> None:
        bodies = parameters[RIGID_BODY].reshape(len(BODY_NAMES), len(INERTIAL))[1 : 1 + LEGS]
        about_axis = bodies[:, 3] + bodies[:, 0] * robot.geometry.crank_length**2 / 4
        least = int(np.argmin(about_axis))
        if self.motor_inertia >= about_axis[least]:
            raise SimulationError(
                f"motor inertia is {self.motor_inertia:g} kg m^2, must be below the {about_axis[least]:.3g} kg m^2 "
                f"of crank {least + 1} about its axis, which it is a part of"
            )


def _coupled(spring: float, at_motor: np.ndarray) -> np.ndarray:
    """(12, 12): what a spring between every crank and its motor, and `at_motor` (6,) to the base, do to both."""
    one = spring * np.eye(6)
    return np.block([[one, -one], [-one, one + np.diag(at_motor)]])
