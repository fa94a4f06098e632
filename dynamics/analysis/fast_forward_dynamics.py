"""Forward dynamics for inner loops: one state a call, no checks of the input, no allocation."""

from collections.abc import Callable
from typing import Any

import numpy as np

from dynamics.checks import check_type, floats, shown
from dynamics.errors import DynamicsError, ShapeError, SingularPoseError
from dynamics.parameters import check_parameters
from dynamics.robot import Robot

StateToAcceleration = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def fast_forward_dynamics(robot: Robot, parameters: np.ndarray | None = None) -> StateToAcceleration:
    """A function of pose (6,), twist (6,), torque (6,) that returns twist_dot (6,), as `Robot.forward_dynamics`.

    Parameters (64,) are fixed and checked once; None means the robot's nominal ones. Some 80 times faster than the
    robot's own method, which checks shapes, reach and conditioning on every call. The array returned is the function's
    own and is overwritten by the next call (copy it to keep it); so the function is not thread safe.
    It raises ShapeError unless its inputs are float64 arrays of shape (6,), and SingularPoseError where the
    result is not finite: a leg out of reach, a singular mass matrix, or NaN in the input.

    Where J_a2 alone is singular (the platform moves with all cranks locked) eq. 40 still holds, since M is regular:
    the result is the acceleration. `Robot.forward_dynamics` refuses such poses, since a controller cannot hold them;
    `workspace.check_motion` says how near they are.
    """
    check_type("robot", robot, Robot, DynamicsError)
    pose, twist, torque, result = np.zeros((4, 6))
    fixed = check_parameters(robot.nominal_parameters if parameters is None else parameters).copy()
    # CasADi's stubs do not know the memoryview form of set_arg.
    buffer: Any
    buffer, evaluate = robot.functions["forward_dynamics"].buffer()
    for index, array in enumerate((pose, twist, torque, fixed)):
        buffer.set_arg(index, memoryview(array.data))
    buffer.set_res(0, memoryview(result.data))
    values = memoryview(result.data)
    # Assigning to a memoryview costs half of assigning to an array, and refuses other shapes and types.
    pose_in, twist_in, torque_in = (_writable(array) for array in (pose, twist, torque))

    def forward_dynamics(at_pose: np.ndarray, at_twist: np.ndarray, at_torque: np.ndarray) -> np.ndarray:
        try:
            pose_in[:] = at_pose
            twist_in[:] = at_twist
            torque_in[:] = at_torque
        except (TypeError, ValueError):
            raise _refusal(pose=at_pose, twist=at_twist, torque=at_torque) from None
        evaluate()
        first = values[0]  # the mass matrix couples all entries: one that is not finite makes all of them so
        if not first - first == 0.0:
            raise SingularPoseError(
                f"forward dynamics is not finite at pose {at_pose}, twist {at_twist}, torque {at_torque}"
            )
        return result

    # The buffer must live as long as the function that evaluates it.
    forward_dynamics.buffer = buffer  # type: ignore[attr-defined]
    return forward_dynamics


def _refusal(**inputs: Any) -> ShapeError:
    """The error for inputs of which one is no float64 array (6,)."""
    for name, value in inputs.items():
        if floats(name, value, (6,), finite=False) is not value:
            return ShapeError(f"{name} must be a float64 array of shape (6,), got {shown(value)}")
    return ShapeError(f"{', '.join(inputs)} must be float64 arrays of shape (6,)")


def _writable(array: np.ndarray) -> Any:
    return memoryview(array.data)
