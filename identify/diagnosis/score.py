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

# Share of a column's length below which nothing is left of it beside the parameters. Differences of
# runs that stick and slip are not more exact.
HIDDEN = 1e-5
# Smallest share of the largest singular value for which directions of a group count as several.
DEPENDENT = 1e-3


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

    statistic                    Fall of the cost that is expected if the causes are fitted.
    freedoms                     Number of directions in which their sizes show.
    sizes (k,)                   Sizes that are expected.
    directions (m, freedoms)     Orthonormal directions U of the residuals in which the causes show.
    by_directions (k, freedoms)  Change of the sizes by U^T r.
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
    if count == 1:
        alone = columns / left
        fall = alone.T @ residual
        return Score(float(fall @ fall), 1, -fall / left, alone, 1 / left[:, None])
    unit = columns[:, shown] / left[shown]
    directions, lasting, turned = np.linalg.svd(unit, full_matrices=False)
    kept = lasting > DEPENDENT * lasting[0]
    directions = directions[:, kept]
    along = directions.T @ residual
    inverse = np.zeros((count, int(kept.sum())))
    inverse[shown] = (turned[kept].T / lasting[kept]) / left[shown][:, None]
    return Score(float(along @ along), int(kept.sum()), -inverse @ along, directions, inverse)
