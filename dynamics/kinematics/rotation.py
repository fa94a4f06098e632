"""Rotations of the platform: R = Rx(alpha) Ry(beta) Rz(gamma) (eq. 1) and its rates (eq. 2 and 38), in CasADi."""

import casadi as ca
import numpy as np

# From CasADi expressions to functions, and from functions to arrays.


def function(name: str, inputs: list[ca.SX], outputs: list[ca.SX]) -> ca.Function:
    """A CasADi function with dense outputs, in which every common subexpression is evaluated once.

    Legs share rotations and lever arms: forward dynamics halves in size and time.
    """
    return ca.Function(name, inputs, ca.cse([ca.densify(output) for output in outputs]))


def symmetric_from_lower(matrix: ca.SX) -> ca.SX:
    """A matrix known to be symmetric, its upper triangle taken from the lower: each entry is formed once."""
    return ca.tril2symm(ca.tril(matrix))


def evaluate(function: ca.Function, *batches: np.ndarray) -> list[np.ndarray]:
    """All outputs (N, rows, columns) of a function over batches (N, columns) of its arguments, NaN included."""
    if not len(batches[0]):
        return [np.zeros((0, *function.size_out(index))) for index in range(function.n_out())]
    values = function(*[batch.T for batch in batches])
    outputs = values if isinstance(values, tuple) else (values,)
    count = len(batches[0])
    return [np.asarray(v, dtype=float).reshape(v.shape[0], count, -1).transpose(1, 0, 2) for v in outputs]


def rotation_matrix(angles: ca.SX) -> ca.SX:
    """Base-from-platform rotation (3, 3) of the Euler angles [alpha, beta, gamma] in rad (eq. 1)."""
    ca_, cb, cg = ca.cos(angles[0]), ca.cos(angles[1]), ca.cos(angles[2])
    sa, sb, sg = ca.sin(angles[0]), ca.sin(angles[1]), ca.sin(angles[2])
    return ca.vertcat(
        ca.horzcat(cb * cg, -cb * sg, sb),
        ca.horzcat(ca_ * sg + cg * sb * sa, ca_ * cg - sb * sa * sg, -cb * sa),
        ca.horzcat(sa * sg - ca_ * cg * sb, ca_ * sb * sg + cg * sa, cb * ca_),
    )


def euler_rate_jacobian(angles: ca.SX) -> ca.SX:
    """J_e (3, 3): angular velocity in base axes from Euler angle rates, omega = J_e phi_dot (eq. 2)."""
    alpha, beta = angles[0], angles[1]
    return ca.vertcat(
        ca.horzcat(1, 0, ca.sin(beta)),
        ca.horzcat(0, ca.cos(alpha), -ca.cos(beta) * ca.sin(alpha)),
        ca.horzcat(0, ca.sin(alpha), ca.cos(beta) * ca.cos(alpha)),
    )


def euler_bias_acceleration(angles: ca.SX, rates: ca.SX) -> ca.SX:
    """J_e_dot phi_dot (3,): the angular acceleration left when the Euler accelerations are zero (eq. 38)."""
    ca_, cb, sa, sb = ca.cos(angles[0]), ca.cos(angles[1]), ca.sin(angles[0]), ca.sin(angles[1])
    da, db, dg = rates[0], rates[1], rates[2]
    return ca.vertcat(
        db * dg * cb,
        -ca_ * da * dg * cb + sa * (db * dg * sb - db * da),
        -sa * da * dg * cb + ca_ * (db * da - db * dg * sb),
    )


def pose_rate_to_twist(pose: ca.SX) -> ca.SX:
    """T (6, 6): twist [h_dot, omega] = T pose_dot; the block-diagonal matrix of eq. 29."""
    return ca.diagcat(ca.SX.eye(3), euler_rate_jacobian(pose[3:6]))


def twist_bias(pose: ca.SX, pose_rate: ca.SX) -> ca.SX:
    """T_dot pose_dot (6,): what twist_dot holds when the pose acceleration is zero."""
    return ca.vertcat(ca.SX.zeros(3), euler_bias_acceleration(pose[3:6], pose_rate[3:6]))
