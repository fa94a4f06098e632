"""Windows around the stickers of a body, and the stickers that are detected in them.

Centres are detected in the windows of both images, and triangulated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cmmsim.detection.detector import DetectedCentres, SpotWindows
from cmmsim.detection.ellipse_fit import (
    MAXIMUM_LIKELIHOOD,
    SMEAR_STEP_PX,
    EllipseFits,
    fit_ellipses,
)
from cmmsim.geometry.disc_image import NARROWEST_PX
from cmmsim.geometry.pose import Array, apply, apply_each
from cmmsim.geometry.triangulation import triangulate
from cmmsim.radiometry.stereo_images import Windows

if TYPE_CHECKING:
    from cmmsim.measuring.observation import Observer

# A smear is the movement of a sticker's image during the exposure. The longest smear that can be
# measured is about the size of a sticker.
LONGEST_SMEAR_PX = 8.0
# Point spreads of stickers out of focus are rounded to multiples of this. Stickers with the same
# point spread are fitted together.
SPREAD_STEP_PX = 0.01
# Half the variance of a point spread, px², is known to within KNOWN_BLUR. Noise explains an excess
# over this of LARGEST_BLUR standard deviations of the estimate.
KNOWN_BLUR = 0.002
LARGEST_BLUR = 3.0
# Standard deviation, px, of a shift along one axis that all centres in an image share, if half the
# variance differs by 1 px². Coma of a lens, and interpolation between pixels, cause such shifts.
LEAN = 0.6
# Shortest smear that changes the result of a fit, in standard deviations of the point spread.
SHORTEST_SMEAR = 1.5


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
    rays                       (k,), signed distance of a sticker's two rays, in standard deviations
    outlines                   ellipses of the stickers; None if the detector states no ellipses
    searched                   (f,), number of stickers that were searched in each of f exposures;
                               None if all were found
    detected                   (f,), number of these that were detected in both images, or None
    spreads                    (k, 2, 2, 2), covariances of the pixels in both images, px²; None if
                               only the points are known
    shifts                     (f, 2), standard deviation, px, of a shift that all centres in an
                               image share; None if there is none
    frame_ends                 (f, 2, 4, 4), camera_from_body half a frame period before and after
                               the middle of each exposure; None if the movement is not known
    """

    index: NDArray[np.int_]
    left_pixels: Array
    right_pixels: Array
    points: Array
    covariances: Array
    pixel_variances: Array
    rays: Array
    outlines: Outlines | None = None
    searched: NDArray[np.int_] | None = None
    detected: NDArray[np.int_] | None = None
    spreads: Array | None = None
    shifts: Array | None = None
    frame_ends: Array | None = None

    def selected(self, keep: NDArray[np.bool_]) -> StickerObservation:
        """Return the observation with only some of its stickers."""
        frames = ("searched", "detected", "shifts", "frame_ends")
        kept = {
            name: values[keep]
            for name, values in vars(self).items()
            if isinstance(values, np.ndarray) and name not in frames
        }
        outlines = None if self.outlines is None else self.outlines.selected(keep)
        return replace(self, **kept, outlines=outlines)


