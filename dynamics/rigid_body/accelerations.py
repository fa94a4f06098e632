"""From the equation of motion to the acceleration, and to the derivatives of the slope of the state (CasADi).

Both go through a factor of the mass matrix, see `factored`. Derivatives are columns, one a variable: parameters, or
numbers of the start. All of them solve the same equations.
"""

from collections.abc import Sequence

import casadi as ca

from dynamics.compiled.lanes import ColumnFunction
from dynamics.expressions import function
from dynamics.parameters import LANES, ParameterLayout

STAGES = 4
"""Of a step of the integrator."""


def free_acceleration(size: int, joints: int) -> ca.Function:
    """(factor of M (m, m), b (m,), J_theta (n, m), torque (n,)) -> q_ddot (m,) under torques at free joints, of m
    coordinates (`size`) and n joints."""
    factor, bias = ca.SX.sym("factor", size, size), ca.SX.sym("bias", size)
    jacobian, torque = ca.SX.sym("jacobian", joints, size), ca.SX.sym("torque", joints)
    push = [summed(-bias[j], ca.vertsplit(jacobian[:, j]), ca.vertsplit(torque)) for j in range(size)]
    return function("free_acceleration", [factor, bias, jacobian, torque], [ca.vertcat(*_solved(factor, push))])


def response(size: int) -> ca.Function:
    """(row (m,), factor of M (m, m)) -> M^-1 row (m,)."""
    row, factor = ca.SX.sym("row", size), ca.SX.sym("factor", size, size)
    return function("response", [row, factor], [ca.vertcat(*_solved(factor, ca.vertsplit(row)))])


def acceleration_in_lanes(free: ca.Function, responding: ca.Function) -> ColumnFunction:
    """Both for several states at once: in each column factor, b, J_theta, torque and a row; q_ddot and M^-1 row."""
    factor, *others = free.sx_in()
    row = responding.sx_in()[0]
    outputs = [*free.call([factor, *others]), *responding.call([row, factor])]
    return ColumnFunction(ca.Function("acceleration_in_lanes", [factor, *others, row], outputs), 0, LANES, LANES)


def slope_derivative(layout: ParameterLayout, m: int) -> ColumnFunction:
    """Derivatives of the slope of the state of a platform with m coordinates, and of the net torque of joints, as if
    none was stuck.

    What all columns share, of one of the stages that lie side by side: what `motion_derivatives` returns; J_theta (n,
    m), and the same with zeros for stuck joints; the factor of M (m, m); by what a joint's torque falls with its
    velocity (n,), and grows with its error, the integral of that and the command's rate (n,). In each column the
    derivatives of pose and rate (m,), joint integral, command and its rate (n,); of -M q_ddot - b (m,) and of the
    torque (n,) at a fixed state.
    In each column then: those of rate, acceleration (m,), command error and torque (n,).
    """
    n = layout.joints
    by_pose, by_rate, factor = (ca.SX.sym(name, m, m) for name in ("by_pose", "by_rate", "factor"))
    joint_by_pose, joint_by_rate, jacobian, pushing = (ca.SX.sym(f"joints{k}", n, m) for k in range(4))
    columns, (damping, *gains) = ca.SX.sym("columns", m, layout.rigid.stop), (ca.SX.sym(f"by{k}", n) for k in range(4))
    pose, rate, push = (ca.vertsplit(ca.SX.sym(name, m)) for name in ("pose", "rate", "push"))
    integral, command, command_rate, direct = (ca.vertsplit(ca.SX.sym(f"of_joints{k}", n)) for k in range(4))
    by_error, by_integral, by_command_rate = gains
    errors, torques = [], []
    for i in range(n):
        errors.append(lessened(command[i], ca.horzsplit(jacobian[i, :]), pose))
        velocity = summed(ca.SX(0), ca.horzsplit(0.5 * joint_by_rate[i, :]), pose)
        velocity = summed(velocity, ca.horzsplit(jacobian[i, :]), rate)
        felt = [errors[i], command_rate[i], integral[i]]
        pushed = summed(direct[i], [by_error[i], by_command_rate[i], by_integral[i]], felt)
        torques.append(pushed - damping[i] * velocity)
    accelerations = []
    for j in range(m):
        left = lessened(push[j], ca.horzsplit(by_pose[j, :]), pose)
        left = lessened(left, ca.horzsplit(by_rate[j, :]), rate)
        accelerations.append(summed(left, ca.vertsplit(pushing[:, j]), torques))
    common = [by_pose, by_rate, columns, joint_by_pose, joint_by_rate, jacobian, pushing, factor, damping, *gains]
    rows = [ca.vertcat(*row) for row in (pose, rate, integral, command, command_rate, push, direct)]
    outputs = [rate, _solved(factor, accelerations), errors, torques]
    found = ca.Function("slope_derivative", [*common, *rows], [ca.vertcat(*row) for row in outputs])
    return ColumnFunction(found, len(common), layout.derivatives(m), LANES, STAGES)


def factored(matrix: ca.SX) -> ca.SX:
    """Factor of a symmetric matrix L D L^T (m, m): L below the diagonal, whose own entries are ones; above it D L^T; on
    it the reciprocals of D, which are not all positive and finite where the matrix is not positive definite."""
    size = matrix.shape[0]
    factor = ca.SX.zeros(size, size)
    for i in range(size):
        for j in range(i + 1):
            left = matrix[i, j]
            for k in range(j):
                left -= factor[i, k] * factor[k, j]
            factor[j, i] = left
            factor[i, j] = left * factor[j, j] if i > j else 1 / left
    return factor


def summed(start: ca.SX, row: Sequence[ca.SX], column: Sequence[ca.SX]) -> ca.SX:
    """A start and products, added in their order."""
    return sum((one * other for one, other in zip(row, column, strict=True)), start)


def lessened(start: ca.SX, row: Sequence[ca.SX], column: Sequence[ca.SX]) -> ca.SX:
    """A start from which products are taken in their order."""
    for one, other in zip(row, column, strict=True):
        start -= one * other
    return start


def _solved(factor: ca.SX, right: list[ca.SX]) -> list[ca.SX]:
    """x of L D L^T x = right, in the order of `linear_algebra_kernels.solve`."""
    size, found = len(right), list(right)
    for i in range(size):
        for k in range(i):
            found[i] -= factor[i, k] * found[k]
    for i in range(size - 1, -1, -1):
        found[i] *= factor[i, i]
        for k in range(i + 1, size):
            found[i] -= factor[k, i] * found[k]
    return found
