"""Weighted rigid registration (paper eq. 27): fit of a transform to known and measured points."""

from dataclasses import dataclass

import numpy as np

from cmmsim.errors import LostError
from cmmsim.geometry.pose import Array

# Gauss-Newton steps after the unweighted start.
STEPS = 2
# Points do not determine a rotation if their spread perpendicular to one line is below this, m.
SMALLEST_SPREAD = 0.005


@dataclass(frozen=True)
class Registration:
    """Transform (4, 4) with the covariance (6, 6) of its small error [dt, dphi].

    ``misfit`` (n,) is the squared residual of each point in units of its noise. Its expected value
    is 3 minus the point's share of the six fitted parameters.
    """

    transform: Array
    covariance: Array
    misfit: Array


def rigid_starts(source: Array, targets: Array, weights: Array) -> Array:
    """Return rigid transforms (c, 4, 4) from ``source`` to ``targets`` (c, n, 3).

    The method is a singular value decomposition. The source is (n, 3), or (c, n, 3) with one source
    per target. Weights are (c, n).
    """
    fractions = (weights / weights.sum(axis=1, keepdims=True))[..., None]
    source_means = (fractions * source).sum(axis=1)
    target_means = (fractions * targets).sum(axis=1)
    products = (weights[..., None] * (targets - target_means[:, None])).swapaxes(1, 2) @ (
        source - source_means[:, None]
    )
    u, _, vt = np.linalg.svd(products)
    turns = np.ones((len(targets), 3))
    # if the nearest orthogonal matrix is a reflection, the direction of the smallest singular value
    # is reversed
    turns[:, 2] = np.sign(np.linalg.det(u @ vt))
    transforms = np.tile(np.eye(4), (len(targets), 1, 1))
    transforms[:, :3, :3] = (u * turns[:, None]) @ vt
    transforms[:, :3, 3] = target_means - np.einsum(
        "cij,cj->ci", transforms[:, :3, :3], source_means
    )
    return transforms


def require_spread(points: Array) -> None:
    """Raise LostError for fewer than three points (n, 3), or if all points lie on one line."""
    if len(points) < 3:
        raise LostError(
            f"{len(points)} visible stickers, at least 3 that are not on one line are needed"
        )
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1]
    if spread < SMALLEST_SPREAD:
        raise LostError(
            f"the {len(points)} visible stickers lie on one line to {spread * 1e3:.1f} mm, at "
            f"least {SMALLEST_SPREAD * 1e3:.0f} mm of width is needed"
        )


def register(source: Array, target: Array, covariances: Array) -> Registration:
    """Return the maximum-likelihood transform for target = transform(source) + noise.

    ``source`` (n, 3) are known points, and ``target`` (n, 3) are measured points, m, with
    ``covariances`` (n, 3, 3). Raises LostError for fewer than three points, or if all points lie on
    one line.
    """
    require_spread(source)
    fit = register_sets(source, target[None], covariances[None])
    return Registration(fit.transform[0], fit.covariance[0], fit.misfit)


def register_sets(source: Array, targets: Array, covariances: Array) -> Registration:
    """Return the registrations of a ``source`` onto c ``targets`` (c, n, 3), see ``register``.

    The source is (n, 3), or (c, n, 3) with one source per target. In the result, transforms are
    (c, 4, 4), covariances (c, 6, 6) and misfits (c n,). The spread of the points is not checked.
    """
    # Imported late, because importing numba takes time.
    from cmmsim.geometry.rigid_kernels import rigid_fits

    sets, count = targets.shape[:2]
    transforms = rigid_starts(source, targets, np.ones((sets, count)))
    # a copy, because the kernel is compiled once more for arrays that are read-only
    places = np.array(np.broadcast_to(source, targets.shape), dtype=float, order="C")
    points = np.ascontiguousarray(targets, dtype=float).reshape(-1, 3)
    informations = np.linalg.inv(covariances.reshape(-1, 3, 3))
    starts = count * np.arange(sets + 1)
    spreads = np.zeros((sets, 6, 6))
    misfits = np.empty(sets * count)
    rigid_fits(
        places.reshape(-1, 3), points, informations, starts, STEPS, transforms, spreads, misfits
    )
    return Registration(transforms, spreads, misfits)
