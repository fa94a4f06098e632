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

from dataclasses import dataclass

import numpy as np

from identify.arrays import Array

# Fraction of a column's length up to which the rest beside the parameters counts as zero.
# Differences of runs that stick and slip are not more exact.
HIDDEN = 1e-5
# Fraction of the largest singular value up to which directions of a group are left out.
DEPENDENT = 1e-3


@dataclass(frozen=True)
class OrthogonalComplement:
    """Orthogonal complement of the span of some columns.

    basis (m, q): orthonormal basis of this span.
    """

    basis: Array

    @classmethod
    def of(cls, columns: Array) -> "OrthogonalComplement":
        """Return the complement of columns (m, q), independent except for columns of zeros."""
        scale = np.linalg.norm(columns, axis=0)
        return cls(np.linalg.qr(columns[:, scale > 0] / scale[scale > 0])[0])

    def without(self, columns: Array) -> "OrthogonalComplement":
        """Return the complement of these and further columns (m, k)."""
        return OrthogonalComplement(
            np.hstack([self.basis, OrthogonalComplement.of(self.part(columns)).basis])
        )

    def part(self, rows: Array) -> Array:
        """Return the projection of residuals (m,) or columns (m, k) onto the complement."""
        beside = rows - self.basis @ (self.basis.T @ rows)
        # the projection is repeated, as its rounding errors matter if it is small
        return np.asarray(beside - self.basis @ (self.basis.T @ beside))


@dataclass(frozen=True)
class Score:
    """Score statistic of one or several causes.

    statistic                    Fall of the cost that is expected if the causes are fitted.
    freedoms                     Number of directions in which their sizes show.
    sizes (k,)                   Sizes that are expected, zero for causes that do not show.
    directions (m, freedoms)     Orthonormal directions U of the residuals in which the causes show.
    by_directions (k, freedoms)  Matrix B with sizes = -B U^T r.
    """

    statistic: float
    freedoms: int
    sizes: Array
    directions: Array
    by_directions: Array

    def covariance(self, spread: Array | None = None) -> Array:
        """Return the covariance (k, k) of the sizes.

        spread (freedoms, freedoms): covariance of U^T r beyond that of noise. None: only noise.
        """
        whole = np.eye(self.freedoms) if spread is None else np.eye(self.freedoms) + spread
        return np.asarray(self.by_directions @ whole @ self.by_directions.T)


def score(columns: Array, residual: Array, lengths: Array) -> Score:
    """Return the score of causes with columns (m, k), projected as the residuals (m,) are.

    lengths (k,): those of the columns before they were projected.
    """
    norms = np.linalg.norm(columns, axis=0)
    shown = norms > HIDDEN * lengths
    count = len(norms)
    if not shown.any():
        return Score(0.0, 0, np.zeros(count), columns[:, :0], np.zeros((count, 0)))
    if count == 1:
        direction = columns / norms
        fall = direction.T @ residual
        return Score(float(fall @ fall), 1, -fall / norms, direction, 1 / norms[:, None])
    unit = columns[:, shown] / norms[shown]
    directions, singular_values, turned = np.linalg.svd(unit, full_matrices=False)
    kept = singular_values > DEPENDENT * singular_values[0]
    directions = directions[:, kept]
    along = directions.T @ residual
    inverse = np.zeros((count, int(kept.sum())))
    inverse[shown] = (turned[kept].T / singular_values[kept]) / norms[shown][:, None]
    return Score(float(along @ along), int(kept.sum()), -inverse @ along, directions, inverse)
