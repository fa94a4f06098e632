"""Joints: laws of dry and viscous friction, and springs between motors and driven bodies.

The friction of a joint with the velocity theta_dot is, in N m or N (in eq. 24, dry is the sign),

    torque = coulomb * dry(theta_dot) + viscous * theta_dot

Elastic joints have a spring between each motor and the body that it drives, which is a crank or a
slider (Spong, J. Dyn. Sys. Meas. Control 109, 1987). Let q be the pose, M the mass matrix, b the
bias, phi the motor angles referred to the cranks, and theta(q) the crank angles. Then

    spring torque = stiffness (phi - theta) + damping (phi_dot - theta_dot)
    M q_ddot + b = J_theta^T spring torque
    motor inertia phi_ddot = motor torque - friction(phi_dot) - spring torque

Encoder, joint PID and friction are at the motor. The inertia of the motor is subtracted from the
Izz of the crank, or from the mass of the slider. In the limit of stiff springs, the robot is thus
the rigid robot with the same parameters.
"""

from dataclasses import dataclass
from math import ceil
from typing import Literal, get_args

import numpy as np

from dynamics.checks import check_choice, real, shown
from dynamics.errors import SimulationError
from dynamics.parameters import ParameterLayout
from dynamics.robot import Robot

LawName = Literal["coulomb_viscous", "smoothed", "stribeck"]

# Type of a friction law as kernels read it. `law` is the index of its name in `LawName`.
FRICTION = np.dtype(
    (
        np.record,
        [
            ("law", "i8"),
            ("smoothing_velocity", "f8"),
            ("static_level", "f8"),
            ("stribeck_velocity", "f8"),
        ],
    )
)


