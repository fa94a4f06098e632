"""Forward dynamics for inner loops: one state a call, no checks of the input, no allocation."""

from collections.abc import Callable
from typing import Any

import numpy as np

from dynamics.errors import SingularPoseError
from dynamics.parameters import check_parameters
from dynamics.robot import Robot

StateToAcceleration = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def fast_forward_dynamics(robot: Robot, parameters: np.ndarray | None = None) -> StateToAcceleration:
    """A function of pose (6,), twist (6,), torque (6,) that returns twist_dot (6,), as `Robot.forward_dynamics`.

    Parameters (64,) are fixed and checked once; None means the robot's nominal ones. Some 80 times faster than the
    robot's own method, which checks shapes, reach and conditioning on every call. The array returned is the function's
    own and is overwritten by the next call (copy it to keep it); so the function is not thread safe. Its inputs must be
    contiguous float64 arrays (ValueError otherwise).
    It raises SingularPoseError where the result is not finite: out of reach, singular, or NaN in the input.
    """
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
        pose_in[:] = at_pose
        twist_in[:] = at_twist
        torque_in[:] = at_torque
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


def _writable(array: np.ndarray) -> Any:
    return memoryview(array.data)
