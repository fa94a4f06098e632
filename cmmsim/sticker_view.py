"""Sizes of stickers in the images, and the windows and detection settings that follow from them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cmmsim.detection.detector import FitLimits
from cmmsim.files.rig_and_bodies import MarkedBody
from cmmsim.files.schema import SensorFile
from cmmsim.geometry.camera import Optics
from cmmsim.geometry.pose import Array, apply, pose_to_transform
from cmmsim.geometry.stereo_rig import StereoRig, radius_at
from cmmsim.measuring.layout_search import SMALLEST_STEP
from cmmsim.measuring.observation import DetectionSettings
from cmmsim.measuring.print_allowance import print_allowance
from cmmsim.radiometry.noise import CameraNoise
from cmmsim.teaching import WindowSizes, largest_radius, window_sizes
from cmmsim.uncertainty.known_rig import KnownRig


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
        at_teaching = max(
            largest_radius(self.rig, camera_from_base, self.base, radius),
            largest_radius(self.rig, self._camera_from_platform, self.platform, radius),
        )
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

    @property
    def _camera_from_platform(self) -> Array:
        return self.camera_from_base @ pose_to_transform(np.array(self.file.platform.home))

    @property
    def _stickers(self) -> Array:
        """Nominal positions (n, 3) of all stickers in the camera frame, m."""
        poses = (self._camera_from_platform, self.platform), (self.camera_from_base, self.base)
        return np.concatenate([apply(move, body.nominal) for move, body in poses])
