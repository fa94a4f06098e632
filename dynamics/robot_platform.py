"""Names, poses, twists and reach of a robot, for one pose or a batch."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from dynamics.checks import check_type, row_text, rows
from dynamics.compiled.machine_code import Functions
from dynamics.errors import (
    ChartError,
    RobotFileError,
    ShapeError,
    SingularPoseError,
    UnreachablePoseError,
)
from dynamics.geometry import RobotGeometry
from dynamics.kinematics.platform import POSE_NAMES
from dynamics.parameter_set import ParameterSet
from dynamics.robot_file import RobotDescription
from dynamics.robot_functions import nearby_functions, own_functions

# Condition number beyond which a Jacobian counts as singular. Usual robots have about 1e2.
CONDITION_LIMIT = 1e10
# Largest deviation of a pose or twist from the allowed ones that counts as rounding. It is in m,
# rad, m/s or rad/s.
CHART_TOLERANCE = 1e-9


class RobotPlatform:
    """Names, poses, twists and reach of a robot. See `Robot`."""

    def __init__(self, description: RobotDescription, nominal: RobotGeometry | None = None) -> None:
        """Make a robot from its description.

        If a nearby geometry `nominal` is given, its functions are used.
        """
        check_type("description", description, RobotDescription, RobotFileError)
        self.name = description.name
        self.geometry = description.geometry
        # robots made by `moved` share the functions of the nominal geometry
        self.functions_of = nominal or description.geometry
        self.parameter_sets: dict[str, ParameterSet] = description.parameter_sets
        self.layout = self.geometry.layout
        self.parameter_names = self.layout.dynamic_names
        self.nominal_parameters = description.parameter_sets["guess"].dynamic

    def __repr__(self) -> str:
        dynamic = len(self.parameter_names)
        gains = len(self.layout.names) - dynamic
        sets = ", ".join(self.parameter_sets)
        return f"Robot({self.name!r}, {dynamic} parameters and {gains} gains, sets: {sets})"

    @property
    def home_pose(self) -> np.ndarray:
        """Pose (6,) of the platform at home."""
        return self.geometry.home_pose

    @property
    def travel_limit(self) -> float:
        """Largest allowed magnitude of a joint coordinate, rad or m."""
        return self.geometry.travel_limit

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the n actuated joints."""
        return self.layout.joint_names

    @property
    def coordinate_names(self) -> tuple[str, ...]:
        """Names of the m coordinates of the platform."""
        return self.geometry.chart.coordinate_names

    @property
    def functions(self) -> Functions:
        """Compiled functions by name. They are compiled at their first use, in two parts."""
        if self.functions_of is self.geometry:
            return own_functions(self.geometry)
        return nearby_functions(self.functions_of, self.geometry)

    def pose(self, coordinates: ArrayLike) -> np.ndarray:
        """Pose of the platform at given coordinates.

        Parameters
        ----------
        coordinates : array_like, shape (m,) or (N, m)
            Coordinates of the platform in the order of `coordinate_names`.

        Returns
        -------
        ndarray, shape (6,) or (N, 6)
            Pose. The entries that the platform cannot change have their values at home.

        Raises
        ------
        ShapeError
            If the shape is wrong.

        Examples
        --------
        >>> robot.pose(np.zeros(6))
        array([0., 0., 0., 0., 0., 0.])
        """
        values = rows("coordinates", coordinates, len(self.coordinate_names))
        return self.geometry.chart.pose(values)

    def coordinates(self, pose: ArrayLike) -> np.ndarray:
        """Coordinates of the platform at a true or measured pose.

        Parameters
        ----------
        pose : array_like, shape (6,) or (N, 6)
            Pose. The entries that the platform cannot change are ignored.

        Returns
        -------
        ndarray, shape (m,) or (N, m)
            Coordinates in the order of `coordinate_names`.

        Raises
        ------
        ShapeError
            If the shape is wrong.

        Examples
        --------
        >>> robot.coordinates(robot.home_pose)
        array([0. , 0. , 0.2, 0. , 0. , 0. ])
        """
        return self.geometry.chart.coordinates(rows("pose", pose, 6))

    def twist(self, pose: ArrayLike, pose_rate: ArrayLike) -> np.ndarray:
        """Twist for a pose rate (eq. 2).

        Parameters
        ----------
        pose, pose_rate : array_like, shape (6,) or (N, 6)
            Pose and its time derivative.

        Returns
        -------
        ndarray, shape (6,) or (N, 6)
            Twist [h_dot, omega] in the axes of the base, m/s and rad/s.

        Raises
        ------
        ShapeError
            See the class.

        Examples
        --------
        >>> robot.twist(robot.home_pose, np.ones(6))
        array([1., 1., 1., 1., 1., 1.])
        """
        return self._call("twist", rows("pose", pose, 6), rows("pose_rate", pose_rate, 6))[..., 0]

    def twist_dot(
        self, pose: ArrayLike, pose_rate: ArrayLike, pose_acceleration: ArrayLike
    ) -> np.ndarray:
        """Time derivative of the twist (eq. 38).

        Parameters
        ----------
        pose, pose_rate, pose_acceleration : array_like, shape (6,) or (N, 6)
            Pose and its first and second time derivatives.

        Returns
        -------
        ndarray, shape (6,) or (N, 6)
            Time derivative of the twist, m/s^2 and rad/s^2.

        Raises
        ------
        ShapeError
            See the class.

        Examples
        --------
        >>> robot.twist_dot(robot.home_pose, np.zeros(6), np.ones(6))
        array([1., 1., 1., 1., 1., 1.])
        """
        rate = rows("pose_rate", pose_rate, 6)
        acceleration = rows("pose_acceleration", pose_acceleration, 6)
        return self._call("twist_dot", rows("pose", pose, 6), rate, acceleration)[..., 0]

    def pose_rate(self, pose: ArrayLike, twist: ArrayLike) -> np.ndarray:
        """Pose rate for a twist. This is the inverse of `twist`.

        Parameters
        ----------
        pose, twist : array_like, shape (6,) or (N, 6)
            Pose and twist of the platform.

        Returns
        -------
        ndarray, shape (6,) or (N, 6)
            Time derivative of the pose, m/s and rad/s.

        Raises
        ------
        SingularPoseError
            If beta is pi/2 or -pi/2, because Euler rates are then undefined.
        ShapeError
            See the class.

        Examples
        --------
        >>> robot.pose_rate(robot.home_pose, np.ones(6))
        array([1., 1., 1., 1., 1., 1.])
        """
        poses = rows("pose", pose, 6)
        cosine = np.abs(np.cos(poses[..., 4]))
        if not (cosine > 1 / CONDITION_LIMIT).all():
            raise SingularPoseError(
                f"Euler rates are singular at beta = +-pi/2: |cos(beta)| is {cosine.min():.3g}"
            )
        return self._call("pose_rate", poses, rows("twist", twist, 6))[..., 0]

    def reach_margin(self, pose: ArrayLike) -> np.ndarray:
        """Margin of each leg to the limit of its reach.

        The margin has no unit and is at most 1. For a crank, it is sin^2 of the angle between the
        crank and the direction to the platform joint in the plane of the crank.

        Parameters
        ----------
        pose : array_like, shape (6,) or (N, 6)
            Pose of the platform.

        Returns
        -------
        ndarray, shape (n,) or (N, n)
            Margins. They are negative out of reach, and -inf if squares overflow.

        Raises
        ------
        ShapeError, ChartError
            See the class.

        Examples
        --------
        >>> (robot.reach_margin(robot.home_pose) > 0).all()
        np.True_
        """
        return self._margins(self.charted(pose))

    def check_reach(self, pose: ArrayLike, name: str = "pose", row: str = "row") -> None:
        """Check that all legs reach a pose.

        Parameters
        ----------
        pose : array_like, shape (6,) or (N, 6)
            Pose of the platform.
        name, row : str
            Words for the pose and for its row in the error message.

        Raises
        ------
        UnreachablePoseError
            If a leg cannot reach a pose. The message has the first leg and pose out of reach.
        ShapeError, ChartError
            See the class.

        Examples
        --------
        >>> robot.check_reach(robot.home_pose)
        """
        poses = np.atleast_2d(self.charted(pose, name))
        margin = self._margins(poses)
        if (margin > 0).all():
            return
        index, leg = (int(value) for value in np.argwhere(~(margin > 0))[0])
        where = f" ({row} {index})" if np.ndim(pose) > 1 else ""
        raise UnreachablePoseError(
            f"leg {leg + 1} cannot reach {name} {row_text(poses[index])}{where}: reach margin "
            f"{margin[index, leg]:.3g}, must be > 0"
        )

    def charted(self, pose: ArrayLike, name: str = "pose") -> np.ndarray:
        """Poses as an array, after a check that the platform can have them.

        Parameters
        ----------
        pose : array_like, shape (6,) or (N, 6)
            Pose of the platform.
        name : str
            Word for the pose in the error message.

        Returns
        -------
        ndarray, shape (6,) or (N, 6)
            The poses.

        Raises
        ------
        ShapeError, ChartError
            See the class.

        Examples
        --------
        >>> robot.charted([0, 0, 0.2, 0, 0, 0])
        array([0. , 0. , 0.2, 0. , 0. , 0. ])
        """
        poses = rows(name, pose, 6)
        self._check_chart(name, poses, self.geometry.chart.forbidden(poses))
        return poses

    def _margins(self, poses: np.ndarray) -> np.ndarray:
        """Reach margins of poses that the platform can have."""
        margin = self._call("inverse_kinematics", poses, output=1)[..., 0]
        # a leg with a NaN margin does not reach, but comparisons with NaN are always False
        return np.where(np.isnan(margin), -np.inf, margin)

    def _poses(self, pose: ArrayLike) -> np.ndarray:
        """Poses as an array, after a check that all legs reach them."""
        poses = rows("pose", pose, 6)
        self.check_reach(poses)
        return poses

    def _twists(self, name: str, value: ArrayLike) -> np.ndarray:
        """Twists as an array, after a check that the platform can have them."""
        twists = rows(name, value, 6)
        basis = self.geometry.chart.basis
        self._check_chart(name, twists, twists - twists @ basis @ basis.T)
        return twists

    def _check_chart(self, name: str, values: np.ndarray, forbidden: np.ndarray) -> None:
        """Raise ChartError if the platform cannot have a pose or twist."""
        if np.abs(forbidden).max(initial=0.0) <= CHART_TOLERANCE:
            return
        names = ", ".join(self.coordinate_names)
        deviations = np.atleast_2d(forbidden)
        entry = int(np.argmax(np.abs(deviations).max(axis=0)))
        row = int(np.argmax(np.abs(deviations[:, entry])))
        raise ChartError(
            f"the platform of {self.name} moves in {names} only: {name} "
            f"{row_text(np.atleast_2d(values)[row])} is {deviations[row, entry]:.3g} off in "
            f"{POSE_NAMES[entry]}"
        )

    def _call(self, name: str, *arguments: np.ndarray, output: int = 0) -> np.ndarray:
        """Output (rows, columns) of a function, or (N, rows, columns) if an argument is a batch.

        Raises ShapeError for unequal batches, and SingularPoseError if output 0 is not finite.
        """
        batched = [argument.shape[0] for argument in arguments if argument.ndim == 2]
        if len(set(batched) - {1}) > 1:
            shapes = ", ".join(str(argument.shape) for argument in arguments)
            raise ShapeError(f"{name}: batch lengths differ, shapes {shapes}")
        results = self.functions[name](*[np.atleast_2d(argument) for argument in arguments])
        values = results[output]
        if output == 0 and not np.isfinite(values).all():
            inputs_text = ", ".join(row_text(argument) for argument in arguments)
            raise SingularPoseError(
                f"{name} is not finite for {inputs_text}: singular pose or mass matrix"
            )
        return values if batched else values[0]
