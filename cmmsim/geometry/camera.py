"""A pinhole camera with its lens: distortion, point spread, defocus, vignetting and ghost.

Pixel coordinates (0, 0) are the centre of the top-left pixel. Camera axes are x right, y down, z
forward. A perfect lens has no distortion. The ideal pixel of a point is the pixel at which the same
camera would show it through a perfect lens. In ideal pixels, straight lines stay straight, and the
linear formulas of epipolar geometry and triangulation hold.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, field, replace
from functools import cached_property
from math import ceil

import numpy as np
from numpy.typing import NDArray

from cmmsim.checks import finite_array
from cmmsim.errors import CmmError
from cmmsim.geometry.lens_distortion import Distortion, NDArrayBool
from cmmsim.geometry.pose import Array, frozen

INTRINSIC_NAMES = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3")
# Distance at which the point spread is cut off, in standard deviations.
PSF_REACH = 5.0


@dataclass(frozen=True)
class PinholeCamera:
    """Pinhole camera with a lens.

    Parameters
    ----------
    focal_px : float
        Focal length along x, px.
    centre_x_px, centre_y_px : float
        Principal point, px.
    width, height : int
        Size of the image, px.
    aspect : float
        Focal length along y divided by that along x.
    distortion : Distortion
        Distortion of the lens.

    Raises
    ------
    ShapeError
        If focal length, principal point, size or aspect is not a finite number.
    CmmError
        If focal length, aspect or size is not positive.

    Examples
    --------
    >>> camera = PinholeCamera(1000.0, 319.5, 239.5, 640, 480)
    >>> pixels, inside = camera.project(np.array([[0.1, 0.0, 2.0]]))
    >>> pixels.tolist(), inside.tolist()
    ([[369.5, 239.5]], [True])
    """

    focal_px: float
    centre_x_px: float
    centre_y_px: float
    width: int
    height: int
    aspect: float = 1.0
    distortion: Distortion = field(default_factory=Distortion)

    def __post_init__(self) -> None:
        numbers = (
            self.focal_px,
            self.centre_x_px,
            self.centre_y_px,
            self.width,
            self.height,
            self.aspect,
        )
        finite_array(
            numbers,
            (6,),
            "a camera's focal length, principal point, size and aspect are finite numbers",
        )
        if self.focal_px <= 0.0 or self.aspect <= 0.0 or self.width < 1 or self.height < 1:
            raise CmmError(f"camera needs a positive focal length, aspect and size, got {self}")

    @cached_property
    def focal_lengths(self) -> Array:
        """Focal lengths (2,) along x and y, px."""
        return frozen([self.focal_px, self.focal_px * self.aspect])

    @cached_property
    def centre(self) -> Array:
        """Principal point (2,), px."""
        return frozen([self.centre_x_px, self.centre_y_px])

    @property
    def matrix(self) -> Array:
        """Camera matrix K (3,3)."""
        focal_x, focal_y = self.focal_lengths
        x, y = self.centre
        return np.array([[focal_x, 0.0, x], [0.0, focal_y, y], [0.0, 0.0, 1.0]])

    @property
    def intrinsics(self) -> Array:
        """Focal lengths, principal point and distortion (9,) in the order of INTRINSIC_NAMES."""
        return np.array([*self.focal_lengths, *self.centre, *astuple(self.distortion)])

    @cached_property
    def ideal(self) -> PinholeCamera:
        """Camera with the same parameters and a perfect lens."""
        return self if self.distortion.is_zero else replace(self, distortion=Distortion())

    def project(self, points: Array) -> tuple[Array, NDArrayBool]:
        """Return pixels (..., 2) of points (..., 3) m in camera axes, and whether each is seen.

        A point is seen if it lies in front of the camera, its pixel lies inside the image, and the
        distortion model is valid there. The pixel of a point behind the camera is meaningless.
        """
        depth = points[..., 2]
        ahead = depth > 1e-6
        scale = self.focal_lengths / np.where(ahead, depth, 1.0)[..., None]
        pixels = points[..., :2] * scale + self.centre
        if not self.distortion.is_zero:
            pixels, holds = self.distort(pixels)
            ahead &= holds
        return pixels, ahead & self.shows(pixels)

    def shows(self, pixels: Array, margin: float = -0.5) -> NDArrayBool:
        """Return a mask (...) of the pixels (..., 2) that lie inside the image.

        A pixel must lie more than ``margin`` px inside the centres of the outermost pixels. With
        -0.5, the image ends at the outer edges of these pixels.
        """
        return np.all(
            (pixels > margin) & (pixels < (self.width - 1 - margin, self.height - 1 - margin)),
            axis=-1,
        )

    def distort(self, ideal: Array) -> tuple[Array, NDArrayBool]:
        """Return pixels (..., 2) for ideal pixels (..., 2), and a mask (...) of valid ones.

        A pixel is valid if the distortion model is valid there, inside the image or not.
        """
        if self.distortion.is_zero:
            return ideal, np.ones(ideal.shape[:-1], dtype=bool)
        normalised = (ideal - self.centre) / self.focal_lengths
        return self.distortion.distort(
            normalised
        ) * self.focal_lengths + self.centre, self.distortion.holds(normalised)

    def undistort(self, pixels: Array) -> tuple[Array, NDArrayBool]:
        """Return ideal pixels (..., 2) for pixels (..., 2), and whether each ideal pixel exists.

        An ideal pixel that does not exist has a finite but meaningless value.
        """
        if self.distortion.is_zero:
            return pixels, np.ones(pixels.shape[:-1], dtype=bool)
        normalised, exists = self.distortion.undistort((pixels - self.centre) / self.focal_lengths)
        return normalised * self.focal_lengths + self.centre, exists

    def distortion_jacobian(self, ideal: Array) -> Array:
        """Return d(pixel) / d(ideal pixel) (..., 2, 2) at ideal pixels (..., 2)."""
        focal = self.focal_lengths
        return self.distortion.jacobian((ideal - self.centre) / focal) * focal[:, None] / focal


def camera_from(intrinsics: Array, width: int, height: int) -> PinholeCamera:
    """Return the camera with intrinsics (9,) in the order of INTRINSIC_NAMES."""
    fx, fy, cx, cy, *terms = (float(value) for value in intrinsics)
    return PinholeCamera(fx, cx, cy, width, height, aspect=fy / fx, distortion=Distortion(*terms))


@dataclass(frozen=True)
class Optics:
    """Point spread, vignetting, defocus and ghost of a lens.

    ``psf_px`` is the standard deviation of the Gaussian point spread, px. ``vignetting`` is the
    fraction of the light that is missing in the corner farthest from the principal point. The loss
    grows with the square of the distance from the principal point. ``aperture`` is the diameter of
    the aperture, m, and ``focus`` the depth that is in focus, m. A ghost is a copy of the image,
    shifted by ``ghost_offset`` px (x, y) and multiplied by ``ghost``, that is added to the image.
    If all but the focus and the offset are zero, the image is that of a pinhole camera. Raises
    CmmError if ``psf_px`` is negative, or ``vignetting`` is negative or not below 1.
    """

    psf_px: float = 0.0
    vignetting: float = 0.0
    aperture: float = 0.0
    focus: float = 1.0
    ghost: float = 0.0
    ghost_offset: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        if not (self.psf_px >= 0.0 and 0.0 <= self.vignetting < 1.0):
            raise CmmError(f"optics need psf_px >= 0 and vignetting from 0 to below 1, got {self}")

    @staticmethod
    def reach_px(psf_px: float) -> int:
        """Return the distance at which a point spread is cut off, px (an integer)."""
        return ceil(PSF_REACH * psf_px)

    def spreads_px(self, focal_px: float, depths: Array) -> Array:
        """Return the standard deviations (k,) px of point spread and defocus at ``depths`` (k,), m.

        A blur circle of diameter c has the variance c² / 16 along each axis.
        """
        circles = focal_px * self.aperture * np.abs(1.0 / self.focus - 1.0 / depths)
        return np.sqrt(self.psf_px**2 + circles**2 / 16.0)

    def illumination(self, camera: PinholeCamera, pixels: Array) -> Array:
        """Return the relative illumination (...) of pixels (..., 2).

        It is 1 at the principal point, and never below 0.
        """
        corners = np.array(
            [[x, y] for x in (-0.5, camera.width - 0.5) for y in (-0.5, camera.height - 0.5)]
        )
        farthest = np.sum((corners - camera.centre) ** 2, axis=1).max()
        return np.maximum(
            1.0 - self.vignetting / farthest * np.sum((pixels - camera.centre) ** 2, axis=-1), 0.0
        )

    def window_illumination(
        self, camera: PinholeCamera, corners: NDArray[np.int_], size: int
    ) -> Array:
        """Return the relative illumination (k, size, size) of windows.

        ``corners`` (k, 2) are the first pixels (x, y) of the windows.
        """
        ticks = np.arange(size)
        x = corners[:, 0, None, None] + ticks
        y = corners[:, 1, None, None] + ticks[:, None]
        return self.illumination(camera, np.stack(np.broadcast_arrays(x, y), axis=-1))
