"""The Cramer-Rao bound: the smallest covariance of an unbiased estimate of a disc's centre.

The mean grey value of a pixel is ground + contrast * share. The share of light is the fraction of
the pixel that the ellipse covers, blurred by a Gaussian point spread. The unknowns are the centre
and shape of the ellipse, the contrast and the ground. The grey value is the mean plus normal noise,
rounded and clipped. The variance of the noise depends on the mean. The Fisher information of a grey
value is a sum over all values that it can have.

If the noise is below half a grey value, the information depends on the position of the mean between
two grey values. No estimator is then unbiased at each single position of a centre. The
information is therefore averaged over one grey value, and the bound holds on average over unknown
positions. For stronger noise, averaging changes nothing.
"""

from functools import lru_cache

import numpy as np
from scipy.special import ndtr

from cmmsim.errors import CmmError
from cmmsim.geometry.disc_image import coverage
from cmmsim.geometry.pose import Array
from cmmsim.radiometry.noise import CameraNoise

# Number of standard deviations at which the noise distribution is cut off.
REACH = 6.0
# Largest number of table entries per grey value. Stronger noise needs fewer.
TABLE_STEPS = 64


def grey_value_information(mean_grey: Array, noise: CameraNoise) -> Array:
    """Return the Fisher information of rounded and clipped grey values about their means.

    The unit is 1 / (grey value)². Raises CmmError for a camera without noise, for which there is no
    bound.
    """
    mean_grey = np.asarray(mean_grey, dtype=float)
    variance, slope = _analog_variance(mean_grey, noise)
    deviation = np.sqrt(variance)
    reach = int(np.ceil(REACH * deviation.max())) + 1
    values = np.rint(mean_grey)[..., None] + np.arange(-reach, reach + 1)
    low = np.where(
        values <= 0, -np.inf, (values - 0.5 - mean_grey[..., None]) / deviation[..., None]
    )
    high = np.where(
        values >= noise.white_level,
        np.inf,
        (values + 0.5 - mean_grey[..., None]) / deviation[..., None],
    )
    possible = (values >= 0) & (values <= noise.white_level)
    # in the upper half, the probability is a difference of upper tails, because a difference of
    # numbers close to one would lose all digits
    probability = np.where(low > 0.0, ndtr(-low) - ndtr(-high), ndtr(high) - ndtr(low))
    change = -(_rise(high, slope, variance) - _rise(low, slope, variance)) / deviation[..., None]
    usable = possible & (probability > 1e-30)
    return np.sum(np.where(usable, change**2 / np.where(usable, probability, 1.0), 0.0), axis=-1)


def cramer_rao_bound(
    centres: Array,
    shapes: Array,
    size: int,
    contrast: float,
    ground: float,
    noise: CameraNoise,
    psf_px: float = 0.0,
) -> Array:
    """Return the smallest covariances (n, 2, 2) px² of unbiased estimates of n ellipse centres.

    Each ellipse has its own window. Contrast and ground are grey values. ``centres``, ``shapes``,
    ``size`` and ``psf_px`` are the parameters of ``disc_image.coverage``. Raises CmmError for a
    camera without noise.
    """
    shares, derivatives = coverage(centres, shapes, size, psf_px)
    information = np.interp(
        ground + contrast * shares, *_information_table(ground, ground + contrast, noise)
    )
    jacobian = np.concatenate(
        [contrast * derivatives, shares[..., None], np.ones_like(shares)[..., None]], axis=-1
    )
    fisher = np.einsum("nyxi,nyxj,nyx->nij", jacobian, jacobian, information, optimize=True)
    try:
        return np.linalg.inv(fisher)[:, :2, :2]
    except np.linalg.LinAlgError:
        # The image of a disc of hardly a pixel does not determine its whole shape.
        return np.linalg.pinv(fisher, rcond=1e-13, hermitian=True)[:, :2, :2]


@lru_cache(maxsize=8)  # a table of fine grey values takes a second
def _information_table(lowest: float, highest: float, noise: CameraNoise) -> tuple[Array, Array]:
    """Return mean grey values at equal steps, and the information averaged over one grey value.

    The means reach from one grey value below ``lowest`` to at least one above ``highest``.
    """
    least_noise = float(
        np.sqrt(_analog_variance(np.array([lowest - 1.5, highest + 1.5]), noise)[0].min())
    )
    # The number is even, so that the middle of the averaging window is an entry of the table.
    steps = 2 * int(np.ceil(0.5 * min(TABLE_STEPS, 16.0 / least_noise)))
    count = int(np.ceil((highest - lowest + 2.0) * steps)) + 1
    means = lowest - 1.5 + np.arange(count + steps) / steps
    window = np.full(steps + 1, 1.0 / steps)
    # The trapezoidal rule over one grey value.
    window[[0, -1]] *= 0.5
    averaged = np.convolve(grey_value_information(means, noise), window, mode="valid")
    return means[steps // 2 :][:count], averaged


def _analog_variance(mean_grey: Array, noise: CameraNoise) -> tuple[Array, Array]:
    """Return the noise variance before rounding, and its derivative with respect to the mean.

    Raises CmmError for a camera without noise.
    """
    variance = noise.variance(mean_grey) - 1.0 / (12.0 * noise.frames)
    if not noise.enabled or variance.min() <= 0.0:
        raise CmmError(f"without noise there is no Cramer-Rao bound, got {noise}")
    step = 0.5
    return variance, (noise.variance(mean_grey + step) - noise.variance(mean_grey - step)) / (
        2.0 * step
    )


def _rise(limit: Array, slope: Array, variance: Array) -> Array:
    """Return the standard deviation times the derivative of -ndtr(limit) with respect to the mean.

    ``limit`` is a distance from the mean in standard deviations. The mean changes both the position
    and the width of the noise distribution.
    """
    finite = np.where(np.isfinite(limit), limit, 0.0)
    density = np.where(np.isfinite(limit), np.exp(-0.5 * finite**2) / np.sqrt(2.0 * np.pi), 0.0)
    return density * (1.0 + 0.5 * finite * (slope / np.sqrt(variance))[..., None])
