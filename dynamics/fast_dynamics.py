"""Forward dynamics for inner loops."""

from collections.abc import Callable
from typing import Any

import numpy as np

from dynamics.checks import check_type, floats, shown
from dynamics.errors import DynamicsError, ShapeError, SingularPoseError
from dynamics.robot import Robot

StateToAcceleration = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def fast_forward_dynamics(robot: Robot, parameters: np.ndarray | None = None) -> StateToAcceleration:
    """A function of pose (6,), twist (6,), torque (n,) that returns twist_dot (6,), as `Robot.forward_dynamics`.

    Parameters (p,) are fixed and checked once; None means the robot's nominal ones. Some 80 times faster than the
    robot's own method, which checks shapes, reach and conditioning on every call. The array returned is the function's
    own and is overwritten by the next call (copy it to keep it); so the function is not thread safe.
    It raises ShapeError unless its inputs are float64 arrays of these shapes, and SingularPoseError where the
    result is not finite: a leg out of reach, a singular mass matrix, or NaN in the input.

    Where J_a2 alone is singular (the platform moves with all cranks locked) eq. 40 still holds, since M is regular:
    the result is the acceleration. `Robot.forward_dynamics` refuses such poses, since a controller cannot hold them;
    `workspace.check_motion` says how near they are.
    """
    check_type("robot", robot, Robot, DynamicsError)
    fixed = robot.layout.check(robot.nominal_parameters if parameters is None else parameters)
    joints = robot.layout.joints
    function, result = robot.functions["forward_dynamics"], np.zeros(6)
    inputs = np.concatenate([np.zeros(12 + joints), fixed, function.constants])
    # Assigning to a memoryview costs half of assigning to an array, and refuses other shapes and types. The stubs of
    # NumPy do not know of that.
    views: list[Any] = [memoryview(part.data) for part in (inputs[0:6], inputs[6:12], inputs[12 : 12 + joints])]
    pose_in, twist_in, torque_in = views
    values = memoryview(result.data)
    call = function.bound_to(inputs, result)

    def forward_dynamics(at_pose: np.ndarray, at_twist: np.ndarray, at_torque: np.ndarray) -> np.ndarray:
        try:
            pose_in[:] = at_pose
            twist_in[:] = at_twist
            torque_in[:] = at_torque
        except (TypeError, ValueError):
            given = {"pose": (at_pose, 6), "twist": (at_twist, 6), "torque": (at_torque, joints)}
            for name, (value, size) in given.items():
                if floats(name, value, (size,), finite=False) is not value:
                    raise ShapeError(f"{name} must be a float64 array of shape ({size},), got {shown(value)}") from None
            raise ShapeError(f"pose and twist (6,) and torque ({joints},) must be float64 arrays") from None
        call()
        first = values[0]  # the mass matrix couples all entries: one that is not finite makes all of them so
        if not first - first == 0.0:
            raise SingularPoseError(
                f"forward dynamics is not finite at pose {at_pose}, twist {at_twist}, torque {at_torque}"
            )
        return result

    return forward_dynamics
