"""Observation of the stickers of one body near their expected places, with its settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from cmmsim.allowed_plugins import DEFAULT_DETECTOR
from cmmsim.detection.detector import (
    DetectedCentres,
    Detector,
    FitLimits,
    find_detector,
)
from cmmsim.detection.ellipse_fit import EllipseFits
from cmmsim.geometry.camera import Optics
from cmmsim.geometry.disc_image import centre_offset
from cmmsim.geometry.pose import Array, apply_each
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.measuring.print_allowance import PrintAllowance
from cmmsim.measuring.sticker_windows import StickerObservation, StickerWindows
from cmmsim.radiometry.noise import CameraNoise
from cmmsim.radiometry.stereo_images import ManyExposures, StereoImages, Windows

# Smallest cosine between a sticker's normal and the line of sight at which the sticker is searched.
GRAZING = 0.15


@dataclass(frozen=True)
class DetectionSettings:
    """Settings of the search for stickers.

    window_size      side of a window, px
    fit_size         side of the part of a window that is fitted, px
    radius           radius of a sticker, m
    limits           limits for accepting a fit
    largest_ray_gap  largest squared distance between the two rays of a sticker, in units of the
                     distance's variance; 25 means five standard deviations
    centre_error_px  rms of systematic errors of a centre, px; its square is added to the variances
                     of a centre, and so is the square of the detector's bias
    detector         name of the detector
    optics           point spread, vignetting, defocus and ghost of the lenses
    exposed_share    ratio of exposure time to frame period
    row_share        ratio of the time between two rows of pixels to the frame period
    line_error_px    standard deviation of a centre's distance from its epipolar line that errors of
                     the rig cause, px; it increases the allowed distance between two rays
    dark             True for dark stickers in bright rings
    allowed          allowance for print that is not perfect
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
    row_share: float = 0.0
    line_error_px: float = 0.0
    dark: bool = False
    allowed: PrintAllowance = field(default_factory=PrintAllowance)


@runtime_checkable
class StickerExposure(Protocol):
    """Exposure without images, which returns simulated results of the fits of ellipses."""

    def detected(self, corners: NDArray[np.int_], size: int, observer: Observer) -> DetectedCentres:
        """Detect stickers in 2k windows of ``size`` px with first pixels ``corners`` (2, k, 2)."""

    def bright(self, observer: Observer) -> tuple[EllipseFits, EllipseFits]:
        """Return all ellipses in the left and in the right image."""


@dataclass(frozen=True)
class Observer:
    """Observer of stickers, with the known rig, its camera noise, and detection settings."""

    rig: StereoRig
    noise: CameraNoise
    settings: DetectionSettings

    @property
    def upright(self) -> CameraNoise:
        """Noise of the camera, with grey values inverted if stickers are dark."""
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
        frame_ends: tuple[Array, Array] | None = None,
    ) -> StickerObservation:
        """Observe stickers of a body near an expected pose camera_from_body (4, 4).

        The stickers have ``places`` (n, 3) m and ``normals`` (n, 3) in body axes. ``exposure_ends``
        are the expected camera_from_body at the beginning and at the end of the exposure.
        ``frame_ends`` are those half a frame period before and after the middle of the exposure.
        Both are None if the movement is not known.
        """
        windows = self.read(images, camera_from_body, places, normals)
        return windows.observed(exposure_ends, frame_ends)

    def read(
        self,
        images: StereoImages | StickerExposure | ManyExposures,
        camera_from_body: Array,
        places: Array,
        normals: Array,
    ) -> StickerWindows:
        """Read the windows around stickers of a body near an expected pose camera_from_body (4, 4).

        The stickers have ``places`` (n, 3) m and ``normals`` (n, 3) in body axes. Those that both
        cameras should see are read. For many exposures, camera_from_body is (N, 4, 4), and sticker
        k of exposure j has the index j n + k.
        """
        moves = [move @ camera_from_body for move in self.rig.from_camera]
        centres = [apply_each(move, places).reshape(-1, 3) for move in moves]
        turned_normals = [
            (normals @ move[..., :3, :3].swapaxes(-1, -2)).reshape(-1, 3) for move in moves
        ]
        pixels, in_image = self.rig.project(apply_each(camera_from_body, places).reshape(-1, 3))
        facing = np.stack(
            [faces_camera(c, t) for c, t in zip(centres, turned_normals, strict=True)]
        )
        # Triangulation needs two rays, so both cameras must see a sticker.
        index = np.flatnonzero(np.all(in_image & facing, axis=0))
        exposures = index // len(places)
        size = self.settings.window_size + 2 * self.detector.margin_px
        corners = np.rint(pixels[:, index] - 0.5 * (size - 1)).astype(int)
        windows: Windows = np.zeros((2, len(index), 0, 0))
        offsets = np.zeros((2, 0, 2))
        detected = None
        if len(index):
            if isinstance(images, StickerExposure):
                detected = images.detected(corners, size, self)
            elif isinstance(images, ManyExposures):
                exposures_together = images
                windows = self._as_lit(
                    lambda at: exposures_together.windows_of(exposures, at, size), corners
                )
            else:
                exposure = images
                windows = self._as_lit(lambda at: exposure.windows(at, size), corners)
            windows = self.upright.bright(windows)
            offsets = np.stack(
                [
                    centre_offset(camera, c[index], t[index], self.settings.radius)
                    for camera, c, t in zip(self.rig.cameras, centres, turned_normals, strict=True)
                ]
            )
        body = camera_from_body, places[index % len(places)], normals[index % len(places)]
        return StickerWindows(self, index, exposures, *body, corners, windows, offsets, detected)

    def _as_lit(
        self, read: Callable[[NDArray[np.int_]], Windows], corners: NDArray[np.int_]
    ) -> Windows:
        """Return windows without the lens's ghost and vignetting, to third order in the ghost.

        ``read`` returns the windows with first pixels ``corners`` (2, n, 2).
        """
        windows = read(corners)
        optics = self.settings.optics
        if optics.ghost > 0.0:
            for order in (1, 2, 3):
                beside = read(corners - order * np.array(optics.ghost_offset))
                light = np.asarray(beside - self.noise.black_level, dtype=float)
                windows = np.asarray(windows + (-optics.ghost) ** order * light, dtype=float)
        return self.evenly_lit(windows, corners)

    def evenly_lit(self, windows: Windows, corners: NDArray[np.int_]) -> Windows:
        """Return windows (2, n, size, size) with the vignetting of their middles at all pixels.

        Vignetting would move the centre of a sticker because it varies across the sticker. The
        correction changes the noise by a few per mille only. ``corners`` (2, n, 2) are the first
        pixels of the windows.
        """
        optics = self.settings.optics
        black = self.noise.black_level
        if optics.vignetting == 0.0:
            return windows
        size = windows.shape[-1]
        middle = corners + 0.5 * (windows.shape[-1] - 1)
        relative_light = np.stack(
            [
                optics.window_illumination(camera, image_corners, size)
                / optics.illumination(camera, image_middles)[:, None, None]
                for camera, image_corners, image_middles in zip(
                    self.rig.cameras, corners, middle, strict=True
                )
            ]
        )
        return black + (windows - black) / relative_light


def faces_camera(centres: Array, normals: Array) -> NDArray[np.bool_]:
    """Return a mask (n,) of the stickers that face the camera, and not at grazing incidence.

    The stickers have centres (n, 3) m and normals (n, 3) in camera axes.
    """
    return np.asarray(
        -np.einsum("ni,ni->n", centres, normals) > GRAZING * np.linalg.norm(centres, axis=1)
    )
