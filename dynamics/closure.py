"""Poses that close the loops of a robot near a nominal geometry, and their derivatives.

The gaps of the loops (`rigid_body.jacobians.loop_closure`) depend on the coordinates q of the
platform, the joint coordinates and the geometric numbers. At a pose that closes the loops, the gaps
are zero. Hence, at constant joint coordinates,

    dq/d(numbers) = -(d(gaps)/dq)^-1 d(gaps)/d(numbers)

One compiled function serves all geometries near a nominal one. A search over geometries therefore
compiles nothing.
"""

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from dynamics.checks import row_text
from dynamics.compiled.machine_code import MachineFunction, compiled_functions
from dynamics.errors import ConvergenceError
from dynamics.expressions import function
from dynamics.geometry import MovableGeometry, RobotGeometry
from dynamics.kinematics.forward_kinematics import CLOSED, close_loops
from dynamics.rigid_body.jacobians import loop_closure


@dataclass(frozen=True)
class Closure:
    """Loops of the geometries near a nominal one, with n joints and m coordinates.

    A geometry is given by its g deviations from the nominal geometric numbers, m and rad.
    """

    nominal: RobotGeometry

    def poses(self, joints: np.ndarray, deviations: np.ndarray, start: np.ndarray) -> np.ndarray:
        """Poses (N, 6) at which the loops close with joint coordinates (N, n), from starts (N, 6).

        Raises ConvergenceError for the first row whose loops do not close.
        """
        poses = self.nearest(joints, deviations, start)
        if not np.isfinite(poses).all():
            row = int(np.argmin(np.isfinite(poses).all(axis=1)))
            raise ConvergenceError(
                f"no pose near {row_text(start[row], 4)} closes the loops with the joint "
                f"coordinates {row_text(joints[row], 4)} of pose {row + 1}"
            )
        return poses

    def nearest(self, joints: np.ndarray, deviations: np.ndarray, start: np.ndarray) -> np.ndarray:
        """Poses like those of `poses`, with NaN for rows whose loops do not close."""

        def gaps(poses: np.ndarray, theta: np.ndarray) -> list[np.ndarray]:
            return self._function(poses, theta, deviations[None])[:2]

        closed, _ = close_loops(gaps, self.nominal.chart, joints, start)
        closed[~(np.abs(gaps(closed, joints)[0]).max(axis=(1, 2)) < CLOSED)] = np.nan
        return closed

    def derivatives(
        self, poses: np.ndarray, joints: np.ndarray, deviations: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of the platform's coordinates at poses (N, 6) that close the loops.

        Returns derivatives with respect to the deviations, (N, m, g), and with respect to the joint
        coordinates, (N, m, n). `joints` (N, n) are the joint coordinates at the poses.
        """
        _, by_coordinates, by_joints, by_numbers = self._function(poses, joints, deviations[None])
        return -np.linalg.solve(by_coordinates, by_numbers), -np.linalg.solve(
            by_coordinates, by_joints
        )

    @cached_property
    def _function(self) -> MachineFunction:
        """Compiled function of the gaps and their derivatives."""
        key = b"closure of the loops" + self.nominal.digest
        return compiled_functions(key, lambda: [closure_function(self.nominal)])["closure"]


def closure_function(nominal: RobotGeometry) -> ca.Function:
    """Function (pose (6,), joints (n,), deviations (g,)) of the gaps of the loops.

    It returns the gaps (n,), m^2, and their derivatives with respect to the coordinates (n, m), the
    joint coordinates (n, n) and the deviations (n, g).
    """
    pose = ca.SX.sym("pose", 6)
    joints = ca.SX.sym("joints", len(nominal.legs))
    movable = MovableGeometry(nominal)
    (deviations,) = movable.symbols
    gaps, by_coordinates = loop_closure(movable, pose, joints)
    outputs = [gaps, by_coordinates, ca.jacobian(gaps, joints), ca.jacobian(gaps, deviations)]
    return function("closure", [pose, joints, deviations], outputs)
