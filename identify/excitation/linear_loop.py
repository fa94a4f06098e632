"""The closed loop, linearised about rest at home: how it follows a reference, and how missing torque moves it.

With s = i omega, C = kp + kd s + ki / s the servo, L = lp + ld s + li / s the joint PID and t_d the latency plus half
a frame of hold, the pose x follows a torque error d (Nm, joints) as

    x = -S d,   S = (J_ad^-T M E s^2 + F_v J_theta s + d(holding torque)/dx + L J_theta (1 + C exp(-s t_d)))^-1,

E from pose rates to twists, and follows a reference x_d as x = T x_d with T = S L J_theta C exp(-s t_d). Friction
counts with its viscous part only.
"""

import numpy as np
from numpy.typing import NDArray

from dynamics import Robot
from dynamics.parameters import VISCOUS
from identify.arrays import Array
from identify.scenario import Scenario

ComplexArray = NDArray[np.complex128]

STEP = 1e-6
"""Step [m, rad] of the difference quotient of the holding torque."""


def pid_response(parameters: Array, s: ComplexArray) -> ComplexArray:
    """L (K,) [Nm/rad] of the joint PID of `parameters` (67,) at s (K,) [1/s]."""
    lp, li, ld = parameters[64:]
    return np.asarray(lp + ld * s + li / s)


def torque_response(robot: Robot, parameters: Array, scenario: Scenario, s: ComplexArray) -> ComplexArray:
    """S (K, 6, 6) [m/Nm, rad/Nm] for `parameters` (67,) at s = i omega (K,) [1/s], none of them zero."""
    home, xi = robot.home_pose, parameters[:64]
    to_twist = robot.twist(np.tile(home, (6, 1)), np.eye(6)).T
    joint_rates = robot.pose_jacobian(home)
    inertia = np.linalg.solve(robot.joint_jacobian(home).T, robot.mass_matrix(home, xi) @ to_twist)
    steps = STEP * np.eye(6)
    stiffness = (robot.static_torque(home + steps, xi) - robot.static_torque(home - steps, xi)).T / (2 * STEP)
    damping = xi[VISCOUS][:, None] * joint_rates
    loop = pid_response(parameters, s) * (1 + servo_response(scenario, s))
    total = np.multiply.outer(s**2, inertia) + np.multiply.outer(s, damping) + stiffness
    return np.asarray(np.linalg.inv(total + np.multiply.outer(loop, joint_rates)))


def tracking_response(robot: Robot, parameters: Array, scenario: Scenario, s: ComplexArray) -> ComplexArray:
    """T (K, 6, 6) from desired to actual poses, as `torque_response`."""
    gain = pid_response(parameters, s) * servo_response(scenario, s)
    drive = np.multiply.outer(gain, robot.pose_jacobian(robot.home_pose))
    return np.asarray(torque_response(robot, parameters, scenario, s) @ drive)


def servo_response(scenario: Scenario, s: ComplexArray) -> ComplexArray:
    """C exp(-s t_d) (K,) of the visual servo at s (K,) [1/s]."""
    servo, timing = scenario.servo, scenario.timing
    delay = np.exp(-s * (timing.latency_s + timing.frame_period_s / 2))
    return np.asarray((servo.kp + servo.kd * s + servo.ki / s) * delay)
