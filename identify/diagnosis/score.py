"""Score statistics of causes: how much of a misfit each explains, before any of them is fitted.

Let r be the residuals of a problem at its optimum, whitened, with one row for each thing known
beside the poses, and J their derivatives with respect to the parameters. Let D be the derivatives
with respect to the sizes s of one or several causes. What the parameters can take up is projected
off both, by an orthonormal basis of J's columns. To first order the causes lower the cost |r|^2 by

    S = |U^T r|^2,    with U an orthonormal basis of the projected D,

at the sizes s = -D^+ r. This is Rao's score statistic, also called the Lagrange multiplier test. If
the model is right, S is chi-square with as many degrees of freedom as U has columns. A cause that
the parameters take up has no projected column, and cannot be judged.

References
----------
Rao, Large sample tests of statistical hypotheses concerning several parameters, Proc. Cambridge
Philosophical Society 44(1), 1948. Sörbom, Model modification, Psychometrika 54(3), 1989.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dynamics import DynamicsError
from identify.arrays import Array
from identify.diagnosis.cause import Cause, with_causes
from identify.estimation.output_error import OutputErrorProblem
from identify.runtime import in_threads

HIDDEN = 1e-5
"""Share of a column's length below which nothing is left of it beside the parameters.

Differences of runs that stick and slip are not more exact.
"""

DEPENDENT = 1e-3
"""Smallest share of the largest singular value for which directions of a group count as several."""


def residuals(problem: OutputErrorProblem, parameters: Array) -> Array:
    """Return all residuals (m,): of what is known beside the poses, then of each run.

    Raises LoopFailure if the model is unstable.
    """
    known, _ = problem.known(parameters)
    return np.concatenate([known, *(run.misses(parameters).ravel() for run in problem.runs)])


def parameter_columns(problem: OutputErrorProblem, parameters: Array) -> tuple[Array, Array]:
    """Return `residuals` (m,) and their derivatives (m, p) with respect to the parameters.

    Raises LoopFailure if the model is unstable.
    """
    known, known_rows = problem.known(parameters)
    parts = [known]
    rows = [known_rows]
    for run in problem.runs:
        missed, shown = run.shown_residuals(parameters)
        parts.append(missed.ravel())
        rows.append(run.of_all(shown).reshape(missed.size, -1))
    return np.concatenate(parts), np.vstack(rows)


def allowed(problem: OutputErrorProblem, parameters: Array) -> Array:
    """Return parameters (p,) that a problem's law of the drives allows, raised where it must be."""
    bounds = problem.bounds
    above = np.isin(bounds.layout.names, problem.guess.above_zero)
    return np.where(above, np.maximum(parameters, bounds.lower), parameters)


def each_residuals(problems: Sequence[OutputErrorProblem], parameters: Array) -> list[Array | None]:
    """Return the `residuals` (m,) of each problem, None where its model is unstable."""

    def of(problem: OutputErrorProblem) -> Array | None:
        try:
            return residuals(problem, allowed(problem, parameters))
        except DynamicsError:
            return None

    return in_threads(of, problems)


def cause_columns(
    problem: OutputErrorProblem, parameters: Array, causes: Sequence[Cause], sizes: Array
) -> Array:
    """Return derivatives (m, k) of `residuals` with respect to the sizes of causes, at sizes (k,).

    A column is NaN where the model is unstable.
    """
    columns = np.zeros((len(residuals(problem, parameters)), len(causes)))
    slow = [
        place
        for place, one in enumerate(causes)
        # one that is there or not has no derivative, and one that is only tried none at nothing
        if one.quick is None and one.step and (sizes[place] or not one.tried)
    ]
    for place, column in zip(
        slow, _differences(problem, parameters, causes, sizes, slow), strict=True
    ):
        columns[:, place] = column
    there = with_causes(problem, causes, sizes)
    for quick in {one.quick[0] for one in causes if one.quick is not None}:
        found = quick(there, parameters)
        for place, one in enumerate(causes):
            if one.quick is not None and one.quick[0] is quick:
                columns[:, place] = found[:, one.quick[1]]
    return columns


def _differences(
    problem: OutputErrorProblem,
    parameters: Array,
    causes: Sequence[Cause],
    sizes: Array,
    places: Sequence[int],
) -> list[Array | float]:
    """Return central differences (m,) for the causes at some places, one-sided at least sizes.

    They are NaN where the model is unstable.
    """
    spans = [(max(-causes[k].step, causes[k].least - sizes[k]), causes[k].step) for k in places]
    moves = np.eye(len(causes))[list(places)]
    ends = [
        with_causes(problem, causes, sizes + by * move)
        for span, move in zip(spans, moves, strict=True)
        for by in span
    ]
    found = each_residuals(ends, parameters)
    return [
        np.nan if less is None or more is None else (more - less) / (high - low)
        for less, more, (low, high) in zip(found[::2], found[1::2], spans, strict=True)
    ]


