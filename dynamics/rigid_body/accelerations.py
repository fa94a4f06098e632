"""Acceleration from the equation of motion, and derivatives of the slope of the state (CasADi).

The slope of a state is its time derivative. All functions use a factor of the mass matrix (see
`factored`). Derivatives are columns, one for each variable. A variable is a parameter or an entry
of the start state, for example. All columns solve the same linear equations.
"""

from collections.abc import Sequence

import casadi as ca

from dynamics.compiled.lanes import ColumnFunction
from dynamics.expressions import function
from dynamics.parameters import LANES, ParameterLayout

STAGES = 4  # number of stages of a step of the integrator


def free_acceleration(size: int, joints: int) -> ca.Function:
    """Function of the acceleration under torques, if no joint sticks.

    It maps (factor of M (m, m), b (m,), J_theta (n, m), torque (n,)) to q_ddot (m,). m is `size`,
    the number of coordinates, and n is `joints`.
    """
    factor = ca.SX.sym("factor", size, size)
    bias = ca.SX.sym("bias", size)
    jacobian = ca.SX.sym("jacobian", joints, size)
    torque = ca.SX.sym("torque", joints)
    push = [
        summed(-bias[j], ca.vertsplit(jacobian[:, j]), ca.vertsplit(torque)) for j in range(size)
    ]
    return function(
        "free_acceleration", [factor, bias, jacobian, torque], [ca.vertcat(*_solved(factor, push))]
    )


def response(size: int) -> ca.Function:
    """Function (row (m,), factor of M (m, m)) -> M^-1 row (m,)."""
    row = ca.SX.sym("row", size)
    factor = ca.SX.sym("factor", size, size)
    return function("response", [row, factor], [ca.vertcat(*_solved(factor, ca.vertsplit(row)))])


def acceleration_in_lanes(free: ca.Function, responding: ca.Function) -> ColumnFunction:
    """Function of `free_acceleration` and `response` for several states at once.

    The inputs of a column are the factor, b, J_theta, torque and a row, and its outputs are q_ddot
    and M^-1 row.
    """
    factor, *others = free.sx_in()
    row = responding.sx_in()[0]
    outputs = [*free.call([factor, *others]), *responding.call([row, factor])]
    return ColumnFunction(
        ca.Function("acceleration_in_lanes", [factor, *others, row], outputs), 0, LANES, LANES
    )


def slope_derivative(layout: ParameterLayout, m: int) -> ColumnFunction:
    """Function for the derivatives of the slope of a state, and of the net joint torques.

    The torques that hold stuck joints are not included. The platform has m coordinates. All columns
    share the inputs of one stage; stages are side by side in memory. These inputs are the outputs
    of `motion_derivatives`; J_theta (n, m), and J_theta with zeros for stuck joints; the factor of
    M (m, m); the negated derivatives (n,) of joint torques with respect to joint velocities; and
    their derivatives (n,) with respect to the error, its integral, and the rate of the command.

    The inputs of each column are the derivatives of q and its rate (m,), and of joint integral,
    command and command rate (n,). Two more are derivatives at a fixed state: `push` (m,) of -M
    q_ddot - b, and `direct` (n,) of the torque. The outputs of a column are the derivatives of
    rate, acceleration (m,), command error and torque (n,).
    """
    n = layout.joints
    by_pose, by_rate, factor = (ca.SX.sym(name, m, m) for name in ("by_pose", "by_rate", "factor"))
    joint_by_pose, joint_by_rate, jacobian, pushing = (
        ca.SX.sym(f"joints{k}", n, m) for k in range(4)
    )
    columns = ca.SX.sym("columns", m, layout.rigid.stop)
    damping, *gains = (ca.SX.sym(f"by{k}", n) for k in range(4))
    pose, rate, push = (ca.vertsplit(ca.SX.sym(name, m)) for name in ("pose", "rate", "push"))
    integral, command, command_rate, direct = (
        ca.vertsplit(ca.SX.sym(f"of_joints{k}", n)) for k in range(4)
    )
    by_error, by_integral, by_command_rate = gains
    errors = []
    torques = []
    for i in range(n):
        errors.append(lessened(command[i], ca.horzsplit(jacobian[i, :]), pose))
        # d(joint velocity)/d(pose) is half of d(joint acceleration)/d(rate)
        velocity = summed(ca.SX(0), ca.horzsplit(0.5 * joint_by_rate[i, :]), pose)
        velocity = summed(velocity, ca.horzsplit(jacobian[i, :]), rate)
        inputs = [errors[i], command_rate[i], integral[i]]
        driven = summed(direct[i], [by_error[i], by_command_rate[i], by_integral[i]], inputs)
        torques.append(driven - damping[i] * velocity)
    accelerations = []
    for j in range(m):
        force = lessened(push[j], ca.horzsplit(by_pose[j, :]), pose)
        force = lessened(force, ca.horzsplit(by_rate[j, :]), rate)
        accelerations.append(summed(force, ca.vertsplit(pushing[:, j]), torques))
    common = [
        by_pose,
        by_rate,
        columns,
        joint_by_pose,
        joint_by_rate,
        jacobian,
        pushing,
        factor,
        damping,
        *gains,
    ]
    rows = [ca.vertcat(*row) for row in (pose, rate, integral, command, command_rate, push, direct)]
    outputs = [rate, _solved(factor, accelerations), errors, torques]
    function_of_column = ca.Function(
        "slope_derivative", [*common, *rows], [ca.vertcat(*row) for row in outputs]
    )
    return ColumnFunction(function_of_column, len(common), layout.derivatives(m), LANES, STAGES)


def factored(matrix: ca.SX) -> ca.SX:
    """Factorisation L D L^T of a symmetric matrix (m, m), in one matrix.

    L, whose diagonal is one, is below the diagonal. D L^T is above it. The diagonal has the
    reciprocals of D, which are all positive and finite only if the matrix is positive definite.
    """
    size = matrix.shape[0]
    factor = ca.SX.zeros(size, size)
    for i in range(size):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= factor[i, k] * factor[k, j]
            factor[j, i] = rest
            factor[i, j] = rest * factor[j, j] if i > j else 1 / rest
    return factor


def summed(start: ca.SX, row: Sequence[ca.SX], column: Sequence[ca.SX]) -> ca.SX:
    """Start plus the products of two sequences, added in order."""
    return sum((one * other for one, other in zip(row, column, strict=True)), start)


def lessened(start: ca.SX, row: Sequence[ca.SX], column: Sequence[ca.SX]) -> ca.SX:
    """Start minus the products of two sequences, subtracted in order."""
    for one, other in zip(row, column, strict=True):
        start -= one * other
    return start


def _solved(factor: ca.SX, right: list[ca.SX]) -> list[ca.SX]:
    """Solution of L D L^T x = right, in the order of `linear_algebra_kernels.solve`."""
    size = len(right)
    solution = list(right)
    for i in range(size):
        for k in range(i):
            solution[i] -= factor[i, k] * solution[k]
    for i in range(size - 1, -1, -1):
        solution[i] *= factor[i, i]
        for k in range(i + 1, size):
            solution[i] -= factor[k, i] * solution[k]
    return solution
