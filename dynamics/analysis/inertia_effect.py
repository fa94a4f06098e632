"""What changed inertias do to the motion: accelerations of the robot with its own parameters and with changed ones.

Measured at random states over the travel, so that an export that has to change inertias can say what that means.
"""

import numpy as np

from dynamics.analysis.workspace import measure
from dynamics.kinematics.geometry import LEGS
from dynamics.parameters import BODY_NAMES, RIGID_BODY, check_parameters
from dynamics.robot import Robot

STATES = 300
CRANK_RATE_RAD_S, TORQUE_NM = 1.0, 3.0
"""Standard deviations of crank rates, and of torques on top of those that hold the robot."""


def acceleration_changes(robot: Robot, parameters: np.ndarray, inertias: np.ndarray) -> dict[str, float]:
    """How much each changed body alters forward dynamics, by body: the largest |change| / |acceleration|.

    `inertias` (13, 4) are masses and moments in the order of `BODY_NAMES`; bodies that have them already in the
    parameters (64,) are left out. Linear and angular acceleration count separately, over the states of
    `travel_states`. Raises ParameterError for parameters outside their range.
    """
    own = check_parameters(parameters)
    state = travel_states(robot, own)
    before = robot.forward_dynamics(*state, own).reshape(-1, 2, 3)
    effects = {}
    for index, body in enumerate(BODY_NAMES):
        other = own.copy()
        other[RIGID_BODY].reshape(-1, 4)[index] = inertias[index]
        if not np.array_equal(other, own):
            change = robot.forward_dynamics(*state, other).reshape(-1, 2, 3) - before
            effects[body] = float((np.linalg.norm(change, axis=2) / np.linalg.norm(before, axis=2)).max())
    return effects


def travel_states(robot: Robot, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random poses within the travel limit, twists and torques, (STATES, 6) each; always the same for a robot."""
    rng = np.random.default_rng(0)
    at_home = robot.pose_jacobian(robot.home_pose)
    pose = np.empty((0, 6))
    while len(pose) < STATES:
        # The linear map from angles to poses leaves the reach far from home: the factor keeps some draws near it.
        angles = robot.travel_limit * rng.uniform(0, 1, (STATES, 1)) * rng.uniform(-1, 1, (STATES, LEGS))
        drawn = robot.home_pose + np.linalg.solve(at_home, angles.T).T
        pose = np.concatenate([pose, drawn[measure(robot, drawn).travel_share <= 1]])
    pose = pose[:STATES]
    rates = CRANK_RATE_RAD_S * rng.standard_normal((STATES, LEGS, 1))
    twist = np.linalg.solve(robot.joint_jacobian(pose), rates)[..., 0]
    return pose, twist, robot.static_torque(pose, parameters) + TORQUE_NM * rng.standard_normal((STATES, LEGS))
