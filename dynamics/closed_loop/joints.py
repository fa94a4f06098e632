"""Joints: laws of dry and viscous friction, and elasticity between motor and crank.

Friction (eq. 24), N m: torque = coulomb * dry(theta_dot) + viscous * theta_dot.

Elastic joints have a spring between each motor and the body that it drives, a crank or a slider (Spong, J. Dyn. Sys.
Meas. Control 109, 1987). With q the pose, phi the motor angles as they turn the cranks, theta(q) the crank angles:

    spring torque = stiffness (phi - theta) + damping (phi_dot - theta_dot)
    M q_ddot + b = J_theta^T spring torque,    motor inertia phi_ddot = motor torque - friction(phi_dot) - spring torque

Encoder, joint PID and friction sit at the motor. What turns with it is taken out of the cranks' Izz, or out of the
sliders' mass, so that the rigid robot of the same parameters is the limit of stiff springs.
"""

from dataclasses import dataclass
from math import ceil
from typing import Literal, get_args

import numpy as np

from dynamics.checks import check_choice, real, shown
from dynamics.errors import SimulationError
from dynamics.parameters import INERTIAL, ParameterLayout
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

    def level(self, velocity: np.ndarray) -> np.ndarray:
        """Dry friction over the Coulomb torque at joint velocities, rad/s or m/s, of any shape; 0 at rest."""
        if self.name == "smoothed":
            return np.asarray(np.tanh(velocity / self.smoothing_velocity))
        excess = np.zeros_like(velocity)
        if self.name == "stribeck":
            assert self.static_ratio is not None
            excess = (self.static_ratio - 1) * np.exp(-((velocity / self.stribeck_velocity) ** 2))
        return np.asarray(np.sign(velocity) * (1 + excess))

    @property
    def record(self) -> np.record:
        """The law as kernels read it: see `motion_kernels`."""
        constants = self.smoothing_velocity or 0.0, self.static_ratio or 1.0, self.stribeck_velocity or 0.0
        return np.array([(get_args(LawName).index(self.name), *constants)], FRICTION)[0]


LARGEST_STEP = 1.0
"""Largest eigenvalue times step of Runge-Kutta; it is unstable from 2.8 on."""


@dataclass(frozen=True)
class JointElasticity:
    """Stiffness (N m/rad) and damping (N m s/rad) of every joint's spring; inertia (kg m^2) of every motor, as its
    joint feels it; of actuators that slide N/m, N s/m and kg.

    Raises SimulationError for a stiffness or an inertia that is not > 0, a damping < 0, or one that is not finite.
    """

    stiffness: float
    motor_inertia: float
    damping: float = 0.0

    def __post_init__(self) -> None:
        real("joint stiffness", self.stiffness, SimulationError, above=0, unit=" N m/rad")
        real("motor inertia", self.motor_inertia, SimulationError, above=0, unit=" kg m^2")
        real("joint damping", self.damping, SimulationError, least=0, unit=" N m s/rad")

    def beyond_the_springs(self, layout: ParameterLayout, rigid: np.ndarray) -> np.ndarray:
        """Parameters of the rigid bodies that the springs carry: the driven bodies without their motors.

        Raises SimulationError for a robot with a leg whose actuator drives no body alone.
        """
        carried = np.array(rigid)
        for leg, row in enumerate(layout.of_leg):
            body = layout.kinds[row[0]]
            if body.driven is None:
                raise SimulationError(f"joints cannot be elastic: the actuator of leg {leg + 1} drives no body alone")
            layout.bodies_of(carried)[row[0], INERTIAL.index(body.driven)] -= self.motor_inertia
        return carried

    def steps_needed(
        self, robot: Robot, parameters: np.ndarray, pose: np.ndarray, frame_period: float, friction: FrictionLaw
    ) -> int:
        """Steps of integration a frame (s) that follow the fastest motion around a pose (6,), for all parameters.

        It is the largest eigenvalue of the joints and motors under joint PID and friction, linearised at rest.
        Raises SimulationError where the motors are more than the cranks' inertia.
        """
        self._check_motors(robot, parameters)
        free, n = robot.geometry.chart.basis, robot.layout.joints
        jacobian = robot.joint_jacobian(pose) @ free
        mass = free.T @ robot.mass_matrix(pose, parameters[robot.layout.dynamic]) @ free
        carried = mass - self.motor_inertia * jacobian.T @ jacobian
        per_inertia = np.zeros((2 * n, 2 * n))
        per_inertia[:n, :n] = jacobian @ np.linalg.solve(carried, jacobian.T)
        per_inertia[n:, n:] = np.eye(n) / self.motor_inertia
        _, coulomb, viscous, (lp, _, ld) = robot.layout.split(parameters)
        slope = 1 / friction.smoothing_velocity if friction.smoothing_velocity else 0.0  # of dry friction, at rest
        stiffness = _coupled(self.stiffness, np.full(n, lp))
        damping = _coupled(self.damping, ld + viscous + coulomb * slope)
        motion = np.block(
            [[np.zeros((2 * n, 2 * n)), np.eye(2 * n)], [-per_inertia @ stiffness, -per_inertia @ damping]]
        )
        return max(1, ceil(frame_period * float(np.abs(np.linalg.eigvals(motion)).max()) / LARGEST_STEP))

    def _check_motors(self, robot: Robot, parameters: np.ndarray) -> None:
        layout = robot.layout
        bodies = layout.bodies_of(parameters)
        driven = [leg.driven_inertia(bodies[of[0]]) for leg, of in zip(robot.geometry.legs, layout.of_leg, strict=True)]
        least = int(np.argmin(driven))
        if self.motor_inertia >= driven[least]:
            name, unit = layout.bodies[layout.of_leg[least][0]], "kg" if layout.prismatic else "kg m^2"
            raise SimulationError(
                f"motor inertia is {self.motor_inertia:g} {unit}, must be below the {driven[least]:.3g} {unit} "
                f"of {name} about its axis, which it is a part of"
            )


def _coupled(spring: float, at_motor: np.ndarray) -> np.ndarray:
    """(2 n, 2 n): what a spring between each driven body and its motor, and `at_motor` (n,) to the base, do to both."""
    one = spring * np.eye(len(at_motor))
    return np.block([[one, -one], [-one, one + np.diag(at_motor)]])
