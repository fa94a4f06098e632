"""Forward kinematics: Newton's method on the closure of the loops, for all rows of a batch at once.

The gaps of the loops are smooth functions of the pose, even if a leg cannot reach it. Hence no step
can leave their domain. In the pose that is found, a leg can be folded the other way than at home.
The closed-form inverse kinematics therefore checks the result.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from dynamics.checks import row_text
from dynamics.compiled.machine_code import MachineFunction
from dynamics.errors import ConvergenceError, ShapeError
from dynamics.kinematics.platform import Chart

# The iteration ends when no entry of a step, m or rad, is larger than this.
STEP_TOLERANCE = 1e-12
# Residual of a joint coordinate, rad or m, below which a pose counts as a solution.
ANGLE_TOLERANCE = 1e-12
MAX_ITERATIONS = 50  # largest number of steps
HALVINGS = 20  # largest number of lengths of a step that are tried, each half the one before

# Gap, m^2, below which a loop is closed up to rounding errors.
CLOSED = 1e-14

# Two poses are the same if their positions differ by less than this, relative to the radius of the
# search, and the entries of their rotation matrices by less than this.
SAME = 1e-5


# Compiled functions of a robot. `loop_closure` and `inverse_kinematics` are needed.
Functions = Mapping[str, MachineFunction]
# Function of poses (N, 6) and joint coordinates (N, n). It returns the gaps of the loops (N, n, 1),
# m^2, and their derivatives (N, n, n) with respect to the coordinates of the platform.
Closure = Callable[[np.ndarray, np.ndarray], Sequence[np.ndarray]]


@dataclass(frozen=True)
class ForwardSolution:
    """Result of a search.

    `pose` (6,) or (N, 6) is the final pose, after `iterations` () or (N,) Newton steps.
    `residual` (n,) or (N, n) is the magnitude of the difference between the given joint coordinates
    and those of the pose, rad or m. It is NaN if a leg cannot reach the pose.
    """

    pose: np.ndarray
    iterations: np.ndarray
    residual: np.ndarray

    @property
    def converged(self) -> np.ndarray:
        """True for each row () or (N,) whose residual is below ANGLE_TOLERANCE."""
        return np.asarray((self.residual < ANGLE_TOLERANCE).all(axis=-1))


def solve(
    functions: Functions, chart: Chart, theta: np.ndarray, start: np.ndarray
) -> ForwardSolution:
    """Poses with joint coordinates theta (n,) or (N, n), found from a start (6,) or (N, 6).

    Raises ConvergenceError, with row, leg and residual, if no pose is found. Raises ShapeError if
    the starts do not match the rows of theta.
    """
    angles = np.atleast_2d(theta)
    if (start.ndim == 2 and start.shape[0] not in (1, len(angles))) or start.ndim > theta.ndim:
        raise ShapeError(
            f"initial_pose has shape {start.shape} but must be (6,) or one row for each of theta "
            f"{theta.shape}"
        )
    poses = np.array(np.broadcast_to(start, (len(angles), 6)))
    solution = search(functions, chart, angles, poses)
    _check(functions, angles, solution)
    rows = theta.shape[:-1]
    residual = solution.residual.reshape(theta.shape)
    return ForwardSolution(
        solution.pose.reshape(*rows, 6), solution.iterations.reshape(rows), residual
    )


def assembly_modes(
    functions: Functions,
    chart: Chart,
    theta: np.ndarray,
    centre: np.ndarray,
    radius: float,
    starts: int,
    seed: int,
) -> np.ndarray:
    """Distinct poses (k, 6) with joint coordinates theta (n,), found from random starts.

    The starts are in a cube about `centre` (3,), which reaches `radius`, m, in each direction, with
    any orientation that the chart allows. Each pose is checked by the inverse kinematics. Poses are
    sorted by the distances of their positions from home.
    """
    rng = np.random.default_rng(seed)
    turns = Rotation.random(starts, random_state=rng).as_euler("XYZ")
    drawn = np.hstack([centre + radius * rng.uniform(-1, 1, (starts, 3)), turns])
    solution = search(
        functions, chart, np.tile(theta, (starts, 1)), chart.pose(chart.coordinates(drawn))
    )
    poses = solution.pose[solution.converged]
    rotations = Rotation.from_euler("XYZ", poses[:, 3:])
    # a rotation has several sets of Euler angles; use the principal ones
    poses = np.hstack([poses[:, :3], rotations.as_euler("XYZ")])
    order = np.argsort(
        np.linalg.norm(poses[:, :3] - np.array(chart.home)[:3], axis=1), kind="stable"
    )
    poses = poses[order]
    matrices = rotations.as_matrix()[order].reshape(-1, 9)
    kept: list[int] = []
    for row, (position, matrix) in enumerate(zip(poses[:, :3], matrices, strict=True)):
        near = np.abs(poses[kept, :3] - position).max(axis=1, initial=0.0) < SAME * radius
        if not (near & (np.abs(matrices[kept] - matrix).max(axis=1, initial=0.0) < SAME)).any():
            kept.append(row)
    return poses[kept]


def search(
    functions: Functions, chart: Chart, theta: np.ndarray, start: np.ndarray
) -> ForwardSolution:
    """Final poses (N, 6) of the search for joint coordinates (N, n) from starts (N, 6)."""
    poses, iterations = close_loops(functions["loop_closure"], chart, theta, start)
    joints = functions["inverse_kinematics"](poses)[0][..., 0]
    return ForwardSolution(poses, iterations, np.abs(theta - joints))


def close_loops(
    closure: Closure, chart: Chart, theta: np.ndarray, start: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Final poses (N, 6) of Newton's method for joint coordinates (N, n), and step counts (N,).

    Steps that do not reduce the gaps of the loops are halved. A row is finished when its step is
    negligible or reduces its gaps no further, or after `MAX_ITERATIONS` steps.
    """
    poses = np.array(start)
    active = np.arange(len(theta))
    iterations = np.zeros(len(theta), dtype=int)
    gaps, jacobians = closure(poses, theta)
    for _ in range(MAX_ITERATIONS):
        steps = -_solve_each(jacobians, gaps)[..., 0] @ chart.basis.T
        trials, gaps, jacobians, better = _damped(
            closure, theta[active], poses[active], steps, gaps
        )
        poses[active] = trials
        iterations[active] += 1
        going = better & (np.abs(steps).max(axis=1) > STEP_TOLERANCE)
        # finished rows are not computed any more
        active = active[going]
        gaps = gaps[going]
        jacobians = jacobians[going]
        if not len(active):
            break
    return poses, iterations


