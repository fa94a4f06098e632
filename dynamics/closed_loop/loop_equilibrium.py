"""The state of rest from which a closed-loop run starts where no other start is given."""

import numpy as np

from dynamics.checks import check_type, floats
from dynamics.closed_loop.elasticity import JointElasticity
from dynamics.closed_loop.loop_checks import check_start_pose, checked_loop_parameters
from dynamics.closed_loop.problem import PARAMETER_COUNT, ServoGains, StartState
from dynamics.errors import SimulationError
from dynamics.robot import Robot


def equilibrium(
    robot: Robot,
    parameters: np.ndarray,
    pose: np.ndarray,
    servo: ServoGains,
    servo_robot: Robot | None = None,
    elasticity: JointElasticity | None = None,
) -> StartState:
    """State of rest at a pose (6,), friction unloaded, for parameters (67,); servo_robot as in `closed_loop.simulate`.

    The holding torque is linear in the dynamic parameters. Raises what that raises before a run.
    """
    check_type("robot", robot, Robot, SimulationError)
    check_type("servo", servo, ServoGains, SimulationError)
    parameters, pose = checked_loop_parameters(parameters), floats("pose", pose, (6,))
    li, rest = parameters[65], np.zeros(6)
    check_start_pose(robot, parameters, pose)
    angles = robot.inverse_kinematics(pose)
    torque_map = np.linalg.solve(robot.joint_jacobian(pose).T, robot.regressor(pose, rest, rest))
    integral = torque_map @ parameters[:64] / li
    sensitivity = np.zeros((6, PARAMETER_COUNT))
    sensitivity[:, :64] = torque_map / li
    sensitivity[:, 65] = -integral / li
    motors = {}
    if elasticity is not None:
        angles = angles + li * integral / elasticity.stiffness
        motors = {"motor_angle": angles, "motor_rate": rest}
    known = servo_robot or robot
    servo_integral = np.linalg.solve(known.pose_jacobian(pose), angles) / servo.ki if servo.ki else np.zeros(6)
    return StartState(pose, rest, integral, servo_integral, angles[None], pose, sensitivity, **motors)
