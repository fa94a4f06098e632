"""Leaderboard of the detectors: their errors on drawn images of tilted discs, beside the Cramer-Rao bound.

The discs are drawn exactly, their centres lie anywhere within a pixel, and the camera adds its noise. Error means
distance from the ellipse's centre; eccentricity is another matter. Two ways that OpenCV offers run along.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cmmsim.detection.cramer_rao import cramer_rao_bound
from cmmsim.detection.detected_centres import DetectedCentres
from cmmsim.detection.detectors import DETECTORS, Detector
from cmmsim.detection.ellipse_fit import FitLimits
from cmmsim.drawn_discs import Condition, Scene, draw_discs, random_ellipses
from cmmsim.errors import CmmError
from cmmsim.geometry.pose import Array
from cmmsim.radiometry.noise import CameraNoise

FREE_PX = 3  # px between a disc's rim and the side of the part that is looked at
RESAMPLES, CONFIDENCE = 1000, 0.95
TOGETHER = 100  # bounds found at once
# The leaderboard is about accuracy. Where the noise is below half a grey value, the rounding of neighbours is not
# independent, and a misfit that is judged as if it were would turn good windows away.
LIMITS = FitLimits(largest_misfit=np.inf)


@dataclass(frozen=True)
class Score:
    """One detector under one condition, px and per axis: Cramer-Rao bound; rms error of the windows it did not lose,
    its ratio to the bound with a 95 % interval; bias: rms error without noise; lost: share of windows."""

    detector: str
    condition: Condition
    bound_px: float
    rms_px: float
    ratio: float
    ratio_low: float
    ratio_high: float
    bias_px: float
    lost: float


def compete(
    scene: Scene,
    conditions: Sequence[Condition],
    draws: int,
    rng: np.random.Generator,
    detectors: Sequence[Detector] | None = None,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> list[Score]:
    """Scores of all detectors (built-in ones and OpenCV's by default) under all conditions, with ``draws`` discs each.

    ``report(done, total)`` is called after each condition. Raises CmmError.
    """
    if draws < 2:
        raise CmmError(f"a leaderboard needs at least 2 draws, got {draws}")
    scenes = [scene.with_noise(condition.noise) for condition in conditions]  # refused before any work is done
    scores: list[Score] = []
    chosen = detectors or [*DETECTORS.values(), *PEERS]
    for k, (lit, condition) in enumerate(zip(scenes, conditions, strict=True)):
        scores += _round(lit, condition, draws, rng, chosen)
        report(k + 1, len(conditions))
    return scores


def _round(
    scene: Scene, condition: Condition, draws: int, rng: np.random.Generator, detectors: Sequence[Detector]
) -> list[Score]:
    fit_size = 2 * int(np.ceil(condition.radius_px + FREE_PX))
    centres, shapes = random_ellipses(condition, scene.focal_px, fit_size + 2, draws, rng)
    radiance = draw_discs(scene, centres, shapes, fit_size + 2, condition.psf_px)
    noisy, clean = scene.noise.expose(radiance, rng), scene.noise.mean_grey(radiance)
    bounds = _bounds(scene, condition.psf_px, centres, shapes, fit_size + 2)
    scores = []
    for detector in detectors:
        found, without_noise = (
            detector.detect(w, np.zeros((draws, 2), dtype=int), scene.noise, fit_size, LIMITS, condition.psf_px)
            for w in (noisy, clean)
        )
        good = found.good
        squared = 0.5 * ((found.centres - centres)[good] ** 2).sum(axis=1)
        systematic = (without_noise.centres - centres)[without_noise.good] ** 2
        scores.append(
            Score(
                detector.name,
                condition,
                _root_mean(bounds),
                _root_mean(squared),
                *_ratio_interval(squared, bounds[good], rng),
                _root_mean(systematic),
                1.0 - float(good.mean()),
            )
        )
    return scores


def _bounds(scene: Scene, psf_px: float, centres: Array, shapes: Array, size: int) -> Array:
    """Smallest mean squared error (n,) of each centre per axis, px²."""
    parts = [
        cramer_rao_bound(
            centres[k : k + TOGETHER], shapes[k : k + TOGETHER], size, scene.contrast, scene.ground, scene.noise, psf_px
        )
        for k in range(0, len(centres), TOGETHER)
    ]
    return 0.5 * np.trace(np.concatenate(parts), axis1=1, axis2=2)


def _ratio_interval(squared: Array, bounds: Array, rng: np.random.Generator) -> tuple[float, float, float]:
    """Root of mean squared error over mean bound, and the limits of its 95 % bootstrap interval."""
    if len(squared) == 0:
        return np.inf, np.inf, np.inf
    drawn = rng.integers(len(squared), size=(RESAMPLES, len(squared)))
    resampled = np.sqrt(squared[drawn].mean(axis=1) / bounds[drawn].mean(axis=1))
    low, high = np.quantile(resampled, [0.5 - 0.5 * CONFIDENCE, 0.5 + 0.5 * CONFIDENCE])
    return _root_mean(squared) / _root_mean(bounds), float(low), float(high)


def _root_mean(squared: Array) -> float:
    """Root of the mean; infinite for a detector that found nothing."""
    return float(np.sqrt(squared.mean())) if squared.size else np.inf


def _by_window(
    find: Callable[[NDArray[np.uint8]], tuple[float, float] | None],
    windows: NDArray,
    corners: NDArray[np.integer],
    white_level: int,
) -> DetectedCentres:
    """Centres that a function finds in each window alone, in 8 bit; OpenCV states no covariance, so it is zero."""
    found = [find(window) for window in np.rint(windows * (255.0 / white_level)).astype(np.uint8)]
    good = np.array([centre is not None for centre in found], dtype=bool)
    centres = np.array([centre or (0.0, 0.0) for centre in found]).reshape(-1, 2)
    return DetectedCentres(centres + corners, np.zeros((len(found), 2, 2)), good)


def detect_by_blobs(
    windows: NDArray,
    corners: NDArray[np.integer],
    noise: CameraNoise,
    fit_size: int,
    limits: FitLimits | None = None,
    psf_px: float = 0.0,
    smears: Array | None = None,
) -> DetectedCentres:
    """``cv2.SimpleBlobDetector`` with its filters of shape switched off: the largest bright blob."""
    settings = cv2.SimpleBlobDetector.Params()
    settings.filterByCircularity = settings.filterByConvexity = settings.filterByInertia = False
    settings.blobColor, settings.minArea, settings.maxArea = 255, 4.0, float(fit_size**2)
    blobs = cv2.SimpleBlobDetector.create(settings)

    def find(window: NDArray[np.uint8]) -> tuple[float, float] | None:
        points = blobs.detect(window)
        return max(points, key=lambda point: point.size).pt if points else None

    return _by_window(find, windows, corners, noise.white_level)


def detect_by_contour(
    windows: NDArray,
    corners: NDArray[np.integer],
    noise: CameraNoise,
    fit_size: int,
    limits: FitLimits | None = None,
    psf_px: float = 0.0,
    smears: Array | None = None,
) -> DetectedCentres:
    """``cv2.fitEllipse`` on the longest contour of the window thresholded after Otsu."""

    def find(window: NDArray[np.uint8]) -> tuple[float, float] | None:
        mask = cv2.threshold(window, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)[1]
        contours = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
        longest = max(contours, key=len, default=())
        return cv2.fitEllipse(longest)[0] if len(longest) >= 5 else None

    return _by_window(find, windows, corners, noise.white_level)


PEERS = (Detector("opencv_blob", detect_by_blobs, 0.01), Detector("opencv_fit_ellipse", detect_by_contour, 0.05))
