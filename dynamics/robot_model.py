"""Model of a robot with fixed parameters: torques of a motion, CasADi functions, MJCF and URDF."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from dynamics.checks import floats, rows
from dynamics.engines.mjcf import mjcf_text
from dynamics.engines.urdf import urdf_texts
from dynamics.errors import ShapeError
from dynamics.inertia import warn_of_changes
from dynamics.kinematics.platform import pose_rate_to_twist
from dynamics.robot import Robot


@dataclass(frozen=True, eq=False)
class RobotModel:
    """Robot whose dynamic parameters are fixed to its nominal ones, such as an identified robot.

    Attributes
    ----------
    robot : Robot
        Robot with its nominal parameters.
    source : str
        Source of the parameters, for the headers of files.

    Examples
    --------
    >>> from dynamics import RobotModel
    >>> model = RobotModel(robot)
    >>> rest = np.zeros(6)
    >>> np.allclose(model.tau(robot.home_pose, rest, rest), robot.static_torque(robot.home_pose))
    True
    """

    robot: Robot
    source: str = "nominal parameters"

    def tau(self, pose: ArrayLike, twist: ArrayLike, twist_dot: ArrayLike) -> np.ndarray:
        """Actuator torques of a motion of the platform. See `Robot.inverse_dynamics`.

        Parameters
        ----------
        pose, twist, twist_dot : array_like, shape (6,) or (N, 6)
            Pose of the platform, its twist, and the time derivative of the twist.

        Returns
        -------
        ndarray, shape (n,) or (N, n)
            Torques or forces, N m or N.

        Raises
        ------
        DynamicsError
            If an array has a wrong shape, or a pose is out of reach or singular.
        """
        return self.robot.inverse_dynamics(pose, twist, twist_dot)

    def tau_of_joints(
        self,
        theta: ArrayLike,
        theta_dot: ArrayLike,
        theta_ddot: ArrayLike,
        initial_pose: ArrayLike | None = None,
    ) -> np.ndarray:
        """Actuator torques of a motion in joint coordinates.

        Parameters
        ----------
        theta, theta_dot, theta_ddot : array_like, shape (n,) or (N, n)
            Joint coordinates, rad or m, and their time derivatives.
        initial_pose : array_like, shape (6,) or (N, 6), optional
            Pose at which the search for the pose begins. The default is the home pose.

        Returns
        -------
        ndarray, shape (n,) or (N, n)
            Torques or forces, N m or N.

        Raises
        ------
        ConvergenceError
            If no pose with these coordinates is found.
        DynamicsError
            If an array has a wrong shape, or the pose is singular.

        Examples
        --------
        >>> from dynamics import RobotModel
        >>> rest = np.zeros(6)
        >>> held = RobotModel(robot).tau_of_joints(rest, rest, rest)
        >>> np.allclose(held, robot.static_torque(robot.home_pose), atol=1e-6)
        True
        """
        return self.tau(*self.platform_motion(theta, theta_dot, theta_ddot, initial_pose))

    def platform_motion(
        self,
        theta: ArrayLike,
        theta_dot: ArrayLike,
        theta_ddot: ArrayLike,
        initial_pose: ArrayLike | None = None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pose, twist and twist_dot of the platform for a motion in joint coordinates.

        For parameters and errors see `tau_of_joints`.
        """
        theta = rows("theta", theta, self.robot.layout.joints)
        rate, acceleration = (
            floats(name, value, theta.shape, error=ShapeError)
            for name, value in (("theta_dot", theta_dot), ("theta_ddot", theta_ddot))
        )
        pose = self.robot._regular(self.robot.forward_kinematics(theta, initial_pose))
        basis = self.robot.geometry.chart.basis
        jacobian = self.robot.joint_jacobian(pose) @ basis
        twist = _solved(jacobian, rate) @ basis.T
        # a CasADi function takes one motion per column
        bias = self._bias_acceleration(pose.T, twist.T).full().T.reshape(acceleration.shape)
        return pose, twist, _solved(jacobian, acceleration - bias) @ basis.T

    @cached_property
    def _bias_acceleration(self) -> ca.Function:
        """Accelerations J_dot twist of the joints in a motion without twist_dot."""
        pose = ca.SX.sym("pose", 6)
        twist = ca.SX.sym("twist", 6)
        rates = self.robot.casadi("joint_jacobian")(pose) @ twist
        pose_rate = ca.solve(pose_rate_to_twist(pose), twist)
        return ca.Function("bias", [pose, twist], [ca.jtimes(rates, pose, pose_rate)])

    def casadi(self, name: str) -> ca.Function:
        """CasADi function with the parameters of this model in place of the input `parameters`.

        Parameters
        ----------
        name : str
            See `Robot.casadi`.

        Returns
        -------
        casadi.Function
            Function with named inputs and outputs. Vectors are columns.

        Raises
        ------
        DynamicsError
            If there is no function of that name. The message lists the valid names.

        Examples
        --------
        >>> from dynamics import RobotModel
        >>> RobotModel(robot).casadi("inverse_dynamics").name_in()
        ['pose', 'twist', 'twist_dot']
        """
        function = self.robot.casadi(name)
        if "parameters" not in function.name_in():
            return function
        inputs = {
            key: ca.SX.sym(key, function.size1_in(key))
            for key in function.name_in()
            if key != "parameters"
        }
        results = function.call(inputs | {"parameters": ca.DM(self.robot.nominal_parameters)})
        names = function.name_out()
        return ca.Function(
            name, list(inputs.values()), [results[key] for key in names], list(inputs), names
        )

    def mjcf(self, allow_unphysical_inertia: bool = False) -> str:
        """MJCF text of the model, a closed chain that MuJoCo loads.

        Parameters
        ----------
        allow_unphysical_inertia : bool
            True writes a body that breaks Ix + Iy >= Iz with the nearest possible inertia, and
            warns of it.

        Returns
        -------
        str
            Text of the file.

        Raises
        ------
        ParameterError
            If a body breaks Ix + Iy >= Iz and this is not allowed.
        """
        if allow_unphysical_inertia:
            warn_of_changes(self.robot)
        return mjcf_text(
            self.robot, allow_unphysical_inertia=allow_unphysical_inertia, source=self.source
        )

    def urdf(self, allow_unphysical_inertia: bool = False) -> tuple[str, str]:
        """URDF text of the model, and YAML text of the closures of its loops.

        Parameters
        ----------
        allow_unphysical_inertia : bool
            As for `mjcf`.

        Returns
        -------
        tuple of str
            Texts of both files. `cmmsim import urdf` reads them.

        Raises
        ------
        ParameterError
            As for `mjcf`.
        """
        if allow_unphysical_inertia:
            warn_of_changes(self.robot)
        return urdf_texts(self.robot, allow_unphysical_inertia=allow_unphysical_inertia)


def _solved(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Solutions (..., m) of square systems of equations."""
    solutions: np.ndarray = np.linalg.solve(matrices, vectors[..., None])[..., 0]
    return solutions