@dataclass(frozen=True)
class StickerWindows:
    """Grey values around the k stickers of a body that both cameras of an observer should see.

    index             (k,), j n + i for sticker i of the body's n stickers in exposure j
    exposures         (k,), number of the exposure that shows each sticker, in rising order
    camera_from_body  (4, 4) or (N, 4, 4), expected transform of the body in each exposure
    places, normals   (k, 3), of the stickers, in body axes; places in m
    corners           (2, k, 2), first pixels (x, y) of the windows
    windows           (2, k, h, h), grey values without vignetting in which stickers are bright;
                      empty without images
    offsets           (2, k, 2), eccentricities of the ellipses, px
    found             simulated detections, for exposures without images; otherwise None
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

    def observed(
        self,
        exposure_ends: tuple[Array, Array] | None = None,
        frame_ends: tuple[Array, Array] | None = None,
    ) -> StickerObservation:
        """Return the stickers in these windows; see ``Observer.observe`` for the parameters."""
        if len(self.index) == 0:
            points = np.zeros((0, 3))
            pixels = points[:, :2]
            return StickerObservation(
                self.index, pixels, pixels, points, np.zeros((0, 3, 3)), points[:, 0], points[:, 0]
            )
        settings = self.observer.settings
        fits = self.found or self.centres()
        smears = np.zeros((2, len(self.index), 2))
        if exposure_ends is not None and self.found is None:
            fits = self._more_likely(fits, exposure_ends, smears)
        shifts = None
        if self.found is None and isinstance(fits, EllipseFits):
            shifts = self._shifts(fits)
            fits = self._lit(fits, smears)
        centres = fits.centres.reshape(2, -1, 2) - self.offsets
        if settings.row_share > 0.0 and frame_ends is not None:
            centres = centres - self._swept(frame_ends)
        allowed = settings.allowed
        systematic = settings.centre_error_px**2 + self.observer.detector.bias_px**2
        systematic += allowed.changing_px**2
        spreads = fits.covariances.reshape(2, -1, 2, 2) + systematic * np.eye(2)
        # Errors of the rig separate the two rays of a sticker. With weights from noise alone, the
        # point would be too near to the ray of the sharper image.
        line_variance = settings.line_error_px**2
        left, right = centres
        seen = triangulate(
            self.observer.rig, left, right, spreads[0], spreads[1], self._expected, line_variance
        )
        good = np.all(fits.good.reshape(2, -1), axis=0)
        # Mean variance over two coordinates in two images.
        variances = 0.25 * np.einsum("ckii->k", spreads)
        outlines = _outlines(fits, settings.centre_error_px**2 + allowed.outline_px**2)
        observation = StickerObservation(
            self.index, left, right, seen.points, seen.covariances, variances, seen.rays, outlines
        )
        exposures = len(self.camera_from_body.reshape(-1, 4, 4))
        searched = np.bincount(self.exposures, minlength=exposures)
        detected = np.bincount(self.exposures[good], minlength=exposures)
        good &= seen.ray_gap < settings.largest_ray_gap
        ends = None
        if frame_ends is not None:
            ends = np.stack([end.reshape(-1, 4, 4) for end in frame_ends], axis=1)
        return replace(
            observation,
            searched=searched,
            detected=detected,
            spreads=spreads.swapaxes(0, 1),
            shifts=shifts,
            frame_ends=ends,
        ).selected(good)

    def ellipses(self, smears: Array | None = None, lit: bool = False) -> EllipseFits:
        """Fit ellipses to all 2k windows, without a limit on the misfit.

        See ``fit_ellipses`` for ``smears`` (2k, 2) and ``lit``.
        """
        settings = self.observer.settings
        limits = replace(settings.limits, largest_misfit=np.inf)
        windows, corners = self._flat

        def fit(own: NDArray[np.int_] | slice, psf_px: float) -> EllipseFits:
            return fit_ellipses(
                windows[own],
                corners[own],
                self.observer.upright,
                settings.fit_size,
                limits,
                psf_px=psf_px,
                smears=None if smears is None else smears[own],
                lit=lit,
            )

        if settings.optics.aperture == 0.0:
            return fit(slice(None), settings.optics.psf_px)
        groups = [np.flatnonzero(self._spreads_px == psf) for psf in np.unique(self._spreads_px)]
        fits = [fit(own, float(self._spreads_px[own[0]])) for own in groups]
        order = np.argsort(np.concatenate(groups))
        parts = zip(*(vars(each).values() for each in fits), strict=True)
        return EllipseFits(*(np.concatenate(values)[order] for values in parts))

    @cached_property
    def _expected(self) -> Array:
        """Expected positions (k, 3) m of the stickers in the camera frame."""
        transforms = self.camera_from_body.reshape(-1, 4, 4)[self.exposures]
        return apply_each(transforms, self.places[:, None])[:, 0]

    @cached_property
    def _spreads_px(self) -> Array:
        """Rounded point spreads (2k,) px at the expected depths of the stickers."""
        rig = self.observer.rig
        optics = self.observer.settings.optics
        spreads = [
            optics.spreads_px(camera.focal_px, apply(move, self._expected)[:, 2])
            for camera, move in zip(rig.cameras, rig.from_camera, strict=True)
        ]
        rounded = SPREAD_STEP_PX * np.round(np.concatenate(spreads) / SPREAD_STEP_PX)
        return np.where(rounded < NARROWEST_PX, 0.0, rounded)

    @cached_property
    def ellipses_at_rest(self) -> EllipseFits:
        """Ellipses fitted as for a body at rest.

        The search for streaks uses them, and so does the measurement of a body at rest.
        """
        return self.ellipses()

    def centres(self, smears: Array | None = None) -> DetectedCentres:
        """Return the centres that the detector finds in all 2k windows; see also ``ellipses``."""
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

    def _shifts(self, even: EllipseFits) -> Array | None:
        """Return the standard deviation (f, 2), px, of the common shift of centres in each image.

        A point spread that differs from the known one can lean to one side. The result is None if
        print is known to be imperfect, because it widens the images of stickers as well.
        """
        if self.observer.settings.allowed.known:
            return None
        good = np.all(even.good.reshape(2, -1), axis=0)
        exposures = len(self.camera_from_body.reshape(-1, 4, 4))
        evidence = np.zeros((exposures, 2, 2))
        np.add.at(
            evidence,
            self.exposures[good],
            even.lights[:, 5:].reshape(2, -1, 2)[:, good].swapaxes(0, 1),
        )
        sums, information = np.moveaxis(evidence, -1, 0)
        known = information > 0.0
        deviation = 1.0 / np.sqrt(np.where(known, information, np.inf))
        blur = np.abs(sums) * deviation**2
        return LEAN * np.maximum(blur - LARGEST_BLUR * deviation - KNOWN_BLUR, 0.0)

    def _lit(self, even: EllipseFits, smears: Array) -> DetectedCentres:
        """Fit rising light to stickers in the exposures in which this moves the pose beyond noise.

        In other exposures, this would only widen the covariance. ``even`` are the fits with even
        light, for stickers that move by ``smears`` (2, k, 2) px during the exposure.
        """
        # Imported late, because importing numba takes time.
        from cmmsim.measuring.warp_kernels import light_sizes

        good = np.flatnonzero(np.all(even.good.reshape(2, -1), axis=0))
        exposures = np.arange(self.exposures[-1] + 2)
        expected = self._expected[good]
        origins = self.camera_from_body.reshape(-1, 4, 4)[self.exposures[good], :3, 3]
        sizes = np.empty(len(exposures) - 1)
        # Contiguous copies, because the kernel would be compiled once more for parts of arrays.
        light_sizes(
            self.observer.rig.kernel_cameras,
            expected,
            expected - origins,
            np.ascontiguousarray(even.covariances.reshape(2, -1, 2, 2)[:, good]),
            np.ascontiguousarray(even.lights.reshape(2, -1, 7)[:, good]),
            np.searchsorted(self.exposures[good], exposures),
            sizes,
        )
        chosen = (sizes > self.observer.settings.allowed.largest_light)[self.exposures]
        if not chosen.any():
            return even
        part = self._selected(chosen)
        lit = part.ellipses(smears[:, chosen].reshape(-1, 2), lit=True)
        lit = lit.within(self.observer.settings.limits, self.observer.upright)
        return even.with_others(
            np.flatnonzero(np.tile(chosen, 2)), lit, np.ones(2 * len(part.index), dtype=bool)
        )

    def _more_likely(
        self, still: DetectedCentres, exposure_ends: tuple[Array, Array], chosen_smears: Array
    ) -> DetectedCentres:
        """Choose, for each exposure, between the result for a body at rest and for a moving body.

        The movement between ``exposure_ends`` is only a prediction, and the body can have stopped.
        The result that agrees better with the images is therefore chosen. ``still`` is the result
        for a body at rest. ``chosen_smears`` (2, k, 2) contains zeros, and is filled with the
        movements of the stickers in chosen results for a moving body, px.
        """
        smears, measurable = self._smears(exposure_ends)
        if still.misfits is None or not measurable.any():
            return still
        moving = self._selected(measurable).centres(smears[:, measurable].reshape(-1, 2))
        if moving.misfits is None:
            return still
        windows = np.flatnonzero(np.tile(measurable, 2))
        gains = (still.misfits[windows] - moving.misfits).reshape(2, -1)
        exposures = self.exposures[measurable]
        _, starts, counts = np.unique(exposures, return_index=True, return_counts=True)
        better = [np.median(part) > 0.0 for part in np.split(gains, starts[1:], axis=1)]
        chosen = np.repeat(better, counts)
        stickers = np.flatnonzero(measurable)[chosen]
        chosen_smears[:, stickers] = smears[:, stickers]
        both = np.tile(chosen, 2)
        return still.with_others(windows[both], moving, both)

    def _smears(self, exposure_ends: tuple[Array, Array]) -> tuple[Array, NDArray[np.bool_]]:
        """Return the stickers' movements (2, k, 2) px during the exposure, and a mask (k,).

        The mask is False for the stickers of exposures in which the longest movement is too short
        compared with the point spread, or too long to be measured.
        """
        moved = self._moved(exposure_ends)
        shortest = max(SMEAR_STEP_PX, SHORTEST_SMEAR * self.observer.settings.optics.psf_px)
        longest = np.zeros(self.exposures[-1] + 1)
        np.maximum.at(longest, self.exposures, np.linalg.norm(moved, axis=-1).max(axis=0))
        return moved, ((shortest < longest) & (longest < LONGEST_SMEAR_PX))[self.exposures]

    def _moved(self, ends: tuple[Array, Array]) -> Array:
        """Return the stickers' movements (2, k, 2) px between two camera_from_body."""
        first, last = (
            self.observer.rig.project(
                apply_each(pose.reshape(-1, 4, 4)[self.exposures], self.places[:, None])[:, 0]
            )[0]
            for pose in ends
        )
        return np.asarray(last - first)

    def _swept(self, frame_ends: tuple[Array, Array]) -> Array:
        """Return the movements (2, k, 2) px of the stickers during the delays of their rows."""
        return np.asarray(self.row_delays()[..., None] * self._moved(frame_ends))

    def row_delays(self) -> Array:
        """Return the delays (2, k) of the stickers' rows after the middle row, in frame periods."""
        rows = self.corners[..., 1] + 0.5 * (self.windows.shape[-1] - 1)
        middles = [0.5 * (camera.height - 1) for camera in self.observer.rig.cameras]
        return np.asarray(self.observer.settings.row_share * (rows - np.array(middles)[:, None]))

    def _selected(self, keep: NDArray[np.bool_]) -> StickerWindows:
        """Return the windows of only some of the stickers."""
        each = {
            name: getattr(self, name)[keep] for name in ("index", "exposures", "places", "normals")
        }
        both = {name: getattr(self, name)[:, keep] for name in ("corners", "windows", "offsets")}
        return replace(self, **each, **both)


def _outlines(fits: DetectedCentres, systematic: float) -> Outlines | None:
    """Return the ellipses in both images, or None if the detector states none.

    ``systematic`` px² is the variance of systematic errors of the rim, which is added.
    """
    if fits.shapes is None or fits.shape_covariances is None:
        return None
    spread = fits.shape_covariances.reshape(2, -1, 3, 3) + systematic * np.eye(3)
    return Outlines(fits.shapes.reshape(2, -1, 2, 2), spread)
