"""The fit of ellipses written for all windows at once in plain numpy: the oracle of the compiled one."""

import numpy as np

from cmmsim.detection.detector import FitLimits
from cmmsim.detection.ellipse_fit import CORE_SHARE, RING_REACH, SMALLEST_RADIUS_PX, EllipseFits, largest_misfits
from tests.cmmsim.numpy_coverage import coverage


def fit_ellipses(windows, corners, noise, fit_size, limits=None, iterations=3):
    """As the product's ``fit_ellipses``, but always with the same number of iterations."""
    limits = limits or FitLimits()
    inner, inner_corners = _centre_on_spot(windows, fit_size)
    parameters = _start(inner)
    mask = _ring_mask(parameters, fit_size)
    for step in range(iterations + 1):
        radiance_share, derivatives = coverage(parameters[:, :2], _shape(parameters), fit_size)
        contrast, ground = parameters[:, 5, None, None], parameters[:, 6, None, None]
        mean = ground + contrast * radiance_share
        weights = mask / noise.variance(mean)
        residuals = inner - mean
        jacobian = np.concatenate(
            [contrast[..., None] * derivatives, radiance_share[..., None], np.ones_like(radiance_share)[..., None]],
            axis=-1,
        ).reshape(len(inner), -1, 7)
        weighted = jacobian.transpose(0, 2, 1) * weights.reshape(len(inner), 1, -1)
        normal = weighted @ jacobian + 1e-9 * np.eye(7)
        if step < iterations:
            change = np.linalg.solve(normal, weighted @ residuals.reshape(len(inner), -1, 1))[..., 0]
            parameters = _bounded(parameters + np.clip(change, -_LARGEST_STEP, _LARGEST_STEP), fit_size)
    misfit = np.sum(weights * residuals**2, axis=(1, 2)) / np.maximum(mask.sum(axis=(1, 2)) - 7.0, 1.0)
    covariances = np.linalg.inv(normal)
    good = parameters[:, 5] >= limits.smallest_contrast
    good &= misfit <= largest_misfits(limits, noise, parameters[:, 5], parameters[:, 6])
    good &= _inside(parameters, fit_size)
    return EllipseFits(
        parameters[:, :2] + inner_corners + corners,
        covariances[:, :2, :2],
        _shape(parameters),
        covariances[:, 2:5, 2:5],
        parameters[:, 5],
        parameters[:, 6],
        misfit,
        good,
    )


_LARGEST_STEP = np.array([1.0, 1.0, 0.8, 0.8, 0.8, 100.0, 40.0])


def _shape(parameters):
    return parameters[:, [2, 3, 3, 4]].reshape(-1, 2, 2)


def _moments(windows):
    """Ground and contrast (n,), area px (n,), centroid (n,2) and spread (n,2,2) of each window's bright spot."""
    n, size, _ = windows.shape
    flat = np.sort(windows.reshape(n, -1), axis=1)
    ground = flat[:, flat.shape[1] // 3]
    contrast = np.maximum(flat[:, -6] - ground, 1.0)
    share = (windows - ground[:, None, None]) / contrast[:, None, None]
    share = np.where(share > CORE_SHARE, np.minimum(share, 1.0), 0.0)
    area = np.maximum(share.sum(axis=(1, 2)), 1e-6)
    ticks = np.arange(size, dtype=float)
    x = (share.sum(axis=1) @ ticks) / area
    y = (share.sum(axis=2) @ ticks) / area
    dx, dy = ticks - x[:, None], ticks - y[:, None]
    spread = np.empty((n, 2, 2))
    spread[:, 0, 0] = np.einsum("nyx,nx->n", share, dx**2) / area
    spread[:, 1, 1] = np.einsum("nyx,ny->n", share, dy**2) / area
    spread[:, 0, 1] = spread[:, 1, 0] = np.einsum("nyx,nx,ny->n", share, dx, dy) / area
    return ground, contrast, area, np.stack([x, y], axis=1), spread


def _centre_on_spot(windows, fit_size):
    """The fit_size part (n, fit_size, fit_size) of each window around its bright spot, and its corner (n, 2)."""
    values = windows.astype(float)
    size = values.shape[1]
    centroid = _moments(values)[3]
    corners = np.clip(np.rint(centroid - 0.5 * (fit_size - 1)).astype(int), 0, size - fit_size)
    ticks = np.arange(fit_size)
    rows, columns = corners[:, 1, None] + ticks, corners[:, 0, None] + ticks
    return values[np.arange(len(values))[:, None, None], rows[:, :, None], columns[:, None, :]], corners


def _start(windows):
    """First parameters (n, 7) from the moments; a uniform ellipse has spread A A / 4."""
    ground, contrast, _, centroid, spread = _moments(windows)
    values, vectors = np.linalg.eigh(spread)
    radii = np.clip(2.0 * np.sqrt(np.maximum(values, 0.0)), 1.2, 0.5 * windows.shape[1])
    shape = (vectors * radii[:, None, :]) @ vectors.transpose(0, 2, 1)
    return np.column_stack([centroid, shape[:, 0, 0], shape[:, 0, 1], shape[:, 1, 1], contrast, ground])


def _ring_mask(parameters, size):
    """1 where a pixel lies within the dark ring, else 0 (n, size, size)."""
    ticks = np.arange(size, dtype=float)
    inverse = np.linalg.inv(_shape(parameters))[..., None, None]
    x = ticks[None, None, :] - parameters[:, 0, None, None]
    y = ticks[None, :, None] - parameters[:, 1, None, None]
    reach = (inverse[:, 0, 0] * x + inverse[:, 0, 1] * y) ** 2 + (inverse[:, 1, 0] * x + inverse[:, 1, 1] * y) ** 2
    return (reach < RING_REACH**2).astype(float)


def _bounded(parameters, size):
    """Parameters kept where the model is defined: centre in the window, radii between limits."""
    bounded = parameters.copy()
    bounded[:, :2] = np.clip(parameters[:, :2], 0.0, size - 1.0)
    values, vectors = np.linalg.eigh(_shape(parameters))
    values = np.clip(values, SMALLEST_RADIUS_PX, float(size))
    shape = (vectors * values[:, None, :]) @ vectors.transpose(0, 2, 1)
    bounded[:, 2:5] = np.column_stack([shape[:, 0, 0], shape[:, 0, 1], shape[:, 1, 1]])
    return bounded


def _inside(parameters, size):
    """Whether the whole ellipse lies inside the window and is larger than the smallest one."""
    shape = _shape(parameters)
    reach = np.linalg.norm(shape, axis=2)  # half extent along x and y
    centre = parameters[:, :2]
    return np.all((centre - reach > -0.5) & (centre + reach < size - 0.5), axis=1) & (
        np.linalg.eigvalsh(shape)[:, 0] > 1.01 * SMALLEST_RADIUS_PX
    )
