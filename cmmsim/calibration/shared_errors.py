"""Errors that the points of one view share: found from the views' scores, and the factor they take on the covariance.

Independent errors of pixels are an assumption. In photographs a bent board, uneven light or the bias of the corner
search moves neighbouring points alike, so that a view tells less than its number of points promises. The residuals'
size does not show it, the scores do: what the residuals of view v still pull at the common unknowns,
s_v = J_v' r_v with the view's own pose eliminated, whose sum over all views is zero at the solution. With the views'
reduced normal matrices I_v, which add up to N, independent errors of variance sigma² leave

    cov(s_u, s_v) = sigma² (delta_uv I_v - I_u N^-1 I_v),

so that Q = sum s_v' N^-1 s_v / sigma² has the mean c - sum tr(W_v²), W_v = N^-1/2 I_v N^-1/2. Q over its mean estimates
the mean eigenvalue of the true covariance relative to sigma² N^-1: the mean generalised design effect, by which Rao and
Scott (1981, J. Am. Stat. Assoc. 76, 221-230) correct statistics of clustered observations, here of the sandwich
covariance of Liang and Zeger (1986, Biometrika 73, 13-22) with the correction for leverage in the mean.

The sandwich itself is not taken: of 10 to 25 views and 24 unknowns it is singular, its rank being the number of views
less one. An error that all views share, such as one bend of the board, stays hidden from any comparison of views.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from ..pose import Array

CHANCE = 1e-3  # of a factor at the limit where the errors of points are independent


@dataclass(frozen=True)
class SharedErrors:
    """ratio: mean eigenvalue of the covariance over that of independent errors, as the views show it; limit: the ratio
    that independent errors exceed with probability CHANCE."""

    ratio: float
    limit: float

    @property
    def factor(self) -> float:
        """What the covariance of independent errors is multiplied by: 1 where the ratio may be chance."""
        return self.ratio if self.ratio > self.limit else 1.0


def shared_errors(scores: Array, information: Array, sigma2: float) -> SharedErrors:
    """What views whose scores (v,c) and reduced normal matrices (v,c,c) these are share within, at sigma² px².

    The limit is that of the chi-square distribution with the mean and variance of Q for independent normal errors.
    """
    total = information.sum(axis=0)
    scale = 1.0 / np.sqrt(np.diag(total))
    eigenvalues, vectors = np.linalg.eigh(total * scale[:, None] * scale)
    whiten = scale[:, None] * vectors / np.sqrt(eigenvalues)  # whiten.T @ total @ whiten = 1
    pulls = scores @ whiten
    shares = whiten.T @ information @ whiten
    squares = shares @ shares
    mean = len(total) - float(np.einsum("vii->", squares))
    cross = squares.sum(axis=0)
    variance = 2.0 * float(np.einsum("vii->", squares) - 2.0 * np.einsum("vij,vji->", squares, shares)
                           + np.einsum("ij,ji->", cross, cross))
    if not (sigma2 > 0.0 and mean > 0.0 and variance > 0.0):
        return SharedErrors(1.0, np.inf)
    freedom = 2.0 * mean**2 / variance
    return SharedErrors(float(np.sum(pulls**2)) / (sigma2 * mean), float(chi2.isf(CHANCE, freedom) / freedom))
