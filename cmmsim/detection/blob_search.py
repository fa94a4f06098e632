"""Search for stickers in whole grey images, with no knowledge of where they are."""

from __future__ import annotations

import cv2
import numpy as np

from cmmsim.detection.ellipse_fit import EllipseFits, FitLimits, fit_ellipses
from cmmsim.geometry.pose import Array
from cmmsim.radiometry.images import FrameImages, StereoFrame
from cmmsim.radiometry.noise import CameraNoise, GreyImage

SMALLEST_AREA_PX = 8
LARGEST_SIDE_PX = 24
LARGEST_SHARE = 25 / 36  # of a square with the largest side
BRIGHT_SHARE = 1e-4  # share of the image's pixels that are taken as the brightest
SMALLEST_STEP = 40.0 / 255.0  # of the largest grey value: between the ground and the brightest pixels


def find_blobs(image: GreyImage, white_level: int = 255, largest_side: int = LARGEST_SIDE_PX) -> Array:
    """Rough centres (n, 2) px of compact bright spots of an image (height, width).

    Parameters: white_level: largest grey value; largest_side of a spot's bounding box, px.
    """
    counts = np.bincount(image.ravel())
    from_top = np.cumsum(counts[::-1])
    bright = len(counts) - 1 - int(np.searchsorted(from_top, max(1.0, BRIGHT_SHARE * image.size)))
    ground = int(np.searchsorted(np.cumsum(counts), 0.5 * image.size))
    if bright - ground < SMALLEST_STEP * white_level:
        return np.zeros((0, 2))
    mask = (image > 0.5 * (bright + ground)).astype(np.uint8)
    _, _, stats, centres = cv2.connectedComponentsWithStats(mask)
    area, sides = stats[1:, cv2.CC_STAT_AREA], stats[1:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]]
    keep = (area >= SMALLEST_AREA_PX) & (area <= round(LARGEST_SHARE * largest_side**2))
    keep &= sides.max(axis=1) <= largest_side
    keep &= area > 0.4 * sides.prod(axis=1)
    return centres[1:][keep]


def find_ellipses(
    frame: StereoFrame, noise: CameraNoise, window_size: int, fit_size: int, limits: FitLimits, psf_px: float = 0.0
) -> tuple[EllipseFits, EllipseFits]:
    """Ellipses fitted to all bright spots of the left and of the right image that a window holds; only good ones.

    Parameters: window_size, fit_size and psf_px, the standard deviation of the point spread, in px.
    """
    found = []
    for image in (frame.left, frame.right):
        corners = np.rint(find_blobs(image, noise.white_level, window_size) - 0.5 * (window_size - 1)).astype(int)
        windows = FrameImages(StereoFrame(image, image)).windows(np.stack([corners, corners]), window_size)[0]
        fits = fit_ellipses(windows, corners, noise, fit_size, limits, psf_px=psf_px)
        found.append(EllipseFits(*(getattr(fits, name)[fits.good] for name in EllipseFits.__dataclass_fields__)))
    return found[0], found[1]
