"""Forward dynamics for inner loops: one state a call, no checks of the input, no allocation but the result."""

from typing import Any

import numpy as np

from dynamics.errors import SingularPoseError
from dynamics.parameters import check_parameters
from dynamics.robot import Robot


class ForwardDynamics:
    """Call it with pose (6,), twist (6,), torque (6,) of float64 to get twist_dot (6,), as `Robot.forward_dynamics`.

    Parameters (64,) are fixed and checked once; None means the robot's nominal ones. Some 50 times faster than the
    robot's own method, which checks shapes, reach and conditioning on every call. Not thread safe: it owns its buffers.
    Raises SingularPoseError where the result is not finite: out of reach, singular, or NaN in the input.
    """

    def __init__(self, robot: Robot, parameters: np.ndarray | None = None) -> None:
        self._pose, self._twist, self._torque, self._result = np.zeros((4, 6))
        self._parameters = check_parameters(robot.nominal_parameters if parameters is None else parameters).copy()
        # CasADi's stubs do not know the memoryview form of set_arg.
        self._buffer: Any
        self._buffer, self._evaluate = robot.functions["forward_dynamics"].buffer()
        for index, array in enumerate((self._pose, self._twist, self._torque, self._parameters)):
            self._buffer.set_arg(index, memoryview(array.data))
        self._buffer.set_res(0, memoryview(self._result.data))

    def __call__(self, pose: np.ndarray, twist: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """twist_dot (6,), a new array."""
        self._pose[:] = pose
        self._twist[:] = twist
        self._torque[:] = torque
        self._evaluate()
        result = self._result.copy()
        if result[0] != result[0]:
            raise SingularPoseError(f"forward dynamics is not finite at pose {pose}, twist {twist}, torque {torque}")
        return result
