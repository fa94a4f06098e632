"""A robot as its users call it: kinematics and dynamics on NumPy arrays, one pose or a batch of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from dynamics.checks import check_type, floats, row_text, rows, whole
from dynamics.compiled.machine_code import MachineFunction
from dynamics.errors import (
    ChartError,
    DynamicsError,
    RobotFileError,
    ShapeError,
    SingularPoseError,
    UnreachablePoseError,
)
from dynamics.geometry import RobotGeometry
from dynamics.kinematics import forward_kinematics
from dynamics.kinematics.chart import POSE_NAMES
from dynamics.kinematics.forward_kinematics import ForwardSolution
from dynamics.parameters import parameter_layout
from dynamics.robot_file import ParameterSet, RobotDescription, read_robot_file
from dynamics.robot_functions import nearby_functions, own_functions

# Below this the solution of M a = f loses all digits; a healthy robot is near 1e2 (poses in m and rad).
CONDITION_LIMIT = 1e10

# m or rad, and m/s or rad/s: a pose or a twist farther from what the chart allows contradicts it.
CHART_TOLERANCE = 1e-9


def load_robot(name_or_path: str | Path) -> Robot:
    """A built-in robot by name, or the one in a TOML robot file. Raises RobotFileError (see `read_robot_file`)."""
    return Robot(read_robot_file(name_or_path))


class Robot:
    """Kinematics and virtual-work dynamics of one robot, with n joints, p dynamic parameters and m coordinates.

    Poses (6,) are [x y z alpha beta gamma] of the platform in the base frame (eq. 1), of every robot; twists
    [h_dot, omega] in base axes; SI units and rad. What of a pose the platform can change are its coordinates (m,), see
    `pose` and `coordinates`; joint coordinates (n,) are angles, or lengths where actuators slide (then N and N s/m take
    the place of N m and N m s/rad). Every method also takes batches with a leading axis (N, 6), and then returns one
    more axis. `parameters` (p,) or (N, p) follow `parameter_names`, such as "platform.mass" and "joint1.coulomb"; None
    means `nominal_parameters`, the set `initial`. `parameter_sets` has all sets of the file by name, `layout` where
    each parameter stands and its unit, `geometry` joints, legs and chart, `functions_of` the geometry that
    it was moved from, its own where it was not.

    Methods raise ShapeError for wrong shapes or entries that are not finite, ParameterError for parameters outside
    their range, ChartError for a pose or a twist that the platform cannot have, UnreachablePoseError for a pose beyond
    a leg's reach, SingularPoseError where a Jacobian is singular.
    """

    def __init__(self, description: RobotDescription, nominal: RobotGeometry | None = None) -> None:
        """nominal: a geometry nearby, whose functions serve this one, too; None: it has functions of its own."""
        check_type("description", description, RobotDescription, RobotFileError)
        self.name = description.name
        self.geometry = description.geometry
        self.functions_of = nominal or description.geometry
        self.parameter_sets: dict[str, ParameterSet] = description.parameter_sets
        self.layout = parameter_layout(self.geometry.legs)
        self.parameter_names = self.layout.dynamic_names
        self.nominal_parameters = description.parameter_sets["initial"].dynamic

    def __repr__(self) -> str:
        return f"Robot({self.name!r}, {len(self.parameter_names)} parameters, sets: {', '.join(self.parameter_sets)})"

    @property
    def home_pose(self) -> np.ndarray:
        """Pose (6,) of the platform at home."""
        return self.geometry.home_pose

    @property
    def travel_limit(self) -> float:
        """Largest magnitude of a joint coordinate allowed, rad or m."""
        return self.geometry.travel_limit

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the actuated joints (n)."""
        return self.layout.joint_names

    @property
    def coordinate_names(self) -> tuple[str, ...]:
        """Names of the platform's coordinates (m)."""
        return self.geometry.chart.coordinate_names

    def pose(self, coordinates: ArrayLike) -> np.ndarray:
        """Pose (6,) of coordinates (m,)."""
        return self.geometry.chart.pose(rows("coordinates", coordinates, len(self.coordinate_names)))

    def coordinates(self, pose: ArrayLike) -> np.ndarray:
        """Coordinates (m,) of a pose (6,), such as a measured one; what the platform cannot change is left out."""
        return self.geometry.chart.coordinates(rows("pose", pose, 6))

    def inverse_kinematics(self, pose: ArrayLike) -> np.ndarray:
        """Joint coordinates (n,), rad or m, in closed form (eq. 3 and 4)."""
        pose = self._poses(pose)
        return self._call("inverse_kinematics", pose)[..., 0]

    def forward_kinematics(self, theta: ArrayLike, initial_pose: ArrayLike | None = None) -> np.ndarray:
        """Pose (6,) of joint coordinates (n,) by Newton's method from `initial_pose` (home by default).

        Raises ConvergenceError as `solve_forward_kinematics`.
        """
        return self.solve_forward_kinematics(theta, initial_pose).pose

    def solve_forward_kinematics(self, theta: ArrayLike, initial_pose: ArrayLike | None = None) -> ForwardSolution:
        """`forward_kinematics` with how the search converged: pose (6,), iterations () and residual (n,), rad or m.

        Raises ConvergenceError, naming leg and residual, when no pose near the start has these coordinates.
        """
        theta = rows("theta", theta, self.layout.joints)
        start = self.home_pose if initial_pose is None else self.charted(initial_pose, "initial_pose")
        return forward_kinematics.solve(self.functions, self.geometry.chart, theta, start)

    def assembly_modes(self, theta: ArrayLike | None = None, starts: int = 2000, seed: int = 0) -> np.ndarray:
        """Poses (k, 6) in which the robot can be assembled with joint coordinates (n,), by default those at home.

        What Newton's method finds from so many random starts, the one nearest to home first; a Gough-Stewart platform
        has up to 40 (Dietmaier, 1998). Each leg is on its branch of home: poses in which one is folded the other way
        have other joint coordinates by the inverse kinematics, and are left out. More starts may find more.
        """
        joints = self.inverse_kinematics(self.home_pose) if theta is None else theta
        joints, geometry = floats("theta", joints, (self.layout.joints,)), self.geometry
        centre = geometry.base_joints.mean(axis=0)
        reach = np.linalg.norm(geometry.joints_at(self.home_pose) - geometry.base_joints, axis=1).max()
        radius = float(np.linalg.norm(geometry.base_joints - centre, axis=1).max() + reach)
        count, drawn = whole("starts", starts, DynamicsError, least=1), whole("seed", seed, DynamicsError, least=0)
        return forward_kinematics.assembly_modes(self.functions, geometry.chart, joints, centre, radius, count, drawn)

    def joint_jacobian(self, pose: ArrayLike) -> np.ndarray:
        """J_ad (n, 6): theta_dot = J_ad twist (eq. 8)."""
        return self._call("joint_jacobian", self._poses(pose))

    def pose_jacobian(self, pose: ArrayLike) -> np.ndarray:
        """J_theta (n, 6): theta_dot = J_theta pose_dot (eq. 29)."""
        return self._call("pose_jacobian", self._poses(pose))

    def coordinate_jacobian(self, pose: ArrayLike) -> np.ndarray:
        """(n, m): the joint rates of the rates of the platform's coordinates."""
        return self.pose_jacobian(pose) @ self.geometry.chart.basis

    def twist(self, pose: ArrayLike, pose_rate: ArrayLike) -> np.ndarray:
        """Twist (6,) of pose rates (6,) (eq. 2)."""
        return self._call("twist", rows("pose", pose, 6), rows("pose_rate", pose_rate, 6))[..., 0]

    def twist_dot(self, pose: ArrayLike, pose_rate: ArrayLike, pose_acceleration: ArrayLike) -> np.ndarray:
        """Twist rate (6,) of pose rates and accelerations (6,) (eq. 38)."""
        motion = (rows("pose_rate", pose_rate, 6), rows("pose_acceleration", pose_acceleration, 6))
        return self._call("twist_dot", rows("pose", pose, 6), *motion)[..., 0]

    def pose_rate(self, pose: ArrayLike, twist: ArrayLike) -> np.ndarray:
        """Pose rates (6,) of a twist (6,); the inverse of `twist`. Euler rates have no value at beta = +-pi/2."""
        poses = rows("pose", pose, 6)
        turned = np.abs(np.cos(poses[..., 4]))
        if not (turned > 1 / CONDITION_LIMIT).all():
            raise SingularPoseError(f"Euler rates are singular at beta = +-pi/2: |cos(beta)| is {turned.min():.3g}")
        return self._call("pose_rate", poses, rows("twist", twist, 6))[..., 0]

    def mass_matrix(self, pose: ArrayLike, parameters: ArrayLike | None = None) -> np.ndarray:
        """M (6, 6) of eq. 23."""
        return self._call("mass_matrix", self._poses(pose), self._parameters(parameters))

    def coriolis_matrix(self, pose: ArrayLike, twist: ArrayLike, parameters: ArrayLike | None = None) -> np.ndarray:
        """C (6, 6) of eq. 23."""
        twist = self._twists("twist", twist)
        return self._call("coriolis_matrix", self._poses(pose), twist, self._parameters(parameters))

    def gravity_wrench(self, pose: ArrayLike, parameters: ArrayLike | None = None) -> np.ndarray:
        """G (6,) of eq. 23, N and N m."""
        return self._call("gravity_wrench", self._poses(pose), self._parameters(parameters))[..., 0]

    def friction_wrench(self, pose: ArrayLike, twist: ArrayLike, parameters: ArrayLike | None = None) -> np.ndarray:
        """tau_f (6,) of eq. 24, N and N m, with the exact sign function (zero at rest)."""
        twist = self._twists("twist", twist)
        return self._call("friction_wrench", self._poses(pose), twist, self._parameters(parameters))[..., 0]

    def regressor(self, pose: ArrayLike, twist: ArrayLike, twist_dot: ArrayLike) -> np.ndarray:
        """Gamma (6, p): tau_g = Gamma parameters (eq. 25)."""
        return self._call(
            "regressor", self._poses(pose), self._twists("twist", twist), self._twists("twist_dot", twist_dot)
        )

    def inverse_dynamics(
        self, pose: ArrayLike, twist: ArrayLike, twist_dot: ArrayLike, parameters: ArrayLike | None = None
    ) -> np.ndarray:
        """Actuator torques or forces (n,), N m or N, of a motion (eq. 17 and 23)."""
        motion = (self._twists("twist", twist), self._twists("twist_dot", twist_dot))
        return self._call("inverse_dynamics", self._regular(pose), *motion, self._parameters(parameters))[..., 0]

    def forward_dynamics(
        self, pose: ArrayLike, twist: ArrayLike, torque: ArrayLike, parameters: ArrayLike | None = None
    ) -> np.ndarray:
        """twist_dot (6,) under actuator torques (n,), with the exact sign function in the friction (eq. 40)."""
        state = (self._regular(pose), self._twists("twist", twist), rows("torque", torque, self.layout.joints))
        return self._call("forward_dynamics", *state, self._parameters(parameters))[..., 0]

    def static_torque(self, pose: ArrayLike, parameters: ArrayLike | None = None) -> np.ndarray:
        """Actuator torques or forces (n,), N m or N, that hold the robot at rest without help from friction."""
        poses = rows("pose", pose, 6)
        rest = np.zeros_like(poses)
        return self.inverse_dynamics(poses, rest, rest, parameters)

    def reach_margin(self, pose: ArrayLike) -> np.ndarray:
        """How far each leg is from the end of its reach (n,), dimensionless and at most 1; negative beyond it.

        For a crank, sin^2 of the angle between it and its direction of reach. It falls without limit as the leg's
        target moves away, and is -inf where squares overflow.
        """
        return self._margins(self.charted(pose))

    def check_reach(self, pose: ArrayLike, name: str = "pose", row: str = "row") -> None:
        """Raise UnreachablePoseError, naming leg and pose, where a leg cannot reach; `name` and `row` are its words."""
        poses = np.atleast_2d(self.charted(pose, name))
        margin = self._margins(poses)
        if (margin > 0).all():
            return
        index, leg = (int(value) for value in np.argwhere(~(margin > 0))[0])
        where = f" ({row} {index})" if np.ndim(pose) > 1 else ""
        raise UnreachablePoseError(
            f"leg {leg + 1} cannot reach {name} {row_text(poses[index])}{where}: "
            f"reach margin {margin[index, leg]:.3g}, must be > 0"
        )

    @property
    def functions(self) -> dict[str, MachineFunction]:
        """Kinematics and dynamics by name, as machine code, compiled when first asked for."""
        own = self.functions_of is self.geometry
        return own_functions(self.geometry) if own else nearby_functions(self.functions_of, self.geometry)

    def moved(self, deviations: ArrayLike) -> Robot:
        """The robot with its geometric numbers off by deviations (g,), m and rad.

        All robots that are moved from one share its functions, compiled once and a third slower than those of a robot
        file. Raises RobotFileError where a leg does not reach the home pose any more.
        """
        geometry = self.geometry.moved(floats("deviations", deviations, (len(self.geometry.number_names),)))
        return Robot(RobotDescription(self.name, geometry, self.parameter_sets), self.functions_of)

    def _margins(self, poses: np.ndarray) -> np.ndarray:
        """`reach_margin` of poses that the platform can have."""
        margin = self._call("inverse_kinematics", poses, output=1)[..., 0]
        return np.where(np.isnan(margin), -np.inf, margin)

    def _poses(self, pose: ArrayLike) -> np.ndarray:
        poses = rows("pose", pose, 6)
        self.check_reach(poses)
        return poses

    def charted(self, pose: ArrayLike, name: str = "pose") -> np.ndarray:
        """The poses (6,) or (N, 6), if the platform can have them. Raises ChartError, or ShapeError."""
        poses = rows(name, pose, 6)
        self._check_chart(name, poses, self.geometry.chart.forbidden(poses))
        return poses

    def _twists(self, name: str, value: ArrayLike) -> np.ndarray:
        twists, free = rows(name, value, 6), self.geometry.chart.basis
        self._check_chart(name, twists, twists - twists @ free @ free.T)
        return twists

    def _check_chart(self, name: str, given: np.ndarray, forbidden: np.ndarray) -> None:
        """Raise ChartError where rows hold what the platform of this robot cannot do."""
        if np.abs(forbidden).max(initial=0.0) <= CHART_TOLERANCE:
            return
        chart, entry = self.geometry.chart, int(np.argmax(np.abs(np.atleast_2d(forbidden)).max(axis=0)))
        row = int(np.argmax(np.abs(np.atleast_2d(forbidden)[:, entry])))
        raise ChartError(
            f"the platform of {self.name} moves in {', '.join(chart.coordinate_names)} only: {name} "
            f"{row_text(np.atleast_2d(given)[row])} is {np.atleast_2d(forbidden)[row, entry]:.3g} off in "
            f"{POSE_NAMES[entry]}"
        )

    def _regular(self, pose: ArrayLike) -> np.ndarray:
        poses = self._poses(pose)
        jacobian = self._call("joint_jacobian", poses) @ self.geometry.chart.basis
        condition = np.atleast_1d(np.linalg.cond(jacobian))
        if not (condition < CONDITION_LIMIT).all():
            index = int(np.argmax(~(condition < CONDITION_LIMIT)))
            raise SingularPoseError(
                f"the robot is singular at pose {row_text(np.atleast_2d(poses)[index])}: "
                f"condition of J_ad {condition[index]:.3g}, limit {CONDITION_LIMIT:.0e}"
            )
        return poses

    def _parameters(self, parameters: ArrayLike | None) -> np.ndarray:
        return self.nominal_parameters if parameters is None else self.layout.check(parameters, batch=True)

    def _call(self, name: str, *arguments: np.ndarray, output: int = 0) -> np.ndarray:
        """Evaluate one function over the common batch: (rows, columns) or, with a batch, (N, rows, columns)."""
        batched = [argument.shape[0] for argument in arguments if argument.ndim == 2]
        if len(set(batched) - {1}) > 1:
            shapes = ", ".join(str(argument.shape) for argument in arguments)
            raise ShapeError(f"{name}: batch lengths differ, shapes {shapes}")
        values = self.functions[name](*[np.atleast_2d(argument) for argument in arguments])[output]
        if output == 0 and not np.isfinite(values).all():
            said = ", ".join(row_text(argument) for argument in arguments)
            raise SingularPoseError(f"{name} is not finite for {said}: singular pose or mass matrix")
        return values if batched else values[0]
