"""Errors that the points of one view share, found from the views' scores, and their covariance.

Independent errors of pixels are an assumption. In photographs a bent board, uneven light or the
bias of the corner search moves neighbouring points alike, so that a view tells less than its number
of points promises. The scores show it, not the size of the residuals. A score is the pull that the
residuals of view v still exert on the common unknowns, s_v = J_v' r_v with the view's own pose
eliminated; the sum over all views is zero at the solution. With the views' reduced normal matrices
I_v, which add up to N, independent errors of variance sigma² leave

    cov(s_u, s_v) = sigma² (delta_uv I_v - I_u N^-1 I_v),

so that Q = sum s_v' N^-1 s_v / sigma² has the mean c - sum tr(W_v²), W_v = N^-1/2 I_v N^-1/2. Q
over its mean estimates the mean eigenvalue of the true covariance relative to sigma² N^-1. This is
the mean generalised design effect of Rao and Scott (1981, J. Am. Stat. Assoc. 76, 221-230), with
the correction for leverage in the mean.

The sandwich of Liang and Zeger (1986, Biometrika 73, 13-22) shows the directions that suffer most;
whitened, it is N^-1/2 (sum s_v s_v') N^-1/2. For 10 to 25 views and 24 unknowns it is singular: its
rank is the number of views less one. It is therefore shrunk towards the unit matrix as by Ledoit
and Wolf (2004, J. Multivar. Anal. 88, 365-411), and scaled to the mean above. An error that all
views share, such as one bend of the board, stays hidden from any comparison of views.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from cmmsim.geometry.pose import Array

# Probability of a ratio beyond the limit where the errors of points are independent.
CHANCE = 1e-3


@dataclass(frozen=True)
class SharedErrors:
    """Errors that points of a view share.

    ``ratio`` is the mean eigenvalue of the covariance over that of independent errors, as the views
    show it. Independent errors exceed ``limit`` with probability CHANCE. ``independent`` (c, c) is
    the covariance of the common unknowns for independent errors, sigma² N^-1, and ``covariance``
    that for the errors found. Both are equal where the ratio may be chance.
    """

    ratio: float
    limit: float
    independent: Array
    covariance: Array

    @property
    def factor(self) -> float:
        """Mean enlargement of the covariance over all directions, against that of independent
        errors.
        """
        return self.ratio if self.ratio > self.limit else 1.0


def shared_errors(scores: Array, information: Array, sigma2: float) -> SharedErrors:
    """Find the errors that views share within, from scores (v, c) and reduced normal matrices (v,
    c, c).

    ``sigma2`` is the variance of a pixel coordinate, px². The limit is that of the chi-square
    distribution with the mean and variance of Q for independent normal errors.
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
    """Return a matrix R (c, c) with R' N R = 1, of the normal matrix N."""
    scale = 1.0 / np.sqrt(np.diag(total))
    eigenvalues, vectors = np.linalg.eigh(total * scale[:, None] * scale)
    return np.asarray(scale[:, None] * vectors / np.sqrt(eigenvalues))


def _moments(shares: Array) -> tuple[float, float]:
    """Return mean and variance of Q for independent normal errors.

    The views' shares W_v (v, c, c) add up to one.
    """
    squares = shares @ shares
    traced = float(np.einsum("vii->", squares))
    all_views = squares.sum(axis=0)
    variance = (
        traced
        - 2.0 * float(np.einsum("vij,vji->", squares, shares))
        + float(np.sum(all_views * all_views.T))
    )
    return shares.shape[1] - traced, 2.0 * variance


def _enlargement(pulls: Array, ratio: float) -> Array:
    """Return the covariance (c, c) relative to that of independent errors.

    It is the shrunk sandwich of whitened scores (v, c), with the mean eigenvalue ``ratio``, and in
    no direction below one.
    """
    views, size = pulls.shape
    sandwich = pulls.T @ pulls
    mean = np.trace(sandwich) / size
    plain = mean * np.eye(size)
    apart = np.sum((sandwich - plain) ** 2)
    outer = views * pulls[:, :, None] * pulls[:, None, :]
    scatter = np.sum((outer - sandwich) ** 2) / views**2
    weight = min(1.0, scatter / apart) if apart > 0.0 else 1.0
    eigenvalues, vectors = np.linalg.eigh(
        (weight * plain + (1.0 - weight) * sandwich) * (ratio / mean)
    )
    return np.asarray((vectors * np.maximum(eigenvalues, 1.0)) @ vectors.T)
