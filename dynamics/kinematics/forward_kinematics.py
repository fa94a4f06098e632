"""Forward kinematics: Newton's method on the closure of the loops, for all rows of a batch at once.

The gaps of the loops are smooth in the pose whether or not a leg can reach it, so no step can leave their domain. A
pose found this way may have a leg in another assembly; the closed-form inverse kinematics has the last word.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from dynamics.checks import row_text
from dynamics.compiled.machine_code import MachineFunction
from dynamics.errors import ConvergenceError, ShapeError
from dynamics.kinematics.chart import Chart

# Steps smaller than the first end the iteration; the second is what counts as solved, in rad or m.
STEP_TOLERANCE = 1e-12
ANGLE_TOLERANCE = 1e-12
MAX_ITERATIONS = 50
HALVINGS = 20

# A gap of squared lengths, in m^2, that is rounding.
CLOSED = 1e-14

# Poses nearer than this share of the radius in which they were searched, and so near in rotation, are one.
SAME = 1e-5


Functions = Mapping[str, MachineFunction]
"""Compiled functions of a robot, of which `loop_closure` and `inverse_kinematics` are asked for."""

Closure = Callable[[np.ndarray, np.ndarray], Sequence[np.ndarray]]
"""Of poses (N, 6) and joint coordinates (N, n): gaps of the loops (N, n, 1), m^2, and how they change with the
platform's coordinates (N, n, n)."""


@dataclass(frozen=True)
class ForwardSolution:
    """Poses (6,) or (N, 6) that a search ended with, Newton steps () or (N,) that it took, and what the joint
    coordinates there lack of those asked for (n,) or (N, n), rad or m: NaN where a leg cannot reach."""

    pose: np.ndarray
    iterations: np.ndarray
    residual: np.ndarray

    @property
    def converged(self) -> np.ndarray:
        """Whether each row () or (N,) has the joint coordinates asked for, to ANGLE_TOLERANCE."""
        return np.asarray((self.residual < ANGLE_TOLERANCE).all(axis=-1))


def solve(functions: Functions, chart: Chart, theta: np.ndarray, start: np.ndarray) -> ForwardSolution:
    """Poses whose joint coordinates (n,) or (N, n) are theta, searched from start (6,) or (N, 6).

    Raises ConvergenceError with row, leg and residual where no pose near the start has these coordinates.
    """
    angles = np.atleast_2d(theta)
    if (start.ndim == 2 and start.shape[0] not in (1, len(angles))) or start.ndim > theta.ndim:
        raise ShapeError(
            f"initial_pose has shape {start.shape}, must be (6,) or one row for each of theta {theta.shape}"
        )
    poses = np.array(np.broadcast_to(start, (len(angles), 6)))
    found = search(functions, chart, angles, poses)
    _check(functions, angles, found)
    rows, residual = theta.shape[:-1], found.residual.reshape(theta.shape)
    return ForwardSolution(found.pose.reshape(*rows, 6), found.iterations.reshape(rows), residual)


def assembly_modes(
    functions: Functions, chart: Chart, theta: np.ndarray, centre: np.ndarray, radius: float, starts: int, seed: int
) -> np.ndarray:
    """The distinct poses (k, 6) with joint coordinates theta (n,) that Newton's method finds from random poses around a
    place, `centre` (3,) give or take `radius` (m), turned in all directions that the chart allows.

    Each is checked by the inverse kinematics. The nearest to home comes first.
    """
    rng = np.random.default_rng(seed)
    turns = Rotation.random(starts, random_state=rng).as_euler("XYZ")
    drawn = np.hstack([centre + radius * rng.uniform(-1, 1, (starts, 3)), turns])
    ended = search(functions, chart, np.tile(theta, (starts, 1)), chart.pose(chart.coordinates(drawn)))
    found = ended.pose[ended.converged]
    turned = Rotation.from_euler("XYZ", found[:, 3:])
    found = np.hstack([found[:, :3], turned.as_euler("XYZ")])
    order = np.argsort(np.linalg.norm(found[:, :3] - np.array(chart.home)[:3], axis=1), kind="stable")
    found, matrices = found[order], turned.as_matrix()[order].reshape(-1, 9)
    kept: list[int] = []
    for row, (place, matrix) in enumerate(zip(found[:, :3], matrices, strict=True)):
        near = np.abs(found[kept, :3] - place).max(axis=1, initial=0.0) < SAME * radius
        if not (near & (np.abs(matrices[kept] - matrix).max(axis=1, initial=0.0) < SAME)).any():
            kept.append(row)
    return found[kept]


def search(functions: Functions, chart: Chart, theta: np.ndarray, start: np.ndarray) -> ForwardSolution:
    """Best poses (N, 6) for joint coordinates (N, n) from starts (N, 6)."""
    poses, iterations = close_loops(functions["loop_closure"], chart, theta, start)
    found = functions["inverse_kinematics"](poses)[0][..., 0]
    return ForwardSolution(poses, iterations, np.abs(theta - found))


def close_loops(closure: Closure, chart: Chart, theta: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses (N, 6) that close the loops best for joint coordinates (N, n) from starts (N, 6), and steps taken (N,).

    Newton's iteration with step halving; rows leave it when their step or what it gains is nil.
    """
    poses = np.array(start)
    active, iterations = np.arange(len(theta)), np.zeros(len(theta), dtype=int)
    gaps, jacobians = closure(poses, theta)
    for _ in range(MAX_ITERATIONS):
        steps = -_solve_each(jacobians, gaps)[..., 0] @ chart.basis.T
        trials, gaps, jacobians, better = _damped(closure, theta[active], poses[active], steps, gaps)
        poses[active] = trials
        iterations[active] += 1
        going = better & (np.abs(steps).max(axis=1) > STEP_TOLERANCE)
        active, gaps, jacobians = active[going], gaps[going], jacobians[going]
        if not len(active):
            break
    return poses, iterations


def _damped(
    closure: Closure, theta: np.ndarray, poses: np.ndarray, steps: np.ndarray, gaps: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Poses, gaps and Jacobians after the first of the full step and its halves that narrows the gaps, and for which
    rows one does; a last full step that rounding keeps from gaining is taken."""
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


def _solve_each(matrices: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solutions (N, 6, 1); the shortest of least squares where a matrix is singular, NaN where one has overflowed."""
    try:
        return np.linalg.solve(matrices, right)
    except np.linalg.LinAlgError:
        finite = np.isfinite(matrices).all(axis=(1, 2))
        solutions = np.full(right.shape, np.nan)
        solutions[finite] = np.linalg.pinv(matrices[finite]) @ right[finite]
        return solutions


def _check(functions: Functions, theta: np.ndarray, found: ForwardSolution) -> None:
    if found.converged.all():
        return
    row = int(np.argmin(found.converged))
    leg = int(np.argmin(found.residual[row] < ANGLE_TOLERANCE))
    lacking = found.residual[row, leg]
    gap = np.abs(functions["loop_closure"](found.pose[row : row + 1], theta[row : row + 1])[0]).max()
    why = f"its loops stay open by {gap:.3g} m^2 of squared length"
    if gap < CLOSED:
        why = f"it closes the loops with leg {leg + 1} folded the other way than at home"
    there = f"joint {leg + 1} is off by {lacking:.3g}, limit {ANGLE_TOLERANCE:.0e}"
    if np.isnan(lacking):
        there = f"leg {leg + 1} cannot reach it"
    raise ConvergenceError(
        f"forward kinematics found no pose with joint coordinates {row_text(theta[row], 4)} (row {row}) in "
        f"{found.iterations[row]} steps: of the nearest, {why}; {there}"
    )