def _damped(
    closure: Closure, theta: np.ndarray, poses: np.ndarray, steps: np.ndarray, gaps: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Poses, gaps and Jacobians after a damped step, and a mask (N,) of the rows with such a step.

    The step is halved until it reduces the gaps. A negligible step is accepted even if rounding
    keeps it from reducing the gaps. A row whose step never reduces them keeps its pose.
    """
    before = np.linalg.norm(gaps[..., 0], axis=1)
    scale = np.ones(len(poses))
    small = np.abs(steps).max(axis=1) <= STEP_TOLERANCE
    for _ in range(HALVINGS):
        trials = poses + scale[:, None] * steps
        new_gaps, jacobians = closure(trials, theta)
        better = (np.linalg.norm(new_gaps[..., 0], axis=1) < before) | small
        if better.all():
            break
        scale[~better] /= 2
    return np.where(better[:, None], trials, poses), new_gaps, jacobians, better


def _solve_each(matrices: np.ndarray, right_sides: np.ndarray) -> np.ndarray:
    """Solutions (N, m, 1) of linear systems.

    For a singular matrix, the result is the least-squares solution of minimum norm. For a matrix
    that has overflowed, it is NaN.
    """
    try:
        return np.linalg.solve(matrices, right_sides)
    except np.linalg.LinAlgError:
        # NumPy refuses all matrices if one of them is singular
        finite = np.isfinite(matrices).all(axis=(1, 2))
        solutions = np.full(right_sides.shape, np.nan)
        solutions[finite] = np.linalg.pinv(matrices[finite]) @ right_sides[finite]
        return solutions


def _check(functions: Functions, theta: np.ndarray, solution: ForwardSolution) -> None:
    """Raise ConvergenceError for the first row that has not converged."""
    if solution.converged.all():
        return
    row = int(np.argmin(solution.converged))
    leg = int(np.argmin(solution.residual[row] < ANGLE_TOLERANCE))
    difference = solution.residual[row, leg]
    gap = np.abs(
        functions["loop_closure"](solution.pose[row : row + 1], theta[row : row + 1])[0]
    ).max()
    loop_text = f"leaves a gap of {gap:.3g} m^2 in squared length"
    if gap < CLOSED:
        loop_text = f"closes the loops, but leg {leg + 1} is folded the other way than at home"
    joint_text = f"joint {leg + 1} is off by {difference:.3g}, limit {ANGLE_TOLERANCE:.0e}"
    if np.isnan(difference):
        joint_text = f"leg {leg + 1} cannot reach this pose"
    raise ConvergenceError(
        f"forward kinematics found no pose with joint coordinates {row_text(theta[row], 4)} (row "
        f"{row}) in {solution.iterations[row]} steps: the last pose {loop_text}; {joint_text}"
    )
