"""A detector: the centroid of the grey values above a threshold, window by window."""

import numpy as np

from cmmsim.detection.detector import DetectedCentres

THRESHOLD = 0.3  # of the contrast between dark ring and sticker


def find_centres(given):
    """Find the centres in SpotWindows, in px of the whole image, with their covariances."""
    windows = given.windows.astype(float)  # (n, h, h) grey values
    flat = windows.reshape(len(windows), -1)
    dark, bright = np.percentile(flat, 50, axis=1), flat.max(axis=1)
    cut = dark + THRESHOLD * (bright - dark)
    weights = np.clip(windows - cut[:, None, None], 0.0, None)
    total = np.maximum(weights.sum(axis=(1, 2)), 1e-9)  # finite where a window shows no spot
    ticks = np.arange(windows.shape[1])
    x = (weights.sum(axis=1) @ ticks) / total
    y = (weights.sum(axis=2) @ ticks) / total

    # Covariance of the centroid from the noise of the grey values, to first order.
    dx = (ticks[None, None, :] - x[:, None, None]) * (weights > 0) / total[:, None, None]
    dy = (ticks[None, :, None] - y[:, None, None]) * (weights > 0) / total[:, None, None]
    slopes = np.stack([dx, dy], axis=1)  # (n, 2, h, h)
    covariances = np.einsum("niyx,njyx,nyx->nij", slopes, slopes, given.noise.variance(windows))

    good = bright - dark > given.limits.smallest_contrast
    return DetectedCentres(np.stack([x, y], axis=1) + given.corners, covariances, good)


find_centres.bias_px = 0.026  # its error without noise, which the covariance does not contain
