"""Sizes of stickers in the images, and the windows and detection settings that follow from them."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cmmsim.detection.detector import FitLimits
from cmmsim.detection.ellipse_fit import RING_REACH
from cmmsim.errors import TeachingWarning
from cmmsim.files.rig_and_bodies import MarkedBody
from cmmsim.files.schema import SensorFile
from cmmsim.geometry.camera import Optics
from cmmsim.geometry.pose import Array, apply, pose_to_transform
from cmmsim.geometry.stereo_rig import StereoRig, radius_at
from cmmsim.measuring.layout_search import SMALLEST_STEP
from cmmsim.measuring.observation import DetectionSettings
from cmmsim.measuring.print_allowance import print_allowance
from cmmsim.radiometry.noise import CameraNoise
from cmmsim.teaching import TeachingPlan, WindowSizes, image_radii, window_sizes
from cmmsim.uncertainty.known_rig import KnownRig

# Least width of the ring beyond the fitted pixels, in point spreads, in the flattest image. With
# 1.33, the bias of poses of ctrack780 is below half a standard deviation (lens.psf_px = 0.8), and
# with 1.19, teaching can fail.
LEAST_SPREADS = 1.3


@dataclass(frozen=True)
class StickerView:
    """Stickers of platform and base in front of a rig, with the platform at home.

    ``known`` states how well the rig is known; None means exactly. ``camera_from_base`` (4, 4) is
    the transform that the sensor file states.
    """

    file: SensorFile
    platform: MarkedBody
    base: MarkedBody
    rig: StereoRig
    known: KnownRig | None
    camera_from_base: Array
    optics: Optics

    @cached_property
    def sizes(self) -> WindowSizes:
        """Sizes of the windows around stickers: large or blurred stickers need larger windows."""
        radius = self.file.stickers.radius
        camera_from_base = self.camera_from_base
        at_target = radius_at(self.rig, camera_from_base, np.array(self.file.rig.target), radius)
        at_teaching = float(self._image_radii.max(initial=0.0))
        focal_px = float(self.rig.left.focal_px)
        psf_px = float(self.optics.spreads_px(focal_px, self._stickers[:, 2]).max())
        blurred = psf_px > 0.0 or self.file.timing.exposure > 0.0
        return window_sizes(at_target, at_teaching, psf_px, blurred)

    def settings(self, noise: CameraNoise, centre_error_px: float) -> DetectionSettings:
        """Return the settings of the search for stickers in windows.

        ``centre_error_px`` is the error of a sticker's centre that the renderer causes, px rms.
        """
        timing = self.file.timing
        radius = self.file.stickers.radius
        at_target = radius_at(
            self.rig, self.camera_from_base, np.array(self.file.rig.target), radius
        )
        allowed = print_allowance(self.file, noise, at_target, self.sizes.fit)
        return DetectionSettings(
            self.sizes.window,
            self.sizes.fit,
            radius=self.file.stickers.radius,
            detector=self.file.detection.detector,
            limits=FitLimits(SMALLEST_STEP * noise.white_level, allowed.largest_misfit),
            optics=self.optics,
            centre_error_px=centre_error_px,
            exposed_share=timing.exposure * timing.frame_rate,
            row_share=timing.row_time * timing.frame_rate,
            line_error_px=0.0 if self.known is None else self.known.line_std(self._stickers),
            dark=self.file.stickers.dark,
            allowed=allowed,
        )

    def teaching_plan(self) -> TeachingPlan:
        """Return a plan of teaching.

        Warns if the point spread carries the light of the bodies over the rings of stickers.
        """
        stated = self.file.lens.psf_px
        if stated > self.widest_psf_px:
            warnings.warn(
                f"teaching: lens.psf_px = {stated:g} blurs the light of the bodies over the rings "
                "of stickers, so that poses are off by more than they state; this is small up to "
                f"{self.widest_psf_px:.2g} px, and with a larger stickers.ring_radius",
                TeachingWarning,
                stacklevel=4,
            )
        return self.sizes.plan()

    @property
    def widest_psf_px(self) -> float:
        """Widest point spread, px, that keeps the light of the bodies off the fit of stickers.

        A wider one carries it over the rings into the fitted pixels, which moves centres. It is
        infinite if rings are as dark as the bodies.
        """
        stickers = self.file.stickers
        if stickers.body_level == stickers.ring_level:
            return np.inf
        beyond = stickers.ring_radius / stickers.radius - RING_REACH
        return float(self._image_radii.min(initial=np.inf)) * beyond / LEAST_SPREADS

    @cached_property
    def _image_radii(self) -> Array:
        """Semi-axes (n,), px, in the images of all stickers that both cameras see."""
        placed = (self.camera_from_base, self.base), (self._camera_from_platform, self.platform)
        radius = self.file.stickers.radius
        return np.concatenate(
            [image_radii(self.rig, move, body, radius).ravel() for move, body in placed]
        )

    @property
    def _camera_from_platform(self) -> Array:
        return self.camera_from_base @ pose_to_transform(np.array(self.file.platform.home))

    @property
    def _stickers(self) -> Array:
        """Nominal positions (n, 3) of all stickers in the camera frame, m."""
        poses = (self._camera_from_platform, self.platform), (self.camera_from_base, self.base)
        return np.concatenate([apply(move, body.nominal) for move, body in poses])
