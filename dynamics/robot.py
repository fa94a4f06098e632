"""Robot with its kinematics and dynamics on NumPy arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import casadi as ca
from numpy.typing import ArrayLike

from dynamics.checks import check_choice, check_type, flag, floats
from dynamics.errors import DynamicsError, RobotFileError
from dynamics.geometry import RobotGeometry
from dynamics.parameter_set import ParameterSet
from dynamics.robot_dynamics import RobotDynamics
from dynamics.robot_file import RobotDescription, read_robot_file
from dynamics.robot_functions import CASADI, casadi_function


def load_robot(name_or_path: str | Path) -> Robot:
    """Load a built-in robot, or the robot of a TOML file.

    Parameters
    ----------
    name_or_path : str or Path
        Name of a built-in robot (see `built_in_robots`) or path of a robot file.

    Returns
    -------
    Robot
        The robot.

    Raises
    ------
    RobotFileError
        If there is no such robot, or if its file is not valid.

    Examples
    --------
    >>> import dynamics
    >>> dynamics.load_robot("rss6")
    Robot('rss6', 64 parameters and 3 gains, sets: guess, truth)
    """
    return Robot(read_robot_file(name_or_path))


class Robot(RobotDynamics):
    """Kinematics and dynamics of a robot with n joints, m coordinates and p dynamic parameters.

    A pose (6,) is [x y z alpha beta gamma] of the platform in the frame of the base (eq. 1). A
    twist (6,) is [h_dot, omega] in the axes of the base. The m coordinates are the entries of the
    pose that the platform can change. Joint coordinates are angles. If the actuators slide, joint
    coordinates are lengths, and N and N s/m replace N m and N m s/rad. All units are SI.

    Unless stated otherwise, methods also accept batches with a leading axis, such as (N, 6). Their
    results then have this axis, too. If `parameters` is None, they use `nominal_parameters`.

    Attributes
    ----------
    name : str
        Name of the robot.
    parameter_names : tuple of str
        Names of the p dynamic parameters, such as "platform.mass" and "joint1.coulomb".
    nominal_parameters : ndarray, shape (p,)
        The set `guess` of the robot file.
    parameter_sets : dict
        All sets of the robot file by name. `parameter_sets["truth"].dynamic` are the dynamic
        parameters of a set, `.joint_pid` its gains, and `.vector` both.
    layout : ParameterLayout
        Names, order and units of the parameters.
    geometry : RobotGeometry
        Joints, legs and chart.
    functions_of : RobotGeometry
        Geometry whose compiled functions the robot uses. See `moved`.

    Raises
    ------
    ShapeError
        If an array has a wrong shape, or entries that are not finite.
    ParameterError
        If a parameter is outside its range.
    ChartError
        If the platform cannot have a pose or a twist.
    UnreachablePoseError
        If a pose is out of the reach of a leg.
    SingularPoseError
        If a Jacobian is singular, or a result is not finite.

    Examples
    --------
    >>> import numpy as np
    >>> from dynamics import load_robot
    >>> robot = load_robot("rss6")
    >>> robot.home_pose
    array([0. , 0. , 0.2, 0. , 0. , 0. ])
    """

    def casadi(self, name: str) -> ca.Function:
        """CasADi function of the kinematics or dynamics, for a controller or an optimiser.

        The function has the same equations as the method of the same name. It checks no arguments.
        For a pose that a leg cannot reach, it returns NaN or numbers without a meaning. The output
        `reach_margin` of inverse_kinematics is negative there.

        Parameters
        ----------
        name : str
            inverse_kinematics, joint_jacobian, pose_jacobian, mass_matrix, coriolis_matrix,
            gravity_wrench, friction_wrench, regressor, inverse_dynamics or forward_dynamics. The
            last four are not smooth where a joint is at rest, because of the sign of its friction.

        Returns
        -------
        casadi.Function
            Function with named inputs and outputs. Vectors are columns. Functions of the dynamics
            have the parameters (p,) as an input.

        Raises
        ------
        DynamicsError
            If there is no function of that name. The message lists the valid names.

        Examples
        --------
        >>> torques = robot.casadi("inverse_dynamics")
        >>> torques.name_in()
        ['pose', 'twist', 'twist_dot', 'parameters']
        >>> rest = np.zeros(6)
        >>> found = torques(robot.home_pose, rest, rest, robot.nominal_parameters)
        >>> np.allclose(found.full().ravel(), robot.static_torque(robot.home_pose))
        True
        """
        check_choice("CasADi function", name, tuple(CASADI), DynamicsError)
        return casadi_function(self.geometry, name)

    def moved(self, deviations: ArrayLike) -> Robot:
        """Robot with changed geometric numbers.

        All robots that this method makes from one robot share functions, which are compiled once.
        They are a third slower than the functions of a robot loaded from a file.

        Parameters
        ----------
        deviations : array_like, shape (g,)
            Changes of the numbers in the order of `geometry.number_names`, m and rad.

        Returns
        -------
        Robot
            The changed robot.

        Raises
        ------
        RobotFileError
            If a leg no longer reaches the home pose.
        ShapeError
            See the class.

        Examples
        --------
        >>> robot.moved(np.zeros(len(robot.geometry.number_names))).name
        'rss6'
        """
        count = len(self.geometry.number_names)
        geometry = self.geometry.moved(floats("deviations", deviations, (count,)))
        return Robot(RobotDescription(self.name, geometry, self.parameter_sets), self.functions_of)

    def with_parameters(self, parameters: ArrayLike, name: str = "guess") -> Robot:
        """Robot with other nominal parameters, such as identified ones.

        Parameters
        ----------
        parameters : array_like, shape (p + 3,)
            Dynamic parameters, then lp, li, ld of the joint controller. If each joint has its own
            gains, the shape is (p + 3 n,).
        name : str
            Name of the parameter set. The set is also `guess`, which each robot has.

        Returns
        -------
        Robot
            Robot of the same geometry with this one parameter set.

        Raises
        ------
        ShapeError, ParameterError
            If the parameters are not valid.

        Examples
        --------
        >>> truth = robot.parameter_sets["truth"]
        >>> other = robot.with_parameters(truth.vector)
        >>> np.array_equal(other.nominal_parameters, truth.dynamic)
        True
        """
        count = len(self.parameter_names)
        values = floats("parameters", parameters, (len(self.layout.names),))
        dynamic = self.layout.check(values[:count])
        named = ParameterSet(dynamic, values[count:])
        # each robot has a guess, whose values are the nominal ones
        sets = {"guess": named, name: named}
        return Robot(RobotDescription(self.name, self.geometry, sets), self.functions_of)

    def with_full_bodies(self, names: Sequence[str]) -> Robot:
        """Robot whose named bodies are full bodies, with ten inertial parameters each.

        All other bodies are centred, with four. A body that becomes a full body moves as before,
        because its new parameters are zero. A body that becomes centred loses its first moments
        and products of inertia.

        Parameters
        ----------
        names : sequence of str
            Names of bodies such as "link3", of kinds of bodies such as "link", or "all".

        Returns
        -------
        Robot
            The other robot, or this robot if nothing changes.

        Raises
        ------
        ParameterError
            If there is no such body. The message lists the valid names.

        Examples
        --------
        >>> robot.with_full_bodies(["platform"]).parameter_names[:4]
        ('platform.mass', 'platform.mcx', 'platform.mcy', 'platform.mcz')
        """
        return self._in_form(full_bodies=tuple(names))

    def with_own_gains(self, own: bool = True) -> Robot:
        """Robot whose joints each have their own gains, or whose joints share them.

        Shared gains become the gains of each joint. Gains that become shared are the mean of those
        of all joints.

        Parameters
        ----------
        own : bool
            True for own gains, False for shared gains.

        Returns
        -------
        Robot
            The other robot, or this robot if nothing changes.

        Raises
        ------
        DynamicsError
            If the argument is neither True nor False.

        Examples
        --------
        >>> robot.with_own_gains().layout.joint_pid_names[:4]
        ('joint1.lp', 'joint1.li', 'joint1.ld', 'joint2.lp')
        """
        return self._in_form(own_gains=flag("own", own, DynamicsError))

    @lru_cache(maxsize=64)  # noqa: B019 - users ask for the same few forms of a few robots
    def _in_form(self, **form: Any) -> Robot:
        """Robot with another form of its parameters. `form` has the changed fields of its geometry.

        The robot is cached, because results such as base parameters are cached by robot.
        """
        geometry = replace(self.geometry, **form)
        layout = self.layout
        new_layout = geometry.layout
        if new_layout == layout:
            return self
        sets = {
            name: ParameterSet(
                layout.converted(old.dynamic, new_layout),
                layout.converted_gains(old.joint_pid, new_layout),
            )
            for name, old in self.parameter_sets.items()
        }
        # functions of the robot's own geometry are faster than those shared by `moved`
        has_own_functions = self.functions_of is self.geometry
        nominal = None if has_own_functions else replace(self.functions_of, **form)
        return Robot(RobotDescription(self.name, geometry, sets), nominal)

    def with_passive_friction(self, names: Sequence[str]) -> Robot:
        """Robot whose passive joints have friction, with one parameter for each name.

        A passive joint has the name of the body that follows it on the way to the platform. The
        parameter "link_joint.viscous" is shared by the joints of all legs, and the parameter
        "link3_joint.viscous" is for one leg. The friction is viscous or dry, see
        `rigid_body.passive_friction`. A parameter of one leg begins with the value that all legs
        shared, a shared one with the mean over the legs, and a new one with zero. Friction that is
        not named is lost.

        Parameters
        ----------
        names : sequence of str
            Names of parameters, such as "link_joint.viscous" or "platform_joint.coulomb".

        Returns
        -------
        Robot
            The other robot, or this robot if nothing changes.

        Raises
        ------
        ParameterError
            If there is no such parameter, or if a joint gets both its own parameter and that of all
            legs. The message lists the valid names.

        Examples
        --------
        >>> robot.with_passive_friction(["link_joint.viscous"]).layout.passive_names
        ('link_joint.viscous',)
        """
        return self._in_form(passive_friction=tuple(names))

    def with_geometry(self, geometry: RobotGeometry) -> Robot:
        """Robot with another geometry of the same kinds of legs. Its functions are compiled anew.

        Parameters
        ----------
        geometry : RobotGeometry
            The other geometry.

        Returns
        -------
        Robot
            The other robot, or this robot if the geometry is the same object.

        Raises
        ------
        RobotFileError
            If the argument is not a RobotGeometry.

        Examples
        --------
        >>> robot.with_geometry(robot.geometry) is robot
        True
        """
        check_type("geometry", geometry, RobotGeometry, RobotFileError)
        if geometry is self.geometry:
            return self
        return Robot(RobotDescription(self.name, geometry, self.parameter_sets))
