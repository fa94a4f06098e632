"""The geometry of a robot from static poses: least squares on the pose at which its loops close.

A measured pose is the pose at which the loops close with the joint coordinates that the encoders
read, seen between two frames that teaching put a little off: z = base o f(joints, geometry) o
platform + noise. Unknown are the geometric numbers (`dynamics.legs.geometric_numbers`) and the
twelve of the frames, each with its prior: the stated tolerance of a machine part about its nominal
value, and what teaching says; other errors that all poses have in common, such as those of the
cameras, join them as columns. Errors of the encoders come through the loops into the pose's
covariance. So what poses cannot tell stays where the drawing has it, with the tolerance for a
standard deviation.

A joint's offset is the twin of its zero angle, or of its base joint along its slide: the numbers of
a calibrated robot are those with which its encoders are right.
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

OBSERVABLE = 1 / 3
"""A number is told when the poses leave at most this share of its tolerance as standard deviation:
the prior is then a ninth of the information, and hardly moves an interval."""


@dataclass(frozen=True)
class Tolerance:
    """Standard deviations of geometric numbers about the nominal ones: m of places and lengths, rad
    of turns.
    """

    m: float
    rad: float

    def of(self, robot: Robot) -> Array:
        """One a number of the robot (g,)."""
        return np.array(
            [self.m if unit == "m" else self.rad for unit in robot.geometry.number_units]
        )


@dataclass(frozen=True)
class PoseModel:
    """What poses say of the unknowns u (g + 12,): geometric numbers and errors of the frames, in
    units of their prior, so that each has mean zero and variance one before the poses."""

    robot: Robot
    tolerance: Array
    frames: FrameKnowledge

    @cached_property
    def closure(self) -> Closure:
        """Loops of the robot's geometries."""
        return Closure(self.robot.geometry)

    @cached_property
    def scale(self) -> Array:
        """(g + 12, g + 12): unknowns in m and rad of those in units of their prior."""
        count = len(self.tolerance)
        scale = np.zeros((count + 12, count + 12))
        scale[:count, :count] = np.diag(self.tolerance)
        scale[count:, count:] = self.frames.root
        return scale

    def split(self, unknowns: Array) -> tuple[Array, Array]:
        """Deviations (g,) and errors of the frames (12,), m and rad."""
        values = self.scale @ unknowns
        return values[: len(self.tolerance)], values[len(self.tolerance) :]

    def closed(self, joints: Array, unknowns: Array, start: Array) -> Array:
        """Poses (N, 6) at which the loops close, without the errors of the frames."""
        chart = self.robot.geometry.chart
        return self.closure.poses(
            joints, self.split(unknowns)[0], chart.pose(chart.coordinates(start))
        )

    def columns(self, joints: Array, closed: Array, unknowns: Array) -> tuple[Array, Array]:
        """How the coordinates (m) of measured poses change with unknowns (N, m, g + 12) and with
        joints (N, m, n).
        """
        free = list(self.robot.geometry.chart.freedoms)
        by_numbers, by_joints = self.closure.derivatives(closed, joints, self.split(unknowns)[0])
        by_frames = frame_columns(self.robot, closed)[:, free]
        return np.concatenate([by_numbers, by_frames], axis=2) @ self.scale, by_joints


def seen_between(poses: Array, frames: Array) -> Array:
    """Poses (N, 6) between frames with errors (12,): [dt, dphi] of the base, then of the platform,
    m and rad.
    """
    base = Rotation.from_rotvec(frames[3:6])
    platform = Rotation.from_rotvec(frames[9:12])
    turned = Rotation.from_euler("XYZ", poses[:, 3:])
    places = frames[:3] + base.apply(poses[:, :3] + turned.apply(frames[6:9]))
    return np.hstack([places, (base * turned * platform).as_euler("XYZ")])