@dataclass(frozen=True)
class OrthogonalComplement:
    """Space beside the columns of a problem's parameters.

    basis (m, q): orthonormal basis of these columns.
    """

    basis: Array

    @classmethod
    def of(cls, columns: Array) -> "OrthogonalComplement":
        """Return the space beside columns (m, q) that are independent of each other."""
        scale = np.linalg.norm(columns, axis=0)
        return cls(np.linalg.qr(columns[:, scale > 0] / scale[scale > 0])[0])

    def without(self, columns: Array) -> "OrthogonalComplement":
        """Return the part of this space that lies beside further columns (m, k), too."""
        return OrthogonalComplement(
            np.hstack([self.basis, OrthogonalComplement.of(self.part(columns)).basis])
        )

    def part(self, rows: Array) -> Array:
        """Return the part of residuals (m,) or columns (m, k) that lies in this space."""
        beside = rows - self.basis @ (self.basis.T @ rows)
        # once more, as rounding leaves what is small beside the columns themselves
        return np.asarray(beside - self.basis @ (self.basis.T @ beside))


@dataclass(frozen=True)
class Score:
    """Score statistic of one or several causes.

    Attributes
    ----------
    statistic : float
        Fall of the cost that is expected if the causes are fitted.
    freedoms : int
        Number of directions in which their sizes show.
    sizes : ndarray, shape (k,)
        Sizes that are expected.
    directions : ndarray, shape (m, freedoms)
        Orthonormal directions U of the residuals in which the causes show.
    by_directions : ndarray, shape (k, freedoms)
        Change of the sizes by U^T r.
    """

    statistic: float
    freedoms: int
    sizes: Array
    directions: Array
    by_directions: Array

    def covariance(self, spread: Array | None = None) -> Array:
        """Return the covariance (k, k) of the sizes.

        spread (freedoms, freedoms): that of U^T r beyond the noise's. None: there is only noise.
        """
        whole = np.eye(self.freedoms) if spread is None else np.eye(self.freedoms) + spread
        return np.asarray(self.by_directions @ whole @ self.by_directions.T)


def score(columns: Array, residual: Array, lengths: Array) -> Score:
    """Return the score of causes with columns (m, k), projected as the residuals (m,) are.

    lengths (k,): those of the columns before they were projected.
    """
    left = np.linalg.norm(columns, axis=0)
    shown = left > HIDDEN * lengths
    count = len(left)
    if not shown.any():
        return Score(0.0, 0, np.zeros(count), columns[:, :0], np.zeros((count, 0)))
    unit = columns[:, shown] / left[shown]
    directions, lasting, turned = np.linalg.svd(unit, full_matrices=False)
    kept = lasting > DEPENDENT * lasting[0]
    directions = directions[:, kept]
    along = directions.T @ residual
    inverse = np.zeros((count, int(kept.sum())))
    inverse[shown] = (turned[kept].T / lasting[kept]) / left[shown][:, None]
    return Score(float(along @ along), int(kept.sum()), -inverse @ along, directions, inverse)


def first_columns(
    problem: OutputErrorProblem,
    parameters: Array,
    causes: Sequence[Cause],
    beside: OrthogonalComplement,
) -> tuple[tuple[Cause, ...], Array]:
    """Return causes, and their columns (m, k) where none has a size.

    A cause that is tried at some sizes has the difference to the largest gain there as its column,
    by its size. It is returned with that size alone.
    """
    columns = cause_columns(problem, parameters, causes, np.zeros(len(causes)))
    residual = residuals(problem, parameters)
    left = beside.part(residual)
    tried = [(place, size) for place, one in enumerate(causes) for size in one.tried]
    ends = [causes[place].change(problem, size) for place, size in tried]
    found = each_residuals(ends, parameters)
    chosen = list(causes)
    gains = np.zeros(len(causes))
    for (place, size), there in zip(tried, found, strict=True):
        if there is None:
            continue
        column = ((there - residual) / size)[:, None]
        judged = score(beside.part(column), left, np.linalg.norm(column, axis=0))
        if judged.sizes[0] > 0 and judged.statistic > gains[place]:
            gains[place] = judged.statistic
            columns[:, place] = column[:, 0]
            chosen[place] = replace(causes[place], tried=(size,))
    return tuple(chosen), columns
