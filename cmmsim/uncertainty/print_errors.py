"""Errors of sticker centres due to the thickness and the retro-reflection of all stickers.

The estimator knows the sizes of these errors, but not their values. They depend on the angle of
view alone, so a sticker has the same errors whenever it is seen at the same angle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cmmsim.files.printed import print_sizes
from cmmsim.files.rig_and_bodies import MarkedBody
from cmmsim.files.schema import SensorFile
from cmmsim.geometry.pose import Array, apply_each
from cmmsim.geometry.stereo_rig import StereoRig
from cmmsim.geometry.sticker_print import PrintSizes, SeenStickers

PRINT_NAMES = ("taught.stickers.thickness_m", "taught.stickers.retro_shift_m")


@dataclass(frozen=True)
class PrintErrors:
    """Sizes of the errors of all stickers, and the radius of the stickers, m."""

    sizes: PrintSizes
    radius: float

    @property
    def std(self) -> Array:
        """Standard deviations (2,) of thickness and retro-shift, m."""
        return self.radius * np.abs([self.sizes.thickness, self.sizes.retro_shift])

    def shifts(
        self, rig: StereoRig, camera_from_body: Array, places: Array, body: MarkedBody
    ) -> Array:
        """Return the shifts (2, N, n, 2, 2) px of the centres of stickers in both images.

        The last axis is for thickness and retro-shift, each with an error of one standard
        deviation. The body has the poses camera_from_body (N, 4, 4), and its stickers have the
        positions ``places`` (n, 3) in body axes, m.
        """
        turns = camera_from_body[:, None, :3, :3]
        points = apply_each(camera_from_body, places)
        normals = (turns @ body.sticker_normals[..., None])[..., 0]
        axes = turns @ body.in_plane
        flat = points.reshape(-1, 3)
        slopes = rig.derivatives(flat)[0].reshape(2, *points.shape[:2], 2, 3)
        return np.stack(
            [
                self._seen(points - eye, normals, axes, slope)
                for eye, slope in zip((np.zeros(3), rig.right_centre), slopes, strict=True)
            ]
        )

    def _seen(self, rays: Array, normals: Array, axes: Array, slopes: Array) -> Array:
        """Return the shifts (N, n, 2, 2) px in the image of one camera."""
        shape = rays.shape[:2]
        seen = SeenStickers.of(
            rays.reshape(-1, 3),
            normals.reshape(-1, 3),
            axes.reshape(-1, 3, 2),
            self.radius,
            slopes.reshape(-1, 2, 3),
        )
        return seen.shifts_of_kind(self.sizes).reshape(*shape, 2, 2)


def known_errors(file: SensorFile) -> PrintErrors | None:
    """Return the print errors that an estimator with this sensor file knows, or None.

    The result is None if it does not know their sizes, or if thickness and retro-shift are zero.
    """
    sizes = print_sizes(file)
    if file.print.known and (sizes.thickness or sizes.retro_shift):
        return PrintErrors(sizes, file.stickers.radius)
    return None
