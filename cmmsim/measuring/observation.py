"""Observation of the stickers of one body near their expected places.

Windows are read, centres are detected in them, and both images' centres are triangulated.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from cmmsim.allowed_plugins import DEFAULT_DETECTOR
from cmmsim.detection.detector import (
    DetectedCentres,
    Detector,
    FitLimits,
    SpotWindows,
    find_detector,
)
from cmmsim.detection.ellipse_fit import (
    MAXIMUM_LIKELIHOOD,
    SMEAR_STEP_PX,
    EllipseFits,
    fit_ellipses,
)
from cmmsim.geometry.camera import Optics
from cmmsim.geometry.disc_image import centre_offset
from cmmsim.geometry.pose import Array, apply_each
from cmmsim.geometry.stereo_rig import StereoRig, triangulate
from cmmsim.radiometry.noise import CameraNoise
from cmmsim.radiometry.stereo_images import ManyExposures, StereoImages, Windows

# A smear is the movement of a sticker's image during the exposure. The longest smear that can be
# measured is about the size of a sticker.
LONGEST_SMEAR_PX = 8.0
# Shortest smear that changes the result of a fit, in standard deviations of the point spread.
SHORTEST_SMEAR = 1.5
# Smallest cosine between a sticker's normal and the line of sight at which it is searched.
GRAZING = 0.15


@dataclass(frozen=True)
class DetectionSettings:
    """Settings of the search for stickers.

    window_size      side of a window, px
    fit_size         side of the part of a window that is fitted, px
    radius           radius of a sticker, m
    limits           limits for accepting a fit
    largest_ray_gap  largest squared distance between the two rays of a sticker, in units of the
                     distance's variance; 25 means five sigma
    centre_error_px  rms of systematic errors of a centre; the squares of this error and of the
                     detector's bias are added to the variances of a centre
    detector         name of the detector
    optics           point spread and vignetting of the lenses
    exposed_share    ratio of exposure time to frame period
    line_error_px    standard deviation of an image's distance from its epipolar line that errors of
                     the rig cause; it increases the allowed distance between two rays
    dark             True for dark stickers in bright rings
    """

    window_size: int = 16
    fit_size: int = 14
    radius: float = 0.003
    limits: FitLimits = field(default_factory=FitLimits)
    largest_ray_gap: float = 25.0
    centre_error_px: float = 0.0
    detector: str = DEFAULT_DETECTOR
    optics: Optics = field(default_factory=Optics)
    exposed_share: float = 0.0
    line_error_px: float = 0.0
    dark: bool = False


@dataclass(frozen=True)
class Outlines:
    """Ellipses of k stickers in both images.

    ``shapes`` are symmetric matrices A (2, k, 2, 2), px. ``covariances`` (2, k, 3, 3), px², are the
    covariances of the entries A_xx, A_xy, A_yy.
    """

    shapes: Array
    covariances: Array

    def selected(self, keep: NDArray[np.bool_]) -> Outlines:
        """Select some of the stickers."""
        return Outlines(self.shapes[:, keep], self.covariances[:, keep])


@dataclass(frozen=True)
class StickerObservation:
    """Stickers seen by both cameras, k of them.

    index                      (k,), indices of the stickers among the body's stickers
    left_pixels, right_pixels  (k, 2), sticker centres in the distorted images, without eccentricity
    points, covariances        (k, 3) and (k, 3, 3), in the camera frame, m
    pixel_variances            (k,), of pixel coordinates, mean over both images and axes, px²
    outlines                   ellipses of the stickers; None if the detector states no ellipses
    """

    index: NDArray[np.int_]
    left_pixels: Array
    right_pixels: Array
    points: Array
    covariances: Array
    pixel_variances: Array
    outlines: Outlines | None = None

    def selected(self, keep: NDArray[np.bool_]) -> StickerObservation:
        """Return the observation with only some of its stickers."""
        kept = {name: values[keep] for name, values in vars(self).items() if name != "outlines"}
        return StickerObservation(
            **kept, outlines=None if self.outlines is None else self.outlines.selected(keep)
        )


@runtime_checkable
class StickerExposure(Protocol):
    """Exposure without images. It returns the results that fits of ellipses would have."""

    def detected(self, corners: NDArray[np.int_], size: int, observer: Observer) -> DetectedCentres:
        """Detect stickers in 2k windows of ``size`` px with first pixels ``corners`` (2, k, 2)."""

    def bright(self, observer: Observer) -> tuple[EllipseFits, EllipseFits]:
        """Return the ellipses in the left and in the right image."""


@dataclass(frozen=True)
class Observer:
    """Observer of stickers, with the known rig, its camera noise, and detection settings."""

    rig: StereoRig
    noise: CameraNoise
    settings: DetectionSettings

    @property
    def upright(self) -> CameraNoise:
        """Noise of the grey values in which stickers are bright."""
        return replace(self.noise, inverted=True) if self.settings.dark else self.noise

    @property
    def detector(self) -> Detector:
        """Detector of the centres of stickers in windows."""
        return find_detector(self.settings.detector)

    def observe(
        self,
        images: StereoImages | StickerExposure,
        camera_from_body: Array,
        places: Array,
        normals: Array,
        exposure_ends: tuple[Array, Array] | None = None,
    ) -> StickerObservation:
        """Observe stickers of a body near an expected pose camera_from_body (4, 4).

        The stickers have ``places`` (n, 3) and ``normals`` (n, 3) in body axes. ``exposure_ends``
        are the expected camera_from_body at the beginning and at the end of the exposure, or None.
        """
        return self.read(images, camera_from_body, places, normals).observed(exposure_ends)

    def read(
        self,
        images: StereoImages | StickerExposure | ManyExposures,
        camera_from_body: Array,
        places: Array,
        normals: Array,
    ) -> StickerWindows:
        """Read the windows around stickers of a body near an expected pose camera_from_body (4, 4).

        The stickers have ``places`` (n, 3) and ``normals`` (n, 3) in body axes. For many exposures,
        camera_from_body is (N, 4, 4), and sticker k of exposure j has the index j n + k.
        """
        moves = [move @ camera_from_body for move in self.rig.from_camera]
        centres = [apply_each(move, places).reshape(-1, 3) for move in moves]
        turned = [(normals @ move[..., :3, :3].swapaxes(-1, -2)).reshape(-1, 3) for move in moves]
        pixels, valid = self.rig.project(apply_each(camera_from_body, places).reshape(-1, 3))
        facing = np.stack([faces_camera(c, t) for c, t in zip(centres, turned, strict=True)])
        # Triangulation needs two rays, so both cameras must see a sticker.
        index = np.flatnonzero(np.all(valid & facing, axis=0))
        exposures = index // len(places)
        size = self.settings.window_size + 2 * self.detector.margin_px
        corners = np.rint(pixels[:, index] - 0.5 * (size - 1)).astype(int)
        windows: Windows = np.zeros((2, len(index), 0, 0))
        offsets = np.zeros((2, 0, 2))
        found = None
        if len(index):
            if isinstance(images, StickerExposure):
                found = images.detected(corners, size, self)
            elif isinstance(images, ManyExposures):
                windows = self.evenly_lit(images.windows_of(exposures, corners, size), corners)
            else:
                windows = self.evenly_lit(images.windows(corners, size), corners)
            windows = self.upright.bright(windows)
            offsets = np.stack(
                [
                    centre_offset(camera, c[index], t[index], self.settings.radius)
                    for camera, c, t in zip(self.rig.cameras, centres, turned, strict=True)
                ]
            )
        body = camera_from_body, places[index % len(places)], normals[index % len(places)]
        return StickerWindows(self, index, exposures, *body, corners, windows, offsets, found)

    def evenly_lit(self, windows: Windows, corners: NDArray[np.int_]) -> Windows:
        """Return windows (2, n, size, size) in which vignetting has the same value as in the
        middle.

        Vignetting would move the centre of a sticker because it varies across the sticker. The
        correction changes the noise by a few per mille only.
        """
        optics = self.settings.optics
        black = self.noise.black_level
        if optics.vignetting == 0.0:
            return windows
        size = windows.shape[-1]
        middle = corners + 0.5 * (windows.shape[-1] - 1)
        share = np.stack(
            [
                optics.window_illumination(camera, at, size)
                / optics.illumination(camera, centre)[:, None, None]
                for camera, at, centre in zip(self.rig.cameras, corners, middle, strict=True)
            ]
        )
        return black + (windows - black) / share


@dataclass(frozen=True)
class StickerWindows:
    """Grey values around the k stickers of a body that both cameras of an observer should see.

    index             (k,), indices of the stickers among the body's stickers
    exposures         (k,), number of the exposure that shows each sticker, in rising order
    camera_from_body  (4, 4) or (N, 4, 4), expected place of the body in each exposure
    places, normals   (k, 3), of the stickers, in body axes, m
    corners           (2, k, 2), first pixels of the windows
    windows           (2, k, h, h), grey values without vignetting in which stickers are bright;
                      empty without images
    offsets           (2, k, 2), eccentricities of the ellipses, px
    found             result of the detector for exposures without images, otherwise None
    """

    observer: Observer
    index: NDArray[np.int_]
    exposures: NDArray[np.int_]
    camera_from_body: Array
    places: Array
    normals: Array
    corners: NDArray[np.int_]
    windows: Windows
    offsets: Array
    found: DetectedCentres | None = None

    def observed(self, exposure_ends: tuple[Array, Array] | None = None) -> StickerObservation:
        """Return the stickers in these windows; see ``Observer.observe`` for ``exposure_ends``."""
        if len(self.index) == 0:
            none = np.zeros((0, 3))
            return StickerObservation(
                self.index, none[:, :2], none[:, :2], none, np.zeros((0, 3, 3)), none[:, 0]
            )
        settings = self.observer.settings
        fits = self.found or self._detected()
        if exposure_ends is not None and self.found is None:
            fits = self._more_likely(fits, exposure_ends)
        seen_at = fits.centres.reshape(2, -1, 2) - self.offsets
        systematic = settings.centre_error_px**2 + self.observer.detector.bias_px**2
        spread = fits.covariances.reshape(2, -1, 2, 2) + systematic * np.eye(2)
        # Errors of the rig part the two rays of a sticker. With weights from noise alone, the point
        # would be too near to the ray of the sharper image.
        line_variance = settings.line_error_px**2
        moves = self.camera_from_body.reshape(-1, 4, 4)[self.exposures]
        near = apply_each(moves, self.places[:, None])[:, 0]
        left, right = seen_at
        seen = triangulate(
            self.observer.rig, left, right, spread[0], spread[1], near, line_variance
        )
        good = np.all(fits.good.reshape(2, -1), axis=0)
        # Mean variance over two coordinates in two images.
        noise = 0.25 * np.einsum("ckii->k", spread)
        outlines = _outlines(fits, settings.centre_error_px**2)
        return StickerObservation(
            self.index, seen_at[0], seen_at[1], seen.points, seen.covariances, noise, outlines
        ).selected(good & (seen.ray_gap < settings.largest_ray_gap))

    def ellipses(self, smears: Array | None = None) -> EllipseFits:
        """Fit ellipses to all 2k windows, without a limit on the misfit.

        See ``SpotWindows`` for ``smears`` (2k, 2).
        """
        settings = self.observer.settings
        limits = replace(settings.limits, largest_misfit=np.inf)
        return fit_ellipses(
            *self._flat,
            self.observer.upright,
            settings.fit_size,
            limits,
            psf_px=settings.optics.psf_px,
            smears=smears,
        )

    @cached_property
    def ellipses_at_rest(self) -> EllipseFits:
        """Ellipses fitted as for a body at rest.

        The search for streaks uses them, and so does the measurement of a body at rest.
        """
        return self.ellipses()

    def _detected(self, smears: Array | None = None) -> DetectedCentres:
        """Return the centres that the detector finds in the windows."""
        detector = self.observer.detector
        noise = self.observer.upright
        settings = self.observer.settings
        if detector is MAXIMUM_LIKELIHOOD:
            fits = self.ellipses_at_rest if smears is None else self.ellipses(smears)
            return fits.within(settings.limits, noise)
        fit_size = settings.fit_size + 2 * detector.margin_px
        spots = SpotWindows(
            *self._flat, noise, fit_size, settings.limits, settings.optics.psf_px, smears
        )
        return detector.detect(spots)

    @property
    def _flat(self) -> tuple[Windows, NDArray[np.int_]]:
        """Windows (2k, h, h) and corners (2k, 2) of both images together."""
        return self.windows.reshape(-1, *self.windows.shape[2:]), self.corners.reshape(-1, 2)

    def _more_likely(
        self, still: DetectedCentres, exposure_ends: tuple[Array, Array]
    ) -> DetectedCentres:
        """Choose, for each exposure, between the result for a body at rest and for a moving body.

        The movement between ``exposure_ends`` is only a prediction, and the platform can have
        stopped. The result that agrees better with the images is therefore chosen. ``still`` is the
        result for a body at rest.
        """
        smears, shown = self._smears(exposure_ends)
        if still.misfits is None or not shown.any():
            return still
        moving = self._selected(shown)._detected(smears[:, shown].reshape(-1, 2))
        again = np.tile(shown, 2)
        if moving.misfits is None:
            return still
        gains = (still.misfits[again] - moving.misfits).reshape(2, -1)
        _, starts, counts = np.unique(self.exposures[shown], return_index=True, return_counts=True)
        better = [np.median(own) > 0.0 for own in np.split(gains, starts[1:], axis=1)]
        taken = np.tile(np.repeat(better, counts), 2)
        return still.with_others(np.flatnonzero(again)[taken], moving, taken)

    def _smears(self, exposure_ends: tuple[Array, Array]) -> tuple[Array, NDArray[np.bool_]]:
        """Return the stickers' movements (2, k, 2) px during the exposure, and a mask (k,).

        The mask is False for exposures in which the longest movement is too short compared with the
        point spread, or too long to be measured.
        """
        moves = (pose.reshape(-1, 4, 4)[self.exposures] for pose in exposure_ends)
        first, last = (
            self.observer.rig.project(apply_each(move, self.places[:, None])[:, 0])[0]
            for move in moves
        )
        shortest = max(SMEAR_STEP_PX, SHORTEST_SMEAR * self.observer.settings.optics.psf_px)
        longest = np.zeros(self.exposures[-1] + 1)
        np.maximum.at(longest, self.exposures, np.linalg.norm(last - first, axis=-1).max(axis=0))
        return last - first, ((shortest < longest) & (longest < LONGEST_SMEAR_PX))[self.exposures]

    def _selected(self, keep: NDArray[np.bool_]) -> StickerWindows:
        """Return the windows of only some of the stickers."""
        each = {
            name: getattr(self, name)[keep] for name in ("index", "exposures", "places", "normals")
        }
        both = {name: getattr(self, name)[:, keep] for name in ("corners", "windows", "offsets")}
        return replace(self, **each, **both)


def faces_camera(centres: Array, normals: Array) -> NDArray[np.bool_]:
    """Tell for each sticker (n,) whether it faces the camera, and not at grazing incidence.

    The stickers have centres (n, 3) m and normals (n, 3) in camera axes.
    """
    return np.asarray(
        -np.einsum("ni,ni->n", centres, normals) > GRAZING * np.linalg.norm(centres, axis=1)
    )


def _outlines(fits: DetectedCentres, systematic: float) -> Outlines | None:
    """Return the ellipses in both images, or None if the detector states none.

    ``systematic`` px² is the variance of systematic errors of the rim, which is added.
    """
    if fits.shapes is None or fits.shape_covariances is None:
        return None
    spread = fits.shape_covariances.reshape(2, -1, 3, 3) + systematic * np.eye(3)
    return Outlines(fits.shapes.reshape(2, -1, 2, 2), spread)
