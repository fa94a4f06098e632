"""Motion of the six platform joints A = h + R a in pose coordinates, with the derivatives the legs chain through."""

import casadi as ca

from dynamics.kinematics.geometry import LEGS, Rss6Geometry
from dynamics.kinematics.rotation import rotation_matrix


class PlatformJointMotion:
    """Symbolic motion of the joints A for a pose q (6,), rate and acceleration (6,); base axes, SI.

    Lists over the legs: position, velocity, acceleration (3,); gradient dA/dq = d(velocity)/d(rate) (3, 6);
    gradient_rate d(velocity)/dq (3, 6); acceleration_by_pose d(acceleration)/dq (3, 6).
    d(acceleration)/d(rate) is twice gradient_rate.
    """

    def __init__(self, geometry: Rss6Geometry, pose: ca.SX, rate: ca.SX, acceleration: ca.SX) -> None:
        angles, spin, spin_rate = pose[3:6], rate[3:6], acceleration[3:6]
        rotation = rotation_matrix(angles)
        first = _by_angles(rotation, angles)
        self._second = [_by_angles(matrix, angles) for matrix in first]
        first_rate = [_combine(row, spin) for row in self._second]
        rotation_second_rate = _combine(first, spin_rate) + _combine(first_rate, spin)
        third = _by_angles(rotation_second_rate, angles)
        arms = [geometry.platform_joints[leg] for leg in range(LEGS)]
        self._arms = arms
        self.position = [pose[0:3] + rotation @ arm for arm in arms]
        self.velocity = [rate[0:3] + _combine(first, spin) @ arm for arm in arms]
        self.acceleration = [acceleration[0:3] + rotation_second_rate @ arm for arm in arms]
        self.gradient = [ca.horzcat(ca.SX.eye(3), *[matrix @ arm for matrix in first]) for arm in arms]
        self.gradient_rate = [ca.horzcat(ca.SX.zeros(3, 3), *[m @ arm for m in first_rate]) for arm in arms]
        self.acceleration_by_pose = [ca.horzcat(ca.SX.zeros(3, 3), *[m @ arm for m in third]) for arm in arms]

    def curvature(self, leg: int, force: ca.SX) -> ca.SX:
        """d(gradient^T force)/dq (6, 6) for a force (3,) held constant at the joint of one leg."""
        arm = self._arms[leg]
        rows = [ca.horzcat(*[ca.dot(force, matrix @ arm) for matrix in row]) for row in self._second]
        return ca.diagcat(ca.SX.zeros(3, 3), ca.vertcat(*rows))


def _by_angles(matrix: ca.SX, angles: ca.SX) -> list[ca.SX]:
    columns = ca.jacobian(ca.vec(matrix), angles)
    return [ca.reshape(columns[:, axis], 3, 3) for axis in range(3)]


def _combine(matrices: list[ca.SX], weights: ca.SX) -> ca.SX:
    return matrices[0] * weights[0] + matrices[1] * weights[1] + matrices[2] * weights[2]
