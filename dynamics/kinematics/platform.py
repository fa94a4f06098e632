"""Coordinates of the platform, and the motion of the platform and of its joints A, in CasADi.

For every robot, the pose has the six entries [x y z alpha beta gamma] with R = Rx(alpha) Ry(beta)
Rz(gamma) (eq. 1). The coordinates of a platform with fewer degrees of freedom are the entries that
it can change. The other entries have their values at home. Eq. 2, 29 and 38 relate rates of the
pose to a twist [h_dot, omega]. Vectors are in the axes of the base, in SI units.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

POSE_NAMES = ("x", "y", "z", "alpha", "beta", "gamma")
POSE_UNITS = ("m", "m", "m", "rad", "rad", "rad")
# Entries of the pose that a platform can change, for each name of a chart.
FREEDOMS = {"free": (0, 1, 2, 3, 4, 5), "translation": (0, 1, 2), "planar": (0, 1, 5)}


def rotation_matrix(angles: ca.SX) -> ca.SX:
    """Base-from-platform rotation (3, 3) of Euler angles [alpha, beta, gamma], rad (eq. 1)."""
    ca_ = ca.cos(angles[0])
    cb = ca.cos(angles[1])
    cg = ca.cos(angles[2])
    sa = ca.sin(angles[0])
    sb = ca.sin(angles[1])
    sg = ca.sin(angles[2])
    return ca.vertcat(
        ca.horzcat(cb * cg, -cb * sg, sb),
        ca.horzcat(ca_ * sg + cg * sb * sa, ca_ * cg - sb * sa * sg, -cb * sa),
        ca.horzcat(sa * sg - ca_ * cg * sb, ca_ * sb * sg + cg * sa, cb * ca_),
    )


def pose_rate_to_twist(pose: ca.SX) -> ca.SX:
    """Matrix T (6, 6) of eq. 29, with twist = T pose_dot. It includes J_e of eq. 2."""
    alpha = pose[3]
    beta = pose[4]
    euler_rate_jacobian = ca.vertcat(
        ca.horzcat(1, 0, ca.sin(beta)),
        ca.horzcat(0, ca.cos(alpha), -ca.cos(beta) * ca.sin(alpha)),
        ca.horzcat(0, ca.sin(alpha), ca.cos(beta) * ca.cos(alpha)),
    )
    return ca.diagcat(ca.SX.eye(3), euler_rate_jacobian)


def twist_bias(pose: ca.SX, pose_rate: ca.SX) -> ca.SX:
    """Vector T_dot pose_dot (6,): the twist_dot of a motion without pose acceleration (eq. 38)."""
    ca_ = ca.cos(pose[3])
    cb = ca.cos(pose[4])
    sa = ca.sin(pose[3])
    sb = ca.sin(pose[4])
    da = pose_rate[3]
    db = pose_rate[4]
    dg = pose_rate[5]
    return ca.vertcat(
        ca.SX.zeros(3),
        db * dg * cb,
        -ca_ * da * dg * cb + sa * (db * dg * sb - db * da),
        -sa * da * dg * cb + ca_ * (db * da - db * dg * sb),
    )


def joint_motion(arm: ca.SX, twist: ca.SX, twist_dot: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Velocity and acceleration (3,) of a platform joint A.

    `arm` (3,) is the vector from the platform origin to A.
    """
    omega = twist[3:6]
    omega_dot = twist_dot[3:6]
    velocity = twist[0:3] + ca.cross(omega, arm)
    return velocity, twist_dot[0:3] + ca.cross(omega_dot, arm) + ca.cross(
        omega, ca.cross(omega, arm)
    )


class PlatformJointMotion:
    """Motion of the joints A for a pose q (6,), its rate and its acceleration, which are symbols.

    `joints` (legs, 3) are the joints in the axes of the platform, m. The attributes are lists with
    one entry for each leg: `position`, `velocity` and `acceleration` (3,); `gradient`, dA/dq =
    d(velocity)/d(rate) (3, 6); `gradient_rate`, d(velocity)/dq (3, 6); and `acceleration_by_pose`,
    d(acceleration)/dq (3, 6). The derivative d(acceleration)/d(rate) is twice `gradient_rate`.
    """

    def __init__(
        self, joints: Sequence[ca.SX] | np.ndarray, pose: ca.SX, rate: ca.SX, acceleration: ca.SX
    ) -> None:
        self.pose = pose
        self.rate = rate
        self.symbols = [pose, rate, acceleration]
        angles = pose[3:6]
        spin = rate[3:6]
        spin_rate = acceleration[3:6]
        rotation = rotation_matrix(angles)
        first = _by_angles(rotation, angles)
        self._second = [_by_angles(matrix, angles) for matrix in first]
        first_rate = [_combine(row, spin) for row in self._second]
        rotation_second_rate = _combine(first, spin_rate) + _combine(first_rate, spin)
        third = _by_angles(rotation_second_rate, angles)
        self._arms = arms = list(joints)
        self.position = [pose[0:3] + rotation @ arm for arm in arms]
        self.velocity = [rate[0:3] + _combine(first, spin) @ arm for arm in arms]
        self.acceleration = [acceleration[0:3] + rotation_second_rate @ arm for arm in arms]
        self.gradient = [
            ca.horzcat(ca.SX.eye(3), *[matrix @ arm for matrix in first]) for arm in arms
        ]
        self.gradient_rate = [
            ca.horzcat(ca.SX.zeros(3, 3), *[m @ arm for m in first_rate]) for arm in arms
        ]
        self.acceleration_by_pose = [
            ca.horzcat(ca.SX.zeros(3, 3), *[m @ arm for m in third]) for arm in arms
        ]

    def of(self, leg: int) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Position, velocity and acceleration (3,) of the joint of one leg."""
        return self.position[leg], self.velocity[leg], self.acceleration[leg]

    def curvature(self, leg: int, force: ca.SX) -> ca.SX:
        """Derivative d(gradient^T force)/dq (6, 6) for a constant force (3,) at a leg's joint."""
        arm = self._arms[leg]
        rows = [
            ca.horzcat(*[ca.dot(force, matrix @ arm) for matrix in row]) for row in self._second
        ]
        return ca.diagcat(ca.SX.zeros(3, 3), ca.vertcat(*rows))