def frame_columns(robot: Robot, poses: Array) -> Array:
    """d(pose)/d(errors of the frames) (N, 6, 12) at errors of zero."""
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
    """What static poses say of a robot's geometry.

    deviations (g,) from the nominal geometry, errors of the two frames (12,), and joint_covariance
    (g + 12, g + 12) of both, m and rad; prior_std (g,): the tolerance; noise_ratio: mean square of
    the residuals in units of the stated noise, near one where that and the model are right, with
    its standard deviation; frames_known: whether anything was known of the frames.
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
        """Of the deviations (g, g)."""
        count = len(self.deviations)
        return self.joint_covariance[:count, :count]

    @property
    def std(self) -> Array:
        """Standard deviations (g,), m and rad."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance)))

    @property
    def observable(self) -> NDArray[np.bool_]:
        """Whether the poses tell each number (g,)."""
        return np.asarray(self.std <= OBSERVABLE * self.prior_std)

    @property
    def robot(self) -> Robot:
        """The nominal robot with the estimated geometry."""
        return self.nominal.with_geometry(self.nominal.geometry.moved(self.deviations))


@dataclass(frozen=True)
class _Fit:
    """Residuals of poses in units of their noise, below them the unknowns as residuals of their
    prior.

    Unknowns are those of the model, then the errors that all poses have in common. What an
    encoder's error makes of a pose is taken at the nominal geometry.
    """

    model: PoseModel
    data: StaticPoses

    @property
    def nothing(self) -> Array:
        """The unknowns before the poses: zero."""
        return np.zeros(len(self.model.scale) + self.data.common_errors.shape[2])

    def residuals(self, unknowns: Array) -> Array:
        """(N m + u,)"""
        of_model, common = np.split(unknowns, [len(self.model.scale)])
        closed = self.model.closed(self.data.joints, of_model, self.data.poses)
        seen = (
            seen_between(closed, self.model.split(of_model)[1]) + self.data.common_errors @ common
        )
        return np.append(
            (self._whiteners @ (seen - self.data.poses)[:, self._free, None]).ravel(), unknowns
        )

    def jacobian(self, unknowns: Array) -> Array:
        """(N m + u, u)"""
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
        """(N, m, m)"""
        none = np.zeros(len(self.model.scale))
        closed = self.model.closed(self.data.joints, none, self.data.poses)
        by_joints = self.model.columns(self.data.joints, closed, none)[1]
        return whiteners(
            self.data.covariances[:, self._free][:, :, self._free], by_joints, self.data.joint_std
        )


def calibrate(robot: Robot, data: StaticPoses, tolerance: Tolerance) -> Calibration:
    """Estimate the geometry of a robot, about its nominal one, from static poses.

    Raises EstimationError where the loops do not close with what the encoders read, or the search
    does not end.
    """
    model = PoseModel(robot, tolerance.of(robot), data.frames)
    fit = _Fit(model, data)
    limit = 1e-10
    none = fit.nothing
    try:
        found = least_squares(
            fit.residuals, none, fit.jacobian, method="lm", xtol=limit, ftol=limit, gtol=limit
        )
    except DynamicsError as error:
        raise EstimationError(f"the poses do not fit robot {robot.name}: {error}") from error
    if not found.success:
        raise EstimationError(f"the search for the geometry did not end: {found.message}")
    rows = found.jac[: -len(none)]
    own = len(model.scale)
    spread = np.linalg.inv(found.jac.T @ found.jac)
    covariance = model.scale @ spread[:own, :own] @ model.scale.T
    spare = max(len(rows) - float(np.sum(spread * (rows.T @ rows))), 1.0)
    deviations, frames = model.split(found.x[:own])
    return Calibration(
        nominal=robot,
        deviations=deviations,
        frames=frames,
        joint_covariance=(covariance + covariance.T) / 2,
        prior_std=model.tolerance,
        noise_ratio=float(np.sum(found.fun[: len(rows)] ** 2) / spare),
        noise_ratio_std=float(np.sqrt(2 / spare)),
        frames_known=not np.array_equal(data.frames.base, FrameKnowledge.none().base),
    )


def whiteners(covariances: Array, by_joints: Array, joint_std: Array) -> Array:
    """Matrices (N, m, m) that make residuals of the coordinates of variance one: noise (N, m, m) of
    the pose, and errors of the encoders through the loops, where coordinates change with joints by
    (N, m, n)."""
    encoders = by_joints * joint_std
    return np.asarray(
        np.linalg.inv(np.linalg.cholesky(covariances + encoders @ encoders.swapaxes(1, 2)))
    )
