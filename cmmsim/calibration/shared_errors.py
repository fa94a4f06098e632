"""Common errors of the points of one view, estimated from the views' scores.

The adjustment assumes that errors of pixels are independent. In photographs a bent board, uneven
light or the bias of the corner search displaces neighbouring points together. A view then carries
less information than its number of points suggests. The scores of the views show this, while the
magnitude of the residuals does not. Let r_v be the residuals of view v, and J_v the derivatives of
the computed pixels with respect to the common unknowns after the view's own pose is eliminated. The
score of the view is s_v = J_v' r_v. The sum of all scores is zero at the solution. Let I_v be the
views' reduced normal matrices, which add up to N. For independent errors of variance sigma², the
covariance of the scores is

    cov(s_u, s_v) = sigma² (delta_uv I_v - I_u N^-1 I_v),

so with c common unknowns, Q = sum s_v' N^-1 s_v / sigma² has the mean c - sum tr(W_v²), where W_v
= N^-1/2 I_v N^-1/2. The ratio of Q to this mean estimates the mean eigenvalue of the true
covariance relative to sigma² N^-1. This is the mean generalised design effect of Rao and Scott
(1981, J. Am. Stat. Assoc. 76, 221-230), with a mean that is corrected for leverage.

The sandwich estimator of Liang and Zeger (1986, Biometrika 73, 13-22) shows which directions are
affected most. The whitened estimate is N^-1/2 (sum s_v s_v') N^-1/2. The rank of this matrix is the
number of views minus one, so the matrix is singular for 10 to 25 views and 24 unknowns. The matrix
is therefore shrunk towards the unit matrix as in Ledoit and Wolf (2004, J. Multivar. Anal. 88,
365-411), and scaled to the mean eigenvalue above. An error that is common to all views, such as a
constant bend of the board, cannot be detected by comparing views.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from cmmsim.geometry.pose import Array

# Probability that the ratio exceeds its limit if the errors of points are independent.
CHANCE = 1e-3


@dataclass(frozen=True)
class SharedErrors:
    """Common errors of the points of a view.

    ``ratio`` is the estimated mean eigenvalue of the covariance relative to the covariance for
    independent errors. For independent errors, it exceeds ``limit`` with probability CHANCE.
    ``independent`` (c, c) is the covariance of the common unknowns for independent errors, sigma²
    N^-1. ``covariance`` (c, c) takes the common errors into account. Both are equal if the ratio
    does not exceed its limit. Where the ratio cannot be estimated, as from a single view, it is 1
    and the limit is inf.
    """

    ratio: float
    limit: float
    independent: Array
    covariance: Array

    @property
    def factor(self) -> float:
        """Mean factor by which the common errors enlarge the covariance; 1 below the limit."""
        return self.ratio if self.ratio > self.limit else 1.0


def shared_errors(scores: Array, information: Array, sigma2: float) -> SharedErrors:
    """Estimate the common errors of the points of each view.

    ``scores`` (v, c) and ``information`` (v, c, c) are the views' scores and reduced normal
    matrices, and ``sigma2`` is the variance of a pixel coordinate, px². The limit is a quantile of
    a scaled chi-square distribution with the mean and variance of Q for independent normal errors.
    """
    whiten = _whitening(information.sum(axis=0))
    independent = sigma2 * whiten @ whiten.T
    mean, variance = _moments(whiten.T @ information @ whiten)
    if not (sigma2 > 0.0 and mean > 0.0 and variance > 0.0):
        return SharedErrors(1.0, np.inf, independent, independent)
    pulls = scores @ whiten / np.sqrt(sigma2)
    freedom = 2.0 * mean**2 / variance
    ratio = float(np.sum(pulls**2)) / mean
    limit = float(chdtri(freedom, CHANCE) / freedom)
    covariance = (
        sigma2 * whiten @ _enlargement(pulls, ratio) @ whiten.T if ratio > limit else independent
    )
    return SharedErrors(ratio, limit, independent, covariance)


def _whitening(total: Array) -> Array:
    """Return a matrix R (c, c) with R' N R = I for the normal matrix N."""
    scale = 1.0 / np.sqrt(np.diag(total))
    eigenvalues, vectors = np.linalg.eigh(total * scale[:, None] * scale)
    return np.asarray(scale[:, None] * vectors / np.sqrt(eigenvalues))


def _moments(shares: Array) -> tuple[float, float]:
    """Return mean and variance of Q for independent normal errors.

    ``shares`` (v, c, c) are the matrices W_v of the views, which add up to the unit matrix.
    """
    squares = shares @ shares
    trace_sum = float(np.einsum("vii->", squares))
    all_views = squares.sum(axis=0)
    variance = (
        trace_sum
        - 2.0 * float(np.einsum("vij,vji->", squares, shares))
        + float(np.sum(all_views * all_views.T))
    )
    return shares.shape[1] - trace_sum, 2.0 * variance


def _enlargement(pulls: Array, ratio: float) -> Array:
    """Return the whitened covariance (c, c), which is the unit matrix for independent errors.

    It is the shrunk sandwich estimate from the whitened scores ``pulls`` (v, c), scaled to the mean
    eigenvalue ``ratio``. Eigenvalues below one are then raised to one.
    """
    views, size = pulls.shape
    sandwich = pulls.T @ pulls
    mean = np.trace(sandwich) / size
    target = mean * np.eye(size)
    distance = np.sum((sandwich - target) ** 2)
    outer = views * pulls[:, :, None] * pulls[:, None, :]
    scatter = np.sum((outer - sandwich) ** 2) / views**2
    weight = min(1.0, scatter / distance) if distance > 0.0 else 1.0
    eigenvalues, vectors = np.linalg.eigh(
        (weight * target + (1.0 - weight) * sandwich) * (ratio / mean)
    )
    return np.asarray((vectors * np.maximum(eigenvalues, 1.0)) @ vectors.T)