def _by_angles(matrix: ca.SX, angles: ca.SX) -> list[ca.SX]:
    """Derivatives of a matrix (3, 3) with respect to each of three angles."""
    columns = ca.jacobian(ca.vec(matrix), angles)
    return [ca.reshape(columns[:, axis], 3, 3) for axis in range(3)]


def _combine(matrices: list[ca.SX], weights: ca.SX) -> ca.SX:
    """Weighted sum of three matrices."""
    return matrices[0] * weights[0] + matrices[1] * weights[1] + matrices[2] * weights[2]


def base_from_platform(pose: np.ndarray) -> np.ndarray:
    """Rotation matrix (3, 3) of a pose (6,), as numbers (eq. 1)."""
    return Rotation.from_euler("XYZ", pose[3:6]).as_matrix()


@dataclass(frozen=True)
class Chart:
    """Chart of a platform: the m entries of its pose that are coordinates.

    `name` is a key of FREEDOMS, and `home` the pose at home (six numbers, m and rad).
    """

    name: str
    home: tuple[float, ...]

    @property
    def freedoms(self) -> tuple[int, ...]:
        """Entries of the pose that are the coordinates."""
        return FREEDOMS[self.name]

    @property
    def coordinate_names(self) -> tuple[str, ...]:
        """Names of the coordinates."""
        return tuple(POSE_NAMES[entry] for entry in self.freedoms)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the coordinates, m or rad."""
        return tuple(POSE_UNITS[entry] for entry in self.freedoms)

    @property
    def basis(self) -> np.ndarray:
        """Basis (6, m) of the allowed pose changes, and of the allowed twists.

        Both have the same basis, because a chart has all rotations, none, or only that about z.
        """
        return np.eye(6)[:, list(self.freedoms)]

    def pose(self, coordinates: ArrayLike) -> np.ndarray:
        """Poses (6,) or (N, 6) for coordinates (m,) or (N, m)."""
        values = np.asarray(coordinates, dtype=float)
        poses = np.empty((*values.shape[:-1], len(POSE_NAMES)))
        if len(self.freedoms) == len(POSE_NAMES):
            poses[...] = values
            return poses
        poses[...] = self.home
        poses[..., list(self.freedoms)] = values
        return poses

    def coordinates(self, pose: ArrayLike) -> np.ndarray:
        """Coordinates (m,) or (N, m) of poses (6,) or (N, 6).

        The entries that the platform cannot change are ignored.
        """
        values = np.asarray(pose, dtype=float)
        return (
            values.copy()
            if len(self.freedoms) == len(POSE_NAMES)
            else values[..., list(self.freedoms)]
        )

    def projected(self, rows: np.ndarray) -> np.ndarray:
        """Rows (..., m, k) for the coordinates from rows (..., 6, k) for the twist: basis.T @ rows.

        If m is 6, the array itself is returned.
        """
        return rows if len(self.freedoms) == len(POSE_NAMES) else rows[..., list(self.freedoms), :]

    def lifted(self, values: np.ndarray, axis: int = -1) -> np.ndarray:
        """Rates or derivatives of poses from those of coordinates, along an axis of length m.

        If m is 6, the array itself is returned.
        """
        if len(self.freedoms) == len(POSE_NAMES):
            return values
        rows = np.moveaxis(values, axis, -1)
        lifted = np.zeros((*rows.shape[:-1], len(POSE_NAMES)))
        lifted[..., list(self.freedoms)] = rows
        return np.moveaxis(lifted, -1, axis)

    def forbidden(self, pose: ArrayLike) -> np.ndarray:
        """Deviations of poses (6,) or (N, 6) from those that the platform can have, m and rad."""
        values = np.asarray(pose, dtype=float)
        if len(self.freedoms) == len(POSE_NAMES):
            return np.zeros(values.shape)
        return values - self.pose(self.coordinates(values))
