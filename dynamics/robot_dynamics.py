"""Dynamics of a robot on NumPy arrays, for one state or a batch."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from dynamics.checks import row_text, rows
from dynamics.errors import SingularPoseError
from dynamics.robot_kinematics import RobotKinematics
from dynamics.robot_platform import CONDITION_LIMIT


class RobotDynamics(RobotKinematics):
    """Matrices, wrenches and torques of a robot. See `Robot`.

    An array of all parameters, such as an estimate, can be passed as dynamic parameters. Its gains
    have no effect.
    """

    def mass_matrix(self, pose: ArrayLike, parameters: ArrayLike | None = None) -> np.ndarray:
        """Mass matrix M of eq. 23.

        Parameters
        ----------
        pose : array_like, shape (6,) or (N, 6)
            Pose of the platform.
        parameters : array_like, shape (p,) or (N, p), optional
            Dynamic parameters, by default those of the set `guess`.

        Returns
        -------
        ndarray, shape (6, 6) or (N, 6, 6)
            Mass matrix for twists in the axes of the base.

        Raises
        ------
        ShapeError, ParameterError, ChartError, UnreachablePoseError
            See the class.

        Examples
        --------
        >>> mass = robot.mass_matrix(robot.home_pose)
        >>> np.array_equal(mass, mass.T)
        True
        """
        return self._call("mass_matrix", self._poses(pose), self._parameters(parameters))

    def coriolis_matrix(
        self, pose: ArrayLike, twist: ArrayLike, parameters: ArrayLike | None = None
    ) -> np.ndarray:
        """Coriolis matrix C of eq. 23.

        Parameters
        ----------
        pose, twist : array_like, shape (6,) or (N, 6)
            Pose and twist of the platform.
        parameters : array_like, shape (p,) or (N, p), optional
            Dynamic parameters, by default those of the set `guess`.

        Returns
        -------
        ndarray, shape (6, 6) or (N, 6, 6)
            Coriolis matrix. Its product with the twist is the Coriolis and centrifugal wrench.

        Raises
        ------
        ShapeError, ParameterError, ChartError, UnreachablePoseError
            See the class.

        Examples
        --------
        >>> robot.coriolis_matrix(robot.home_pose, np.zeros(6)).any()
        np.False_
        """
        twist = self._twists("twist", twist)
        return self._call("coriolis_matrix", self._poses(pose), twist, self._parameters(parameters))

    def gravity_wrench(self, pose: ArrayLike, parameters: ArrayLike | None = None) -> np.ndarray:
        """Wrench G of eq. 23, which balances gravity.

        Parameters
        ----------
        pose : array_like, shape (6,) or (N, 6)
            Pose of the platform.
        parameters : array_like, shape (p,) or (N, p), optional
            Dynamic parameters, by default those of the set `guess`.

        Returns
        -------
        ndarray, shape (6,) or (N, 6)
            Wrench at the origin of the platform, N and N m.

        Raises
        ------
        ShapeError, ParameterError, ChartError, UnreachablePoseError
            See the class.

        Examples
        --------
        >>> bool(robot.gravity_wrench(robot.home_pose)[2] > 0)
        True
        """
        poses = self._poses(pose)
        return self._call("gravity_wrench", poses, self._parameters(parameters))[..., 0]

    def friction_wrench(
        self, pose: ArrayLike, twist: ArrayLike, parameters: ArrayLike | None = None
    ) -> np.ndarray:
        """Wrench tau_f of eq. 24, with the exact sign function, which is zero at rest.

        Parameters
        ----------
        pose, twist : array_like, shape (6,) or (N, 6)
            Pose and twist of the platform.
        parameters : array_like, shape (p,) or (N, p), optional
            Dynamic parameters, by default those of the set `guess`.

        Returns
        -------
        ndarray, shape (6,) or (N, 6)
            Wrench at the origin of the platform, N and N m.

        Raises
        ------
        ShapeError, ParameterError, ChartError, UnreachablePoseError
            See the class.

        Examples
        --------
        >>> robot.friction_wrench(robot.home_pose, np.zeros(6)).any()
        np.False_
        """
        twist = self._twists("twist", twist)
        poses = self._poses(pose)
        return self._call("friction_wrench", poses, twist, self._parameters(parameters))[..., 0]

    def regressor(self, pose: ArrayLike, twist: ArrayLike, twist_dot: ArrayLike) -> np.ndarray:
        """Regressor Gamma of eq. 25. Its product with the parameters is the wrench tau_g.

        Parameters
        ----------
        pose, twist, twist_dot : array_like, shape (6,) or (N, 6)
            Pose of the platform, its twist, and the time derivative of the twist.

        Returns
        -------
        ndarray, shape (6, p) or (N, 6, p)
            Regressor of the wrench at the origin of the platform.

        Raises
        ------
        ShapeError, ChartError, UnreachablePoseError
            See the class.

        Examples
        --------
        >>> robot.regressor(robot.home_pose, np.zeros(6), np.zeros(6)).shape
        (6, 64)
        """
        twists = self._twists("twist", twist), self._twists("twist_dot", twist_dot)
        return self._call("regressor", self._poses(pose), *twists)

    def inverse_dynamics(
        self,
        pose: ArrayLike,
        twist: ArrayLike,
        twist_dot: ArrayLike,
        parameters: ArrayLike | None = None,
    ) -> np.ndarray:
        """Actuator torques of a motion (eq. 17 and 23).

        Parameters
        ----------
        pose, twist, twist_dot : array_like, shape (6,) or (N, 6)
            Pose of the platform, its twist, and the time derivative of the twist.
        parameters : array_like, shape (p,) or (N, p), optional
            Dynamic parameters, by default those of the set `guess`.

        Returns
        -------
        ndarray, shape (n,) or (N, n)
            Torques or forces, N m or N.

        Raises
        ------
        ShapeError, ParameterError, ChartError, UnreachablePoseError, SingularPoseError
            See the class.

        Examples
        --------
        >>> robot.inverse_dynamics(robot.home_pose, np.zeros(6), np.zeros(6)).shape
        (6,)
        """
        motion = self._twists("twist", twist), self._twists("twist_dot", twist_dot)
        poses = self._regular(pose)
        return self._call("inverse_dynamics", poses, *motion, self._parameters(parameters))[..., 0]

    def forward_dynamics(
        self,
        pose: ArrayLike,
        twist: ArrayLike,
        torque: ArrayLike,
        parameters: ArrayLike | None = None,
    ) -> np.ndarray:
        """Acceleration under actuator torques, with the exact sign function in friction (eq. 40).

        Parameters
        ----------
        pose, twist : array_like, shape (6,) or (N, 6)
            Pose and twist of the platform.
        torque : array_like, shape (n,) or (N, n)
            Torques or forces, N m or N.
        parameters : array_like, shape (p,) or (N, p), optional
            Dynamic parameters, by default those of the set `guess`.

        Returns
        -------
        ndarray, shape (6,) or (N, 6)
            Time derivative of the twist, m/s^2 and rad/s^2.

        Raises
        ------
        ShapeError, ParameterError, ChartError, UnreachablePoseError, SingularPoseError
            See the class.

        Examples
        --------
        >>> holding = robot.static_torque(robot.home_pose)
        >>> twist_dot = robot.forward_dynamics(robot.home_pose, np.zeros(6), holding)
        >>> bool(np.abs(twist_dot).max() < 1e-10)
        True
        """
        twist = self._twists("twist", twist)
        torque = rows("torque", torque, self.layout.joints)
        poses = self._regular(pose)
        return self._call("forward_dynamics", poses, twist, torque, self._parameters(parameters))[
            ..., 0
        ]

    def static_torque(self, pose: ArrayLike, parameters: ArrayLike | None = None) -> np.ndarray:
        """Actuator torques that hold the robot at rest without friction.

        Parameters
        ----------
        pose : array_like, shape (6,) or (N, 6)
            Pose of the platform.
        parameters : array_like, shape (p,) or (N, p), optional
            Dynamic parameters, by default those of the set `guess`.

        Returns
        -------
        ndarray, shape (n,) or (N, n)
            Torques or forces, N m or N.

        Raises
        ------
        ShapeError, ParameterError, ChartError, UnreachablePoseError, SingularPoseError
            See the class.

        Examples
        --------
        >>> robot.static_torque(robot.home_pose).shape
        (6,)
        """
        poses = rows("pose", pose, 6)
        # with the exact sign function, friction is zero at rest
        rest = np.zeros_like(poses)
        return self.inverse_dynamics(poses, rest, rest, parameters)

    def _regular(self, pose: ArrayLike) -> np.ndarray:
        """Poses as an array, after a check that they are in reach and not singular."""
        poses = self._poses(pose)
        jacobian = self._call("joint_jacobian", poses) @ self.geometry.chart.basis
        condition = np.atleast_1d(np.linalg.cond(jacobian))
        if not (condition < CONDITION_LIMIT).all():
            index = int(np.argmax(~(condition < CONDITION_LIMIT)))
            raise SingularPoseError(
                f"the robot is singular at pose {row_text(np.atleast_2d(poses)[index])}: condition "
                f"of J_ad {condition[index]:.3g}, limit {CONDITION_LIMIT:.0e}"
            )
        return poses

    def _parameters(self, parameters: ArrayLike | None) -> np.ndarray:
        """Dynamic parameters as an array, by default `nominal_parameters`."""
        if parameters is None:
            return self.nominal_parameters
        return self.layout.check(self.layout.without_gains(parameters), batch=True)
