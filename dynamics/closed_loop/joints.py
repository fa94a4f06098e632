"""Joints: laws of dry and viscous friction, and elasticity between motor and crank.

Friction (eq. 24), N m: torque = coulomb * dry(theta_dot) + viscous * theta_dot.

Elastic joints have a torsion spring between each motor and its crank (Spong, J. Dyn. Sys. Meas. Control 109, 1987).
With q the pose, phi the motor angles as they turn the cranks, theta(q) the crank angles:

    spring torque = stiffness (phi - theta) + damping (phi_dot - theta_dot)
    M q_ddot + b = J_theta^T spring torque,    motor inertia phi_ddot = motor torque - friction(phi_dot) - spring torque

Encoder, joint PID and friction sit at the motor. What turns with it is taken out of the cranks' Izz, so that the rigid
robot of the same parameters is the limit of stiff springs.
"""

from dataclasses import dataclass
from math import ceil
from typing import Literal, get_args

import numpy as np

from dynamics.checks import check_choice, real, shown
from dynamics.errors import SimulationError
from dynamics.legs.rss_geometry import LEGS
from dynamics.parameters import BODY_NAMES, INERTIAL, RIGID_BODY, RIGID_BODY_NAMES, VISCOUS, split_parameters
from dynamics.robot import Robot

LawName = Literal["coulomb_viscous", "smoothed", "stribeck"]

FRICTION = np.dtype(
    (np.record, [("law", "i8"), ("smoothing_velocity", "f8"), ("static_level", "f8"), ("stribeck_velocity", "f8")])
)
"""A friction law as kernels read it; the law by its place in `LawName`."""


@dataclass(frozen=True)
class FrictionLaw:
    """How the dry part depends on the joint's velocity.

    coulomb_viscous: the sign of eq. 24, exact, with sticking up to the Coulomb torque.
    smoothed: tanh(theta_dot / smoothing_velocity); never sticks. smoothing_velocity in rad/s.
    stribeck: sticks up to static_ratio times the Coulomb torque; slipping, the excess fades as
    exp(-(theta_dot / stribeck_velocity)^2). stribeck_velocity in rad/s, static_ratio >= 1.
    Raises SimulationError for an unknown name or a constant that is missing, not allowed, or out of range.
    """

    name: LawName = "coulomb_viscous"
    smoothing_velocity: float | None = None
    static_ratio: float | None = None
    stribeck_velocity: float | None = None

    def __post_init__(self) -> None:
        check_choice("friction law", self.name, get_args(LawName), SimulationError)
        self._check("smoothing_velocity", "smoothed", above=0, unit=" rad/s")
        self._check("stribeck_velocity", "stribeck", above=0, unit=" rad/s")
        self._check("static_ratio", "stribeck", least=1)

    def _check(
        self, constant: str, law: str, *, above: float | None = None, least: float | None = None, unit: str = ""
    ) -> None:
        value = getattr(self, constant)
        if self.name == law:
            real(f"{constant} of the law `{law}`", value, SimulationError, above=above, least=least, unit=unit)
        elif value is not None:
            raise SimulationError(f"{constant} = {shown(value)} belongs to the law `{law}`, not to `{self.name}`")

    @property
    def record(self) -> np.record:
        """The law as kernels read it: see `motion_kernels`."""
        constants = self.smoothing_velocity or 0.0, self.static_ratio or 1.0, self.stribeck_velocity or 0.0
        return np.array([(get_args(LawName).index(self.name), *constants)], FRICTION)[0]


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
        jacobian, n = robot.joint_jacobian(pose), LEGS
        carried = robot.mass_matrix(pose, parameters[: VISCOUS.stop]) - self.motor_inertia * jacobian.T @ jacobian
        per_inertia = np.zeros((2 * n, 2 * n))
        per_inertia[:n, :n] = jacobian @ np.linalg.solve(carried, jacobian.T)
        per_inertia[n:, n:] = np.eye(n) / self.motor_inertia
        _, coulomb, viscous, (lp, _, ld) = split_parameters(parameters)
        slope = 1 / friction.smoothing_velocity if friction.smoothing_velocity else 0.0  # of dry friction, at rest
        stiffness = _coupled(self.stiffness, np.full(n, lp))
        damping = _coupled(self.damping, ld + viscous + coulomb * slope)
        motion = np.block(
            [[np.zeros((2 * n, 2 * n)), np.eye(2 * n)], [-per_inertia @ stiffness, -per_inertia @ damping]]
        )
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
    one = spring * np.eye(len(at_motor))
    return np.block([[one, -one], [-one, one + np.diag(at_motor)]])
