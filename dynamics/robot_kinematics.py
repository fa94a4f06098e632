"""Kinematics of a robot on NumPy arrays, for one pose or a batch."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from dynamics.checks import floats, rows, whole
from dynamics.errors import DynamicsError
from dynamics.kinematics import forward_kinematics
from dynamics.kinematics.forward_kinematics import ForwardSolution
from dynamics.robot_platform import RobotPlatform


class RobotKinematics(RobotPlatform):
    """Kinematics and Jacobians of a robot. See `Robot`."""

    def inverse_kinematics(self, pose: ArrayLike) -> np.ndarray:
        """Joint coordinates at a pose, in closed form (eq. 3 and 4).

        Parameters
        ----------
        pose : array_like, shape (6,) or (N, 6)
            Pose of the platform.

        Returns
        -------
        ndarray, shape (n,) or (N, n)
            Joint coordinates, rad or m.

        Raises
        ------
        ShapeError, ChartError, UnreachablePoseError
            See the class.

        Examples
        --------
        >>> robot.inverse_kinematics(robot.home_pose).round(12) + 0.0
        array([0., 0., 0., 0., 0., 0.])
        """
        return self._call("inverse_kinematics", self._poses(pose))[..., 0]

    def forward_kinematics(
        self, theta: ArrayLike, initial_pose: ArrayLike | None = None
    ) -> np.ndarray:
        """Pose at given joint coordinates, by Newton's method.

        Parameters
        ----------
        theta : array_like, shape (n,) or (N, n)
            Joint coordinates, rad or m.
        initial_pose : array_like, shape (6,) or (N, 6), optional
            Pose at which the search begins. The default is `home_pose`.

        Returns
        -------
        ndarray, shape (6,) or (N, 6)
            Pose of the platform.

        Raises
        ------
        ConvergenceError
            If no pose with these coordinates is found. The message has the leg and the residual.
        ShapeError, ChartError
            See the class.

        Examples
        --------
        >>> robot.forward_kinematics(np.zeros(6)).round(6) + 0.0
        array([0. , 0. , 0.2, 0. , 0. , 0. ])
        """
        return self.solve_forward_kinematics(theta, initial_pose).pose

    def solve_forward_kinematics(
        self, theta: ArrayLike, initial_pose: ArrayLike | None = None
    ) -> ForwardSolution:
        """Pose at given joint coordinates, with the number of iterations and the residual.

        Parameters
        ----------
        theta, initial_pose : array_like
            As for `forward_kinematics`.

        Returns
        -------
        ForwardSolution
            Pose, number of iterations, and residual of the joint coordinates, rad or m.

        Raises
        ------
        ConvergenceError, ShapeError, ChartError
            As for `forward_kinematics`.

        Examples
        --------
        >>> bool(robot.solve_forward_kinematics(np.full(6, 0.1)).residual.max() < 1e-9)
        True
        """
        theta = rows("theta", theta, self.layout.joints)
        start = self.home_pose
        if initial_pose is not None:
            start = self.charted(initial_pose, "initial_pose")
        return forward_kinematics.solve(self.functions, self.geometry.chart, theta, start)

    def assembly_modes(
        self, theta: ArrayLike | None = None, starts: int = 2000, seed: int = 0
    ) -> np.ndarray:
        """Poses in which the robot can be assembled with given joint coordinates.

        Newton's method searches from random starts. More starts can find more poses; a
        Gough-Stewart platform has up to 40 (Dietmaier, 1998). Poses with a leg that is folded the
        other way than at home are excluded, because they belong to another branch of the inverse
        kinematics.

        Parameters
        ----------
        theta : array_like, shape (n,), optional
            Joint coordinates, rad or m. The default is the coordinates at home.
        starts : int
            Number of random starts.
        seed : int
            Seed of the starts.

        Returns
        -------
        ndarray, shape (k, 6)
            Poses, sorted by the distances of their positions from home. k is 0 if none is found.

        Raises
        ------
        ShapeError, DynamicsError
            If an argument is not valid.

        Examples
        --------
        >>> robot.assembly_modes(starts=20).shape[1]
        6
        """
        joints = self.inverse_kinematics(self.home_pose) if theta is None else theta
        joints = floats("theta", joints, (self.layout.joints,))
        count = whole("starts", starts, DynamicsError, least=1)
        seed = whole("seed", seed, DynamicsError, least=0)
        geometry = self.geometry
        # radius of the search about the centre of the base joints
        centre = geometry.base_joints.mean(axis=0)
        spans = geometry.joints_at(self.home_pose) - geometry.base_joints
        reach = np.linalg.norm(spans, axis=1).max()
        radius = float(np.linalg.norm(geometry.base_joints - centre, axis=1).max() + reach)
        return forward_kinematics.assembly_modes(
            self.functions, geometry.chart, joints, centre, radius, count, seed
        )

    def joint_jacobian(self, pose: ArrayLike) -> np.ndarray:
        """Jacobian J_ad of the joints, with theta_dot = J_ad twist (eq. 8).

        Parameters
        ----------
        pose : array_like, shape (6,) or (N, 6)
            Pose of the platform.

        Returns
        -------
        ndarray, shape (n, 6) or (N, n, 6)
            Jacobian.

        Raises
        ------
        ShapeError, ChartError, UnreachablePoseError
            See the class.

        Examples
        --------
        >>> robot.joint_jacobian(robot.home_pose).shape
        (6, 6)
        """
        return self._call("joint_jacobian", self._poses(pose))

    def pose_jacobian(self, pose: ArrayLike) -> np.ndarray:
        """Jacobian J_theta of the joints, with theta_dot = J_theta pose_dot (eq. 29).

        Parameters
        ----------
        pose : array_like, shape (6,) or (N, 6)
            Pose of the platform.

        Returns
        -------
        ndarray, shape (n, 6) or (N, n, 6)
            Jacobian.

        Raises
        ------
        ShapeError, ChartError, UnreachablePoseError
            See the class.

        Examples
        --------
        >>> robot.pose_jacobian(robot.home_pose).shape
        (6, 6)
        """
        return self._call("pose_jacobian", self._poses(pose))

    def coordinate_jacobian(self, pose: ArrayLike) -> np.ndarray:
        """Jacobian of the joints with respect to the coordinates of the platform.

        Parameters
        ----------
        pose : array_like, shape (6,) or (N, 6)
            Pose of the platform.

        Returns
        -------
        ndarray, shape (n, m) or (N, n, m)
            Jacobian.

        Raises
        ------
        ShapeError, ChartError, UnreachablePoseError
            See the class.

        Examples
        --------
        >>> robot.coordinate_jacobian(robot.home_pose).shape
        (6, 6)
        """
        return self.pose_jacobian(pose) @ self.geometry.chart.basis
