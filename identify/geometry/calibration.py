"""Geometry of a robot from static poses, by least squares on the pose at which its loops close.

The model of a measured pose is z = base o f(joints, geometry) o platform + noise. Here f is the
pose at which the loops close for the measured joint coordinates. Base and platform are the small
errors of the two frames from teaching. The unknowns are the deviations of the geometric numbers
(`dynamics.legs.geometric_numbers`) and the twelve errors of the frames. Other errors that all poses
have in common, such as errors of the cameras, are further unknowns.

Each unknown has a prior: the stated tolerance of a machine part about its nominal value, or the
covariance of teaching. Errors of the encoders enter the covariance of the pose through the loops. A
number that the poses do not determine keeps its nominal value, with the tolerance as its standard
deviation.

An encoder offset has the same effect as a change of the zero angle of a turning joint, or of the
position of a sliding joint along its slide. The calibrated geometry contains these offsets, so it
agrees with the encoders.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from dynamics import Robot
from dynamics.closure import Closure
from dynamics.errors import DynamicsError
from identify.arrays import Array
from identify.errors import EstimationError
from identify.geometry.static_poses import FrameKnowledge, StaticPoses

# Largest standard deviation, as a fraction of the tolerance, with which a number counts as
# determined. The prior then has at most a ninth of the information, and hardly affects an interval.
OBSERVABLE = 1 / 3


@dataclass(frozen=True)
class Tolerance:
    """Standard deviations of geometric numbers: positions and lengths [m], angles [rad]."""

    m: float
    rad: float

    def of(self, robot: Robot) -> Array:
        """Return the standard deviation of each geometric number (g,) of a robot."""
        return np.array(
            [self.m if unit == "m" else self.rad for unit in robot.geometry.number_units]
        )


@dataclass(frozen=True)
class PoseModel:
    """Model of poses with unknowns (g + 12,): deviations of the geometry, and errors of the frames.

    The unknowns are in units of their prior: each has the prior mean zero and variance one.
    """

    robot: Robot
    tolerance: Array
    frames: FrameKnowledge

    @cached_property
    def closure(self) -> Closure:
        """Loop closure of the robot."""
        return Closure(self.robot.geometry)

    @cached_property
    def scale(self) -> Array:
        """Matrix (g + 12, g + 12) from unknowns in units of their prior to m and rad."""
        count = len(self.tolerance)
        scale = np.zeros((count + 12, count + 12))
        scale[:count, :count] = np.diag(self.tolerance)
        scale[count:, count:] = self.frames.root
        return scale

    def split(self, unknowns: Array) -> tuple[Array, Array]:
        """Return deviations (g,) and errors of the frames (12,), m and rad."""
        values = self.scale @ unknowns
        return values[: len(self.tolerance)], values[len(self.tolerance) :]

    def closed(self, joints: Array, unknowns: Array, start: Array) -> Array:
        """Return the poses (N, 6), near `start`, at which the loops close in exact frames."""
        chart = self.robot.geometry.chart
        return self.closure.poses(
            joints, self.split(unknowns)[0], chart.pose(chart.coordinates(start))
        )

    def columns(self, joints: Array, closed: Array, unknowns: Array) -> tuple[Array, Array]:
        """Return the derivatives of the m coordinates of measured poses.

        The first array (N, m, g + 12) is with respect to the unknowns, at frames without errors.
        The second array (N, m, n) is with respect to the joints.
        """
        free = list(self.robot.geometry.chart.freedoms)
        by_numbers, by_joints = self.closure.derivatives(closed, joints, self.split(unknowns)[0])
        by_frames = frame_columns(self.robot, closed)[:, free]
        return np.concatenate([by_numbers, by_frames], axis=2) @ self.scale, by_joints


def measured_poses(poses: Array, frames: Array) -> Array:
    """Return the measured poses for true poses (N, 6) and errors (12,) of the frames, m and rad.

    The errors are [dt, dphi] of the base, then of the platform, with rotation vectors dphi.
    """
    base = Rotation.from_rotvec(frames[3:6])
    platform = Rotation.from_rotvec(frames[9:12])
    turned = Rotation.from_euler("XYZ", poses[:, 3:])
    positions = frames[:3] + base.apply(poses[:, :3] + turned.apply(frames[6:9]))
    return np.hstack([positions, (base * turned * platform).as_euler("XYZ")])


def frame_columns(robot: Robot, poses: Array) -> Array:
    """Return d(pose)/d(errors of the frames) (N, 6, 12) at zero errors."""
    turned = Rotation.from_euler("XYZ", poses[:, 3:]).as_matrix()
    twists = np.zeros((len(poses), 6, 12))
    twists[:, :3, :3] = twists[:, 3:, 3:6] = np.eye(3)
    for axis in range(3):
        twists[:, :3, 3 + axis] = np.cross(np.eye(3)[axis], poses[:, :3])
    twists[:, :3, 6:9] = twists[:, 3:, 9:12] = turned
    rates = robot.pose_rate(np.repeat(poses, 12, axis=0), twists.swapaxes(1, 2).reshape(-1, 6))
    return np.asarray(rates, dtype=float).reshape(-1, 12, 6).swapaxes(1, 2)


@dataclass(frozen=True)
class Calibration:
    """Estimated geometry of a robot.

    Attributes
    ----------
    nominal : Robot
        Robot before the calibration.
    deviations : ndarray, shape (g,)
        Deviations from the nominal geometric numbers, m and rad.
    frames : ndarray, shape (12,)
        Errors of the two frames, m and rad.
    joint_covariance : ndarray, shape (g + 12, g + 12)
        Covariance of the deviations and the errors of the frames together.
    prior_std : ndarray, shape (g,)
        Tolerances.
    noise_ratio : float
        Sum of the squared residuals in units of the stated noise, per degree of freedom. It is near
        one if model and noise are right.
    noise_ratio_std : float
        Standard deviation of this ratio.
    frames_known : bool
        False if the poses of the frames were unknown.
    """

    nominal: Robot
    deviations: Array
    frames: Array
    joint_covariance: Array
    prior_std: Array
    noise_ratio: float
    noise_ratio_std: float
    frames_known: bool

    @property
    def covariance(self) -> Array:
        """Covariance (g, g) of the deviations, m and rad."""
        count = len(self.deviations)
        return self.joint_covariance[:count, :count]

    @property
    def std(self) -> Array:
        """Standard deviations (g,), m and rad."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance)))

    @property
    def observable(self) -> NDArray[np.bool_]:
        """True for each geometric number (g,) that the poses determine."""
        return np.asarray(self.std <= OBSERVABLE * self.prior_std)

    @property
    def robot(self) -> Robot:
        """Nominal robot with the estimated geometry."""
        return self.nominal.with_geometry(self.nominal.geometry.moved(self.deviations))


