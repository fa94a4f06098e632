"""Weighted rigid registration (paper eq. 27): fit of a transform to known and measured points."""

from dataclasses import dataclass

import numpy as np

from cmmsim.errors import LostError
from cmmsim.geometry.pose import Array

# Number of Gauss-Newton steps after the unweighted start.
STEPS = 2
# Points count as lying on one line if the second singular value of their centred coordinates is
# below this, m. They do not determine a rotation about this line.
SMALLEST_SPREAD = 0.005


@dataclass(frozen=True)
class Registration:
    """Transform (4, 4) with the covariance (6, 6) of its small error [dt, dphi].

    ``misfit`` (n,) is the squared residual of each point in units of its noise. The expected sum
    over the points is 3 n - 6, because six parameters are fitted.
    """

    transform: Array
    covariance: Array
    misfit: Array


def rigid_starts(source: Array, targets: Array, weights: Array) -> Array:
    """Return rigid transforms (c, 4, 4) from ``source`` to ``targets`` (c, n, 3).

    They minimise the sum of squared distances with ``weights`` (c, n), by a singular value
    decomposition. The source is (n, 3), or (c, n, 3) with one source per target.
    """
    fractions = (weights / weights.sum(axis=1, keepdims=True))[..., None]
    source_means = (fractions * source).sum(axis=1)
    target_means = (fractions * targets).sum(axis=1)
    products = (weights[..., None] * (targets - target_means[:, None])).swapaxes(1, 2) @ (
        source - source_means[:, None]
    )
    u, _, vt = np.linalg.svd(products)
    signs = np.ones((len(targets), 3))
    # if the nearest orthogonal matrix is a reflection, the direction of the smallest singular value
    # is reversed
    signs[:, 2] = np.sign(np.linalg.det(u @ vt))
    transforms = np.tile(np.eye(4), (len(targets), 1, 1))
    transforms[:, :3, :3] = (u * signs[:, None]) @ vt
    transforms[:, :3, 3] = target_means - np.einsum(
        "cij,cj->ci", transforms[:, :3, :3], source_means
    )
    return transforms


def require_spread(points: Array) -> None:
    """Raise LostError for fewer than three points (n, 3), or for points that lie on one line."""
    if len(points) < 3:
        raise LostError(
            f"{len(points)} visible stickers, but at least 3 that are not on one line are needed"
        )
    width = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1]
    if width < SMALLEST_SPREAD:
        raise LostError(
            f"the {len(points)} visible stickers lie on one line to within {width * 1e3:.1f} mm, "
            f"but at least {SMALLEST_SPREAD * 1e3:.0f} mm of width is needed"
        )


def register(source: Array, target: Array, covariances: Array) -> Registration:
    """Return the maximum-likelihood transform for target = transform(source) + noise.

    ``source`` (n, 3) are known points, and ``target`` (n, 3) are measured points, m, with
    ``covariances`` (n, 3, 3). Raises the LostError of ``require_spread`` for the known points.
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
    from cmmsim.geometry.pose_fit_kernels import rigid_fits

    sets, count = targets.shape[:2]
    transforms = rigid_starts(source, targets, np.ones((sets, count)))
    # a copy, because the kernel would be compiled once more for a read-only array
    places = np.array(np.broadcast_to(source, targets.shape), dtype=float, order="C")
    points = np.ascontiguousarray(targets, dtype=float).reshape(-1, 3)
    informations = np.linalg.inv(covariances.reshape(-1, 3, 3))
    starts = count * np.arange(sets + 1)
    errors = np.zeros((sets, 6, 6))
    misfits = np.empty(sets * count)
    rigid_fits(
        places.reshape(-1, 3), points, informations, starts, STEPS, transforms, errors, misfits
    )
    return Registration(transforms, errors, misfits)
