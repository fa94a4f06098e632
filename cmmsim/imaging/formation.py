"""From posed bodies to the light on each pixel, before noise: draw, bend, spread, average, darken.

Windows are drawn through perfect lenses on a grid finer than the pixels, with a margin for the
light that comes in from outside; distortion takes each fine pixel from where the lens takes it; the
point spread and the mean over each pixel follow, then the relative illumination. All of it in
linear light. A perfect lens with no point spread is drawn on the pixels at once.

Where the lens takes the light of a pixel from is known exactly on three by three nodes of a window
and quadratic in both directions in between; over some tens of pixels the rest is below 1e-4 px.
Values between drawn pixels come from Keys' cubic convolution, which reproduces quadratics, so that
no edge is moved or widened. Source: R. G. Keys, Cubic convolution interpolation for digital image
processing, IEEE Trans. ASSP 29 (1981).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.camera import Optics, PinholeCamera
from cmmsim.geometry.pose import Array, frozen
from cmmsim.imaging.renderer import Drawable, Renderer
from cmmsim.imaging.views import Views

# from values at -1, 0, 1
_QUADRATIC = frozen([[0.0, 1.0, 0.0], [-0.5, 0.0, 0.5], [0.5, -1.0, 0.5]])
# Fine pixels along each side of a pixel: the point spread smooths what resampling leaves, without
# it edges need more.
SUB_PIXELS = 6
SHARP_SUB_PIXELS = 12
SIDE_STEP = 4  # px: sides of drawn windows are multiples, so that few frame buffers serve all
REACH = 2  # drawn pixels that the cubic needs on either side


def resample(drawn: NDArray[np.float32], nodes: Array, size: int) -> NDArray[np.float32]:
    """Windows (n, size, size) whose pixels are taken from drawn windows (n, h, w).

    Parameters: nodes (n, 3, 3, 2): places (x, y) in the drawn window for the first, middle and last
    row and column.
    """
    from cmmsim.imaging.window_kernels import (
        resample_windows,
    )  # compiles, so it is loaded where it is first needed

    coefficients = np.einsum("ar,bc,nrcx->nabx", _QUADRATIC, _QUADRATIC, nodes)
    result = np.empty((len(drawn), size, size), dtype=np.float32)
    resample_windows(np.ascontiguousarray(drawn), coefficients, result)
    return result


@dataclass(frozen=True)
class Side:
    """One camera, camera_from_body transforms (b,4,4), and the first pixels (k,2) of the windows it
    is asked for.
    """

    camera: PinholeCamera
    bodies: Array
    corners: NDArray[np.int_]


@dataclass(frozen=True)
class ImageFormation:
    """The renderer, what it draws, the radiance of the background, and the lenses."""

    renderer: Renderer
    drawable: Drawable
    background: float
    optics: Optics

    def centre_error_px(self, cameras: Sequence[PinholeCamera], supersampling: int) -> float:
        """Error of a sticker's centre that drawing leaves, px rms, when ``supersampling`` is asked
        for.
        """
        fine = 1 if self.draws_pixels(cameras) else self.sub_pixels
        return self.renderer.centre_error_px(-(-supersampling // fine) * fine)

    @property
    def sub_pixels(self) -> int:
        """Fine pixels along each side of a pixel."""
        return SHARP_SUB_PIXELS if self.optics.psf_px == 0.0 else SUB_PIXELS

    def draws_pixels(self, cameras: Sequence[PinholeCamera]) -> bool:
        """Tell whether images need no finer grid than their pixels."""
        return self.optics.psf_px == 0.0 and all(camera.distortion.is_zero for camera in cameras)

    def windows(
        self,
        sides: Sequence[Side],
        size: int,
        supersampling: int,
        sub_pixels: int | None = None,
        shade: bool = True,
    ) -> list[NDArray[np.float32]]:
        """Radiance (k, size, size) of each side's windows.

        supersampling: drawn samples a pixel and axis, at the least; sub_pixels instead of the usual
        ones; shade: lay the relative illumination over them.
        """
        if self.draws_pixels([side.camera for side in sides]):
            windows = self._drawn(
                [(s.camera.ideal, s.bodies, s.corners) for s in sides], size, supersampling
            )
        else:
            windows = self._formed(sides, size, supersampling, sub_pixels or self.sub_pixels)
        if shade and self.optics.vignetting > 0.0:
            windows = [
                w * self.optics.window_illumination(s.camera, s.corners, size).astype(np.float32)
                for w, s in zip(windows, sides, strict=True)
            ]
        return windows

    def reached(
        self,
        camera: PinholeCamera,
        moments: Sequence[Array],
        corners: NDArray[np.int_],
        size: int,
        sub_pixels: int | None = None,
    ) -> NDArray[np.bool_]:
        """Mask of the patches that may show at each of several moments (m, k, patches).

        Bodies (b,4,4) stand at each, and windows have first pixels ``corners`` (k,2); size and
        sub_pixels are as of ``windows``.
        """
        first = corners
        drawn_size = size
        if not self.draws_pixels([camera]):
            fine_size = (size + 2 * self.optics.margin_px) * (sub_pixels or self.sub_pixels)
            places = _shown_places(camera, corners, size, self.optics.margin_px, fine_size)
            (first,), drawn_size = _drawn_parts([places])
        bounds = np.hstack([first - 0.5, first - 0.5 + drawn_size])
        return np.stack(
            [self.drawable.reaching_windows(camera.ideal, bodies, bounds) for bodies in moments]
        )

    def _drawn(
        self, sides: Sequence[tuple[PinholeCamera, Array, NDArray]], size: int, supersampling: int
    ) -> list[NDArray[np.float32]]:
        """Windows of one size as the renderer draws them."""
        images = self.renderer.draw(
            self.drawable, Views.of_sides(sides, (size, size)), supersampling, self.background
        )
        return np.split(images, np.cumsum([len(at) for _, _, at in sides])[:-1])

    def _formed(
        self, sides: Sequence[Side], size: int, supersampling: int, sub_pixels: int
    ) -> list[NDArray[np.float32]]:
        """Windows drawn finely, bent, spread and averaged."""
        margin = self.optics.margin_px
        fine_size = (size + 2 * margin) * sub_pixels
        nodes = [_shown_places(s.camera, s.corners, size, margin, fine_size) for s in sides]
        first, drawn_size = _drawn_parts(nodes)
        cameras = [_finer(side.camera.ideal, sub_pixels) for side in sides]
        finer = [
            (c, s.bodies, at * sub_pixels) for c, s, at in zip(cameras, sides, first, strict=True)
        ]
        drawn = self._drawn(finer, drawn_size * sub_pixels, -(-supersampling // sub_pixels))
        response = pixel_response(self.optics.psf_px, size, margin, sub_pixels)
        bent = [
            _bent(side, windows, (places - at[:, None, None] + 0.5) * sub_pixels - 0.5, fine_size)
            for side, windows, places, at in zip(sides, drawn, nodes, first, strict=True)
        ]
        return [np.asarray(response @ fine @ response.T) for fine in bent]


def _shown_places(
    camera: PinholeCamera, corners: NDArray[np.int_], size: int, margin: int, fine_size: int
) -> Array:
    """Ideal pixels (k, 3, 3, 2) that show in the first, middle and last fine row and column of
    windows with margin.
    """
    half = 0.5 * (size + 2 * margin) * (1.0 - 1.0 / fine_size)
    ticks = 0.5 * (size - 1) + half * np.array([-1.0, 0.0, 1.0])
    grid = np.stack(np.meshgrid(ticks, ticks), axis=-1)
    return camera.undistort(corners[:, None, None] + grid)[0]


def _drawn_parts(nodes: Sequence[Array]) -> tuple[list[NDArray[np.int_]], int]:
    """First ideal pixels (k, 2) on each side, and the common size in px, of what is drawn for
    places (k, 3, 3, 2).
    """
    first = [np.floor(places.min(axis=(1, 2))).astype(int) - REACH for places in nodes]
    reach = max(
        int(np.ceil((places - at[:, None, None]).max()))
        for places, at in zip(nodes, first, strict=True)
    )
    return first, -(-(reach + REACH + 1) // SIDE_STEP) * SIDE_STEP


def _bent(
    side: Side, drawn: NDArray[np.float32], nodes: Array, fine_size: int
) -> NDArray[np.float32]:
    """Fine windows (k, fine_size, fine_size) as the lens shows them; those of a perfect lens are
    only cut out.
    """
    if not side.camera.distortion.is_zero:
        return resample(drawn, nodes, fine_size)
    first = np.rint(nodes[:, 0, 0]).astype(int)
    ticks = np.arange(fine_size)
    return drawn[
        np.arange(len(drawn))[:, None, None],
        (first[:, 1, None] + ticks)[:, :, None],
        (first[:, 0, None] + ticks)[:, None, :],
    ]


@lru_cache(maxsize=16)
def _finer(camera: PinholeCamera, sub_pixels: int) -> PinholeCamera:
    """The same camera with ``sub_pixels`` times as many pixels along each side."""
    return replace(
        camera,
        focal_px=camera.focal_px * sub_pixels,
        centre_x_px=(camera.centre_x_px + 0.5) * sub_pixels - 0.5,
        centre_y_px=(camera.centre_y_px + 0.5) * sub_pixels - 0.5,
        width=camera.width * sub_pixels,
        height=camera.height * sub_pixels,
    )


@lru_cache(maxsize=32)
def pixel_response(psf_px: float, size: int, margin: int, sub_pixels: int) -> NDArray[np.float32]:
    """Weights (size, (size + 2 margin) sub_pixels) float32 with which drawn sub-pixels count in
    each pixel of a row.

    The mean over a pixel of a Gaussian of ``psf_px``: the drawn sub-pixels, means over their own
    width, make up the exact mean over a pixel wherever the Gaussian puts it.
    """
    total = (size + 2 * margin) * sub_pixels
    into_pixels = np.kron(
        np.eye(size, size + 2 * margin, margin), np.full(sub_pixels, 1.0 / sub_pixels)
    )
    if psf_px > 0.0:
        gap = np.subtract.outer(np.arange(total), np.arange(total))
        spread = np.exp(-0.5 * (gap / (psf_px * sub_pixels)) ** 2) * (
            np.abs(gap) <= margin * sub_pixels
        )
        into_pixels = into_pixels @ (spread / spread[total // 2].sum())
    weights = into_pixels.astype(np.float32)
    weights.setflags(write=False)
    return weights
