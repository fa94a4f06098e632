"""Weighted rigid registration (paper eq. 27): the transform that carries known points onto measured ones."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmmsim.errors import LostError
from cmmsim.geometry.pose import Array, rigid

STEPS = 2  # of Gauss-Newton after the unweighted start
SMALLEST_SPREAD = 0.005  # m; points closer than this to one line do not determine a rotation


@dataclass(frozen=True)
class Registration:
    """transform (4,4) output-from-input; covariance (6,6) of its small error [dt, dphi]; misfit (n,): squared residual
    of each point in units of its noise (three degrees of freedom less its share of the fit)."""

    transform: Array
    covariance: Array
    misfit: Array


def rigid_start(source: Array, target: Array) -> Array:
    """Unweighted rigid transform (4,4) from ``source`` (n,3) to ``target`` (n,3) by singular values."""
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((target - target_mean).T @ (source - source_mean))
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return rigid(rotation, target_mean - rotation @ source_mean)


def rigid_starts(source: Array, targets: Array, weights: Array) -> Array:
    """Rigid transforms (c,4,4) from ``source``, (n,3) or one each (c,n,3), to ``targets`` (c,n,3) with weights (c,n),
    by singular values."""
    shares = (weights / weights.sum(axis=1, keepdims=True))[..., None]
    source_means, target_means = (shares * source).sum(axis=1), (shares * targets).sum(axis=1)
    products = (weights[..., None] * (targets - target_means[:, None])).swapaxes(1, 2) @ (
        source - source_means[:, None]
    )
    u, _, vt = np.linalg.svd(products)
    turns = np.ones((len(targets), 3))
    turns[:, 2] = np.sign(np.linalg.det(u @ vt))
    transforms = np.tile(np.eye(4), (len(targets), 1, 1))
    transforms[:, :3, :3] = (u * turns[:, None]) @ vt
    transforms[:, :3, 3] = target_means - np.einsum("cij,cj->ci", transforms[:, :3, :3], source_means)
    return transforms


def require_spread(points: Array) -> None:
    """Raise LostError unless ``points`` (n,3) hold three that are clearly not on one line."""
    if len(points) < 3:
        raise LostError(f"{len(points)} visible stickers, at least 3 that are not on one line are needed")
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1]
    if spread < SMALLEST_SPREAD:
        raise LostError(
            f"the {len(points)} visible stickers lie on one line to {spread * 1e3:.1f} mm, "
            f"at least {SMALLEST_SPREAD * 1e3:.0f} mm of width is needed"
        )


def spreads(points: Array, weights: Array) -> Array:
    """How far (f,) those of points (n,3) with weights (f,n,1) of 1, not 0, are from lying on one line: the second
    singular value of their differences from their middle, m."""
    middles = (weights * points).sum(axis=1) / np.maximum(weights.sum(axis=1), 1.0)
    gaps = weights * (points - middles[:, None])
    squares = np.linalg.eigvalsh(gaps.swapaxes(1, 2) @ gaps)[:, 1]
    return np.sqrt(np.maximum(squares, 0.0))


def register(source: Array, target: Array, covariances: Array) -> Registration:
    """Maximum-likelihood transform with target = transform(source) + noise.

    Parameters: source (n,3) known points; target (n,3) measured points, m; covariances (n,3,3) of the measured ones.
    Raises LostError when fewer than three points off one line are given.
    """
    require_spread(source)
    all_of_it = np.array([0, len(source)])
    fit = register_each(source, target, covariances, all_of_it, rigid_start(source, target)[None])
    return Registration(fit.transform[0], fit.covariance[0], fit.misfit)


def register_sets(source: Array, targets: Array, covariances: Array) -> Registration:
    """``register`` of all points of a ``source``, (n,3) or one each (c,n,3), onto each of the targets (c,n,3) with
    covariances (c,n,3,3). Of the result transform is (c,4,4), covariance (c,6,6), misfit (c n,)."""
    sets, count = targets.shape[:2]
    starts = rigid_starts(source, targets, np.ones((sets, count)))
    of_each = np.broadcast_to(source, targets.shape).reshape(-1, 3)
    flat = targets.reshape(-1, 3), covariances.reshape(-1, 3, 3)
    return register_each(of_each, *flat, count * np.arange(sets + 1), starts)


def register_each(
    source: Array, target: Array, covariances: Array, starts: NDArray[np.int_], transforms: Array
) -> Registration:
    """``register`` of several sets of points, points ``starts[f]`` to ``starts[f + 1]`` belonging to set f, from rough
    ``transforms`` (f,4,4).

    Parameters: source (k,3) and target (k,3) m, covariances (k,3,3). Of the result transform is (f,4,4), covariance
    (f,6,6), misfit (k,).
    """
    from cmmsim.geometry.point_kernels import rigid_fits  # compiles, so it is loaded where it is first needed

    weights, found = np.linalg.inv(covariances), np.array(transforms)
    source, target = np.ascontiguousarray(source, dtype=float), np.ascontiguousarray(target, dtype=float)
    spread = np.zeros((len(found), 6, 6))
    rigid_fits(source, target, weights, starts, STEPS, found, spread)
    each = np.repeat(found, np.diff(starts), axis=0)
    residuals = target - np.einsum("kij,kj->ki", each[:, :3, :3], source) - each[:, :3, 3]
    return Registration(found, spread, np.einsum("ni,nij,nj->n", residuals, weights, residuals))