@dataclass(frozen=True)
class _Fit:
    """Least-squares problem: whitened residuals of the poses, then residuals of the prior.

    The unknowns are those of the model, then the errors that all poses have in common. The effect
    of the encoders' errors on a pose is computed at the nominal geometry.
    """

    model: PoseModel
    data: StaticPoses

    @property
    def nothing(self) -> Array:
        """Prior mean of the unknowns: zero."""
        return np.zeros(len(self.model.scale) + self.data.common_errors.shape[2])

    def residuals(self, unknowns: Array) -> Array:
        """Return the residuals (N m + u,)."""
        of_model, common = np.split(unknowns, [len(self.model.scale)])
        closed = self.model.closed(self.data.joints, of_model, self.data.poses)
        seen = (
            measured_poses(closed, self.model.split(of_model)[1]) + self.data.common_errors @ common
        )
        return np.append(
            (self._whiteners @ (seen - self.data.poses)[:, self._free, None]).ravel(), unknowns
        )

    def jacobian(self, unknowns: Array) -> Array:
        """Return the Jacobian (N m + u, u) of the residuals."""
        of_model = unknowns[: len(self.model.scale)]
        closed = self.model.closed(self.data.joints, of_model, self.data.poses)
        columns = self.model.columns(self.data.joints, closed, of_model)[0]
        columns = self._whiteners @ np.concatenate(
            [columns, self.data.common_errors[:, self._free]], axis=2
        )
        return np.vstack([columns.reshape(-1, len(unknowns)), np.eye(len(unknowns))])

    @property
    def _free(self) -> list[int]:
        return list(self.model.robot.geometry.chart.freedoms)

    @cached_property
    def _whiteners(self) -> Array:
        """Whitening matrices (N, m, m) of the poses."""
        none = np.zeros(len(self.model.scale))
        closed = self.model.closed(self.data.joints, none, self.data.poses)
        by_joints = self.model.columns(self.data.joints, closed, none)[1]
        return whiteners(
            self.data.covariances[:, self._free][:, :, self._free], by_joints, self.data.joint_std
        )


def calibrate(robot: Robot, data: StaticPoses, tolerance: Tolerance) -> Calibration:
    """Estimate the geometry of a robot from static poses, with the nominal geometry as prior.

    Raises EstimationError if the loops do not close with the encoders' readings, or if the search
    does not converge.
    """
    model = PoseModel(robot, tolerance.of(robot), data.frames)
    fit = _Fit(model, data)
    # Unknowns are in units of their prior, so a single threshold is enough.
    limit = 1e-10
    start = fit.nothing
    try:
        solution = least_squares(
            fit.residuals, start, fit.jacobian, method="lm", xtol=limit, ftol=limit, gtol=limit
        )
    except DynamicsError as error:
        raise EstimationError(f"the poses do not fit robot {robot.name}: {error}") from error
    if not solution.success:
        raise EstimationError(f"the search for the geometry did not converge: {solution.message}")
    by_poses = solution.jac[: -len(start)]
    count = len(model.scale)
    posterior = np.linalg.inv(solution.jac.T @ solution.jac)
    covariance = model.scale @ posterior[:count, :count] @ model.scale.T
    # The trace is the effective number of unknowns that the poses determine.
    freedom = max(len(by_poses) - float(np.sum(posterior * (by_poses.T @ by_poses))), 1.0)
    deviations, frames = model.split(solution.x[:count])
    return Calibration(
        nominal=robot,
        deviations=deviations,
        frames=frames,
        # The average removes asymmetry due to rounding.
        joint_covariance=(covariance + covariance.T) / 2,
        prior_std=model.tolerance,
        noise_ratio=float(np.sum(solution.fun[: len(by_poses)] ** 2) / freedom),
        noise_ratio_std=float(np.sqrt(2 / freedom)),
        frames_known=not np.array_equal(data.frames.base, FrameKnowledge.none().base),
    )


def whiteners(covariances: Array, by_joints: Array, joint_std: Array) -> Array:
    """Return the matrices (N, m, m) that whiten the residuals of the coordinates.

    The covariance is the sum of the covariance of the measured pose (N, m, m) and of the effect of
    the encoders' errors. These act through `by_joints` (N, m, n), d(coordinates)/d(joints).
    """
    encoders = by_joints * joint_std
    return np.asarray(
        np.linalg.inv(np.linalg.cholesky(covariances + encoders @ encoders.swapaxes(1, 2)))
    )
