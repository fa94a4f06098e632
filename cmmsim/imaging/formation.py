"""Image formation from posed bodies to the light on each pixel, before noise.

Windows are drawn through perfect lenses on a grid of fine pixels, of which several form a pixel. A
margin around each window supplies the light that the point spread brings in from outside.
Distortion is applied by resampling: each fine pixel takes its light from its ideal pixel, which is
its position in the image of a perfect lens. Then the point spread, the mean over each pixel, a
ghost (a faint shifted copy) and the relative illumination are applied. All steps are linear in
light. Without distortion, blur and a painter, the pixels are drawn directly.

Ideal pixels are exact at three by three nodes of a window, and interpolated by quadratics in
between. In windows of some tens of pixels, the interpolation error is below 1e-4 px. Values between
drawn pixels come from Keys' cubic convolution. It reproduces quadratics, so it neither moves nor
widens edges. Source: R. G. Keys, Cubic convolution interpolation for digital image processing, IEEE
Trans. ASSP 29 (1981).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.camera import Optics, PinholeCamera
from cmmsim.geometry.pose import Array, frozen
from cmmsim.imaging.renderer import Drawable, Renderer, Views
from cmmsim.imaging.scene_bodies import DiscStack

# Matrix that maps the values of a quadratic at -1, 0 and 1 to its coefficients.
_QUADRATIC = frozen([[0.0, 1.0, 0.0], [-0.5, 0.0, 0.5], [0.5, -1.0, 0.5]])
# Number of fine pixels along each side of a pixel. The point spread smooths the errors of
# resampling; without a point spread, sharp edges need more fine pixels.
SUB_PIXELS = 6
SHARP_SUB_PIXELS = 12
# px: sides of drawn windows are multiples of this, so that few sizes of frame buffers are needed.
SIDE_STEP = 4
# Number of drawn pixels that the cubic convolution needs on either side.
REACH = 2
# Smallest and largest depth for which defocus is computed, as fractions of the usual distance. A
# depth outside of this range has the defocus of the nearer limit.
DEPTHS = (0.7, 1.5)
# px: point spreads of windows are rounded to multiples of this.
SPREAD_STEP = 0.01


def resample(drawn: NDArray[np.float32], nodes: Array, size: int) -> NDArray[np.float32]:
    """Return windows (n, size, size) that are resampled from drawn windows (n, h, w).

    ``nodes`` (n, 3, 3, 2) are the positions (x, y) in the drawn window of the result's pixels in
    the first, middle and last row and column.
    """
    # Imported late, because importing numba takes time.
    from cmmsim.imaging.window_kernels import resample_windows

    coefficients = np.einsum("ar,bc,nrcx->nabx", _QUADRATIC, _QUADRATIC, nodes)
    result = np.empty((len(drawn), size, size), dtype=np.float32)
    resample_windows(np.ascontiguousarray(drawn), coefficients, result)
    return result


@dataclass(frozen=True)
class Side:
    """Camera with camera_from_body (b, 4, 4) as ``bodies``, and first pixels (k, 2) of windows."""

    camera: PinholeCamera
    bodies: Array
    corners: NDArray[np.int_]


class Painter(Protocol):
    """Interface of a painter, which adds light and print to the images of a renderer."""

    def draw(
        self, renderer: Renderer, views: Views, supersampling: int, background: float
    ) -> NDArray[np.float32]:
        """Draw the radiance (n, h, w) of n windows."""

    @property
    def paints_background(self) -> bool:
        """True if the painter also paints into windows that show no body."""


@dataclass(frozen=True)
class ImageFormation:
    """Image formation: a renderer, the drawn bodies, the radiance of the background, and optics.

    A ``painter`` replaces the evenly lit and printed stickers of the renderer.
    """

    renderer: Renderer
    drawable: Drawable
    background: float
    optics: Optics
    painter: Painter | None = None

    def centre_error_px(self, cameras: Sequence[PinholeCamera], supersampling: int) -> float:
        """Return the error of a sticker's centre due to drawing with ``supersampling``, px rms."""
        fine = 1 if self.draws_pixels(cameras) else self.sub_pixels
        return self.renderer.centre_error_px(-(-supersampling // fine) * fine)

    @property
    def sub_pixels(self) -> int:
        """Number of fine pixels along each side of a pixel."""
        return SHARP_SUB_PIXELS if self.optics.psf_px == 0.0 else SUB_PIXELS

    def draws_pixels(self, cameras: Sequence[PinholeCamera]) -> bool:
        """Tell whether images are drawn directly on their pixels, without fine pixels.

        This needs perfect lenses without point spread and defocus, and no painter.
        """
        if self.painter is not None or self.optics.aperture > 0.0:
            return False
        return self.optics.psf_px == 0.0 and all(camera.distortion.is_zero for camera in cameras)

    def windows(
        self,
        sides: Sequence[Side],
        size: int,
        supersampling: int,
        sub_pixels: int | None = None,
        shade: bool = True,
    ) -> list[NDArray[np.float32]]:
        """Return the radiance (k, size, size) of each side's windows.

        ``supersampling`` is the smallest number of drawn samples per pixel and axis. ``sub_pixels``
        replaces the default number of fine pixels. The ghost is included. If ``shade`` is True, the
        windows are multiplied by the relative illumination.
        """
        windows = self._light(sides, size, supersampling, sub_pixels or self.sub_pixels)
        if self.optics.ghost > 0.0:
            offset = np.array(self.optics.ghost_offset)
            beside = [replace(s, corners=s.corners - offset) for s in sides]
            again = self._light(beside, size, supersampling, sub_pixels or self.sub_pixels)
            fraction = np.float32(self.optics.ghost)
            windows = [w + fraction * other for w, other in zip(windows, again, strict=True)]
        if shade and self.optics.vignetting > 0.0:
            windows = [
                w * self.optics.window_illumination(s.camera, s.corners, size).astype(np.float32)
                for w, s in zip(windows, sides, strict=True)
            ]
        return windows

    def _light(
        self, sides: Sequence[Side], size: int, supersampling: int, sub_pixels: int
    ) -> list[NDArray[np.float32]]:
        """Return windows without ghost and vignetting; see ``windows`` for the parameters."""
        if self.draws_pixels([side.camera for side in sides]):
            return self._drawn(
                [(s.camera.ideal, s.bodies, s.corners) for s in sides], size, supersampling
            )
        return self._formed(sides, size, supersampling, sub_pixels)

    def reached(
        self,
        camera: PinholeCamera,
        moments: Sequence[Array],
        corners: NDArray[np.int_],
        size: int,
        sub_pixels: int | None = None,
    ) -> NDArray[np.bool_]:
        """Return a mask (m, k, patches) of patches that may be visible in k windows at m moments.

        Each moment states camera_from_body (b, 4, 4). Windows have first pixels ``corners`` (k, 2).
        See ``windows`` for ``size`` and ``sub_pixels``.
        """
        reached = self._reached(camera, moments, corners, size, sub_pixels)
        if self.optics.ghost > 0.0:
            beside = corners - self.optics.ghost_offset
            reached |= self._reached(camera, moments, beside, size, sub_pixels)
        return reached

    def _reached(
        self,
        camera: PinholeCamera,
        moments: Sequence[Array],
        corners: NDArray[np.int_],
        size: int,
        sub_pixels: int | None,
    ) -> NDArray[np.bool_]:
        """Return the mask of ``reached``, without the ghost."""
        first = corners
        drawn_size = size
        if not self.draws_pixels([camera]):
            margin = self._margin_px(camera)
            fine_size = (size + 2 * margin) * (sub_pixels or self.sub_pixels)
            places = _shown_places(camera, corners, size, margin, fine_size)
            (first,), drawn_size = _drawn_parts([places])
        bounds = np.hstack([first - 0.5, first - 0.5 + drawn_size])
        return np.stack(
            [self.drawable.reaching_windows(camera.ideal, bodies, bounds) for bodies in moments]
        )

    def _drawn(
        self, sides: Sequence[tuple[PinholeCamera, Array, NDArray]], size: int, supersampling: int
    ) -> list[NDArray[np.float32]]:
        """Return windows of one size as the renderer or the painter draws them."""
        views = Views.of_sides(sides, (size, size))
        if self.painter is None:
            images = self.renderer.draw(self.drawable, views, supersampling, self.background)
        else:
            images = self.painter.draw(self.renderer, views, supersampling, self.background)
        return np.split(images, np.cumsum([len(at) for _, _, at in sides])[:-1])

    def _formed(
        self, sides: Sequence[Side], size: int, supersampling: int, sub_pixels: int
    ) -> list[NDArray[np.float32]]:
        """Return windows that are drawn finely, distorted, blurred, and averaged over pixels."""
        margin = max(self._margin_px(side.camera) for side in sides)
        fine_size = (size + 2 * margin) * sub_pixels
        nodes = [_shown_places(s.camera, s.corners, size, margin, fine_size) for s in sides]
        first, drawn_size = _drawn_parts(nodes)
        cameras = [_finer(side.camera.ideal, sub_pixels) for side in sides]
        finer = [
            (c, s.bodies, at * sub_pixels) for c, s, at in zip(cameras, sides, first, strict=True)
        ]
        drawn = self._drawn(finer, drawn_size * sub_pixels, -(-supersampling // sub_pixels))
        distorted = [
            _distorted(
                side, windows, (places - at[:, None, None] + 0.5) * sub_pixels - 0.5, fine_size
            )
            for side, windows, places, at in zip(sides, drawn, nodes, first, strict=True)
        ]
        return [
            self._blurred(side, fine, size, margin, sub_pixels)
            for side, fine in zip(sides, distorted, strict=True)
        ]

    def _blurred(
        self, side: Side, fine: NDArray[np.float32], size: int, margin: int, sub_pixels: int
    ) -> NDArray[np.float32]:
        """Return windows (k, size, size) of ``fine`` ones with margins, blurred and averaged.

        With defocus, each window has the point spread of the sticker nearest to its middle.
        """
        if self.optics.aperture == 0.0:
            response = pixel_response(self.optics.psf_px, size, margin, sub_pixels)
            return np.asarray(response @ fine @ response.T)
        middles = np.asarray(side.corners + 0.5 * (size - 1), dtype=float)
        spreads = SPREAD_STEP * np.round(self._spreads_px(side, middles) / SPREAD_STEP)
        windows = np.empty((len(fine), size, size), dtype=np.float32)
        for spread in np.unique(spreads):
            response = pixel_response(float(spread), size, margin, sub_pixels)
            own = spreads == spread
            windows[own] = response @ fine[own] @ response.T
        return windows

    def _spreads_px(self, side: Side, pixels: Array) -> Array:
        """Return standard deviations (k,) px of blur at the stickers nearest to pixels (k, 2)."""
        moves = side.bodies[self._sticker_bodies]
        points = np.einsum("nij,nj->ni", moves[:, :3, :3], self._sticker_places) + moves[:, :3, 3]
        shown = side.camera.project(points)[0]
        distances = np.linalg.norm(pixels[:, None] - shown, axis=2)
        low, high = (fraction * self.drawable.distance for fraction in DEPTHS)
        depths = np.clip(points[distances.argmin(axis=1), 2], low, high)
        return self.optics.spreads_px(side.camera.focal_px, depths)

    def reach_px(self, camera: PinholeCamera) -> int:
        """Return the largest distance, in whole px, from a point's image to light of the point."""
        ghost = max(map(abs, self.optics.ghost_offset)) if self.optics.ghost > 0.0 else 0
        return self._margin_px(camera) + ghost

    def _margin_px(self, camera: PinholeCamera) -> int:
        """Return the largest distance, in whole px, from which light outside reaches a window."""
        depths = self.drawable.distance * np.array(DEPTHS)
        return self.optics.reach_px(float(self.optics.spreads_px(camera.focal_px, depths).max()))

    @cached_property
    def _sticker_bodies(self) -> NDArray[np.int_]:
        """Index (n,) of each sticker's body."""
        stacks = [isinstance(patch, DiscStack) for patch in self.drawable.patches]
        return self.drawable.body_index[stacks]

    @cached_property
    def _sticker_places(self) -> Array:
        """Positions (n, 3) of the stickers in the axes of their bodies, m."""
        stacks = [patch for patch in self.drawable.patches if isinstance(patch, DiscStack)]
        return np.array([stack.discs[-1].centre for stack in stacks])


def _shown_places(
    camera: PinholeCamera, corners: NDArray[np.int_], size: int, margin: int, fine_size: int
) -> Array:
    """Return the ideal pixels (k, 3, 3, 2) of nodes in k windows with their margins.

    The nodes are the fine pixels in the first, middle and last row and column of a window.
    """
    half = 0.5 * (size + 2 * margin) * (1.0 - 1.0 / fine_size)
    ticks = 0.5 * (size - 1) + half * np.array([-1.0, 0.0, 1.0])
    grid = np.stack(np.meshgrid(ticks, ticks), axis=-1)
    return camera.undistort(corners[:, None, None] + grid)[0]


def _drawn_parts(nodes: Sequence[Array]) -> tuple[list[NDArray[np.int_]], int]:
    """Return the parts of ideal images that have to be drawn.

    The results are their first pixels (k, 2) for each camera, and their common size in px. Each
    part contains the ideal pixels ``nodes`` (3, 3, 2) of a window of the camera, and what
    resampling needs around them.
    """
    first = [np.floor(places.min(axis=(1, 2))).astype(int) - REACH for places in nodes]
    reach = max(
        int(np.ceil((places - at[:, None, None]).max()))
        for places, at in zip(nodes, first, strict=True)
    )
    return first, -(-(reach + REACH + 1) // SIDE_STEP) * SIDE_STEP


def _distorted(
    side: Side, drawn: NDArray[np.float32], nodes: Array, fine_size: int
) -> NDArray[np.float32]:
    """Return distorted fine windows (k, fine_size, fine_size) from drawn windows.

    ``nodes`` (k, 3, 3, 2) are those of ``resample``. Without distortion, windows are only cut out.
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
    """Return the camera with ``sub_pixels`` times as many pixels along each side."""
    return replace(
        camera,
        focal_px=camera.focal_px * sub_pixels,
        # Pixel coordinates refer to pixel centres, which move; the image corners stay in place.
        centre_x_px=(camera.centre_x_px + 0.5) * sub_pixels - 0.5,
        centre_y_px=(camera.centre_y_px + 0.5) * sub_pixels - 0.5,
        width=camera.width * sub_pixels,
        height=camera.height * sub_pixels,
    )


@lru_cache(maxsize=32)
def pixel_response(psf_px: float, size: int, margin: int, sub_pixels: int) -> NDArray[np.float32]:
    """Return the weights of drawn fine pixels in each pixel of a row.

    The weights (size, (size + 2 margin) sub_pixels) average the light over each pixel after a
    Gaussian point spread of standard deviation ``psf_px``, which is cut off at ``margin`` px. Each
    drawn fine pixel is a mean over its own width, so the average over a pixel is exact.
    """
    total = (size + 2 * margin) * sub_pixels
    into_pixels = np.kron(
        np.eye(size, size + 2 * margin, margin), np.full(sub_pixels, 1.0 / sub_pixels)
    )
    if psf_px > 0.0:
        distance = np.subtract.outer(np.arange(total), np.arange(total))
        gaussian = np.exp(-0.5 * (distance / (psf_px * sub_pixels)) ** 2) * (
            np.abs(distance) <= margin * sub_pixels
        )
        into_pixels = into_pixels @ (gaussian / gaussian[total // 2].sum())
    weights = into_pixels.astype(np.float32)
    weights.setflags(write=False)
    return weights