@dataclass(frozen=True)
class FrictionLaw:
    """Law of the dry part of joint friction.

    Parameters
    ----------
    name : {"coulomb_viscous", "smoothed", "stribeck"}
        coulomb_viscous has the exact sign of eq. 24 and sticks up to the Coulomb torque. smoothed
        has tanh(theta_dot / smoothing_velocity) instead, and never sticks. stribeck sticks up to
        static_ratio times the Coulomb torque. When the joint slips, the excess over the Coulomb
        torque fades as exp(-(theta_dot / stribeck_velocity)^2).
    smoothing_velocity : float, optional
        Velocity scale in the tanh of the smoothed law, rad/s or m/s.
    static_ratio : float, optional
        Ratio of the static torque to the Coulomb torque, at least 1.
    stribeck_velocity : float, optional
        Velocity at which the excess has faded to 1/e, rad/s or m/s.

    Raises
    ------
    SimulationError
        If the name is unknown, or if a constant of the law is missing or out of range, or if a
        constant of another law is given.

    Examples
    --------
    >>> closed_loop.FrictionLaw("smoothed", smoothing_velocity=0.002).name
    'smoothed'
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
        self,
        constant: str,
        law: str,
        *,
        above: float | None = None,
        least: float | None = None,
        unit: str = "",
    ) -> None:
        """Raise SimulationError if a constant is missing, wrong, or given for another law."""
        value = getattr(self, constant)
        if self.name == law:
            real(
                f"{constant} of the law `{law}`",
                value,
                SimulationError,
                above=above,
                least=least,
                unit=unit,
            )
        elif value is not None:
            raise SimulationError(
                f"{constant} = {shown(value)} belongs to the law `{law}`, not to `{self.name}`"
            )

    def level(self, velocity: np.ndarray) -> np.ndarray:
        """Ratio of dry friction to the Coulomb torque at joint velocities, rad/s or m/s.

        It is 0 at rest.
        """
        if self.name == "smoothed":
            return np.asarray(np.tanh(velocity / self.smoothing_velocity))
        excess = np.zeros_like(velocity)
        if self.name == "stribeck":
            assert self.static_ratio is not None
            excess = (self.static_ratio - 1) * np.exp(-((velocity / self.stribeck_velocity) ** 2))
        return np.asarray(np.sign(velocity) * (1 + excess))

    @property
    def record(self) -> np.record:
        """Friction law in the form that kernels read."""
        constants = (
            self.smoothing_velocity or 0.0,
            self.static_ratio or 1.0,
            self.stribeck_velocity or 0.0,
        )
        return np.array([(get_args(LawName).index(self.name), *constants)], FRICTION)[0]


# Largest product of eigenvalue magnitude and step. The Runge-Kutta method is unstable above 2.8.
LARGEST_STEP = 1.0


@dataclass(frozen=True)
class JointElasticity:
    """Springs between the motors and the bodies that they drive.

    Parameters
    ----------
    stiffness : float
        Stiffness of each spring, N m/rad, or N/m for actuators that slide.
    motor_inertia : float
        Inertia of each motor, referred to its joint, kg m^2 or kg.
    damping : float
        Damping of each spring, N m s/rad or N s/m.

    Raises
    ------
    SimulationError
        If the stiffness or the inertia is not > 0, or if the damping is < 0.

    Examples
    --------
    >>> closed_loop.JointElasticity(stiffness=500.0, motor_inertia=3e-4, damping=0.02).stiffness
    500.0
    """

    stiffness: float
    motor_inertia: float
    damping: float = 0.0

    def __post_init__(self) -> None:
        real("joint stiffness", self.stiffness, SimulationError, above=0, unit=" N m/rad")
        real("motor inertia", self.motor_inertia, SimulationError, above=0, unit=" kg m^2")
        real("joint damping", self.damping, SimulationError, least=0, unit=" N m s/rad")

    def beyond_the_springs(self, layout: ParameterLayout, rigid: np.ndarray) -> np.ndarray:
        """Parameters (r,) of the rigid bodies, without the inertia of the motors of driven bodies.

        Raises SimulationError if the actuator of a leg drives more than one body.
        """
        carried = np.array(rigid)
        for leg, bodies in enumerate(layout.of_leg):
            body = layout.kinds[bodies[0]]
            if body.driven is None:
                raise SimulationError(
                    f"joints cannot be elastic: the actuator of leg {leg + 1} drives more than "
                    "one body"
                )
            driven = f"{layout.bodies[bodies[0]]}.{body.driven}"
            carried[layout.rigid_names.index(driven)] -= self.motor_inertia
        return carried

    def steps_needed(
        self,
        robot: Robot,
        parameters: np.ndarray,
        pose: np.ndarray,
        frame_period: float,
        friction: FrictionLaw,
    ) -> int:
        """Number of integration steps per frame that resolves the fastest motion near a pose (6,).

        The rate of the fastest motion is the largest magnitude of an eigenvalue of the joints and
        motors under joint PID and friction, linearised at rest. Gravity and the integral of the PID
        are neglected. Raises SimulationError if the inertia of a motor is not below that of the
        body that it drives.
        """
        self._check_motors(robot, parameters)
        basis = robot.geometry.chart.basis
        n = robot.layout.joints
        jacobian = robot.joint_jacobian(pose) @ basis
        mass = basis.T @ robot.mass_matrix(pose, parameters[robot.layout.dynamic]) @ basis
        carried = mass - self.motor_inertia * jacobian.T @ jacobian
        per_inertia = np.zeros((2 * n, 2 * n))
        per_inertia[:n, :n] = jacobian @ np.linalg.solve(carried, jacobian.T)
        per_inertia[n:, n:] = np.eye(n) / self.motor_inertia
        _, coulomb, viscous, gains = robot.layout.split(parameters)
        lp, _, ld = gains.T
        # slope of dry friction at rest, per Coulomb torque; a law that sticks has none
        slope = 1 / friction.smoothing_velocity if friction.smoothing_velocity else 0.0
        stiffness = _coupled(self.stiffness, lp)
        damping = _coupled(self.damping, ld + viscous + coulomb * slope)
        motion = np.block(
            [
                [np.zeros((2 * n, 2 * n)), np.eye(2 * n)],
                [-per_inertia @ stiffness, -per_inertia @ damping],
            ]
        )
        return max(
            1, ceil(frame_period * float(np.abs(np.linalg.eigvals(motion)).max()) / LARGEST_STEP)
        )

    def _check_motors(self, robot: Robot, parameters: np.ndarray) -> None:
        """Raise SimulationError if the inertia of a motor is not below that of its driven body."""
        layout = robot.layout
        bodies = layout.bodies_of(parameters)
        driven = [
            leg.driven_inertia(bodies[rows[0]])
            for leg, rows in zip(robot.geometry.legs, layout.of_leg, strict=True)
        ]
        lightest = int(np.argmin(driven))
        if self.motor_inertia >= driven[lightest]:
            name = layout.bodies[layout.of_leg[lightest][0]]
            unit = "kg" if layout.prismatic else "kg m^2"
            raise SimulationError(
                f"motor inertia is {self.motor_inertia:g} {unit}, must be below the "
                f"{driven[lightest]:.3g} {unit} of {name} including its motor"
            )


def _coupled(spring: float, at_motor: np.ndarray) -> np.ndarray:
    """Stiffness or damping matrix (2 n, 2 n). The bodies come first, then the motors.

    `spring` is the value between each body and its motor, and `at_motor` (n,) are the values
    between the motors and the base.
    """
    block = spring * np.eye(len(at_motor))
    return np.block([[block, -block], [-block, block + np.diag(at_motor)]])
