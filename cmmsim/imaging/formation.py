"""Image formation from posed bodies to the light on each pixel, before noise.

Windows are drawn through perfect lenses on a grid finer than the pixels. A margin around each
window supplies the light that the point spread brings in from outside. Distortion resamples each
fine pixel from its ideal place. Then the point spread, the mean over each pixel, and the relative
illumination are applied. All steps are linear in light. For a perfect lens without point spread,
the pixels are drawn directly.

The ideal place of each pixel is exact at three by three nodes of a window, and interpolated by
quadratics in between. In windows of some tens of pixels, the interpolation error is below 1e-4 px.
Values between drawn pixels come from Keys' cubic convolution. It reproduces quadratics, so it
neither moves nor widens edges. Source: R. G. Keys, Cubic convolution interpolation for digital
image processing, IEEE Trans. ASSP 29 (1981).

A whole image is drawn finely only around bright spots. Most of the scene stands still during an
exposure. A window without any body is filled with the background, and a window without a moving
body is drawn only once.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.camera import Optics, PinholeCamera
from cmmsim.geometry.pose import Array, frozen
from cmmsim.imaging.renderer import Drawable, Renderer, View, Views

# Matrix that maps the values of a quadratic at -1, 0 and 1 to its coefficients.
_QUADRATIC = frozen([[0.0, 1.0, 0.0], [-0.5, 0.0, 0.5], [0.5, -1.0, 0.5]])
# Fine pixels along each side of a pixel. The point spread smooths the errors of resampling; without
# a point spread, sharp edges need more fine pixels.
SUB_PIXELS = 6
SHARP_SUB_PIXELS = 12
# px: sides of drawn windows are multiples of this, so that few sizes of frame buffers are needed.
SIDE_STEP = 4
# Number of drawn pixels that the cubic needs on either side.
REACH = 2
# px: side of the finely drawn window around a bright spot.
PASTED_SIZE = 24
# px: largest side of a finely drawn window; larger spots are drawn coarsely.
LARGEST_PASTED_SIZE = 96
# px: margin that is drawn finely around a large spot.
DARK_RIM = 8
# Radiance above which a spot is drawn finely.
BRIGHT = 0.4
# px: side of the pieces in which a whole image is distorted and blurred.
TILE = 64
# Number of drawn samples per pixel and axis away from bright spots.
COARSE = 2


def resample(drawn: NDArray[np.float32], nodes: Array, size: int) -> NDArray[np.float32]:
    """Return windows (n, size, size) that are resampled from drawn windows (n, h, w).

    ``nodes`` (n, 3, 3, 2) are the places (x, y) in the drawn window of the pixels in the first,
    middle and last row and column.
    """
    # Imported late, because importing numba takes time.
    from cmmsim.imaging.window_kernels import resample_windows

    coefficients = np.einsum("ar,bc,nrcx->nabx", _QUADRATIC, _QUADRATIC, nodes)
    result = np.empty((len(drawn), size, size), dtype=np.float32)
    resample_windows(np.ascontiguousarray(drawn), coefficients, result)
    return result


@dataclass(frozen=True)
class Side:
    """Camera with camera_from_body transforms (b, 4, 4) and the first pixels (k, 2) of windows."""

    camera: PinholeCamera
    bodies: Array
    corners: NDArray[np.int_]


@dataclass(frozen=True)
class ImageFormation:
    """Image formation by a renderer, with the drawn bodies, the radiance of the background, and the
    optics of the lenses.
    """

    renderer: Renderer
    drawable: Drawable
    background: float
    optics: Optics

    def centre_error_px(self, cameras: Sequence[PinholeCamera], supersampling: int) -> float:
        """Return the error of a sticker's centre due to drawing with ``supersampling``, px rms."""
        fine = 1 if self.draws_pixels(cameras) else self.sub_pixels
        return self.renderer.centre_error_px(-(-supersampling // fine) * fine)

    @property
    def sub_pixels(self) -> int:
        """Number of fine pixels along each side of a pixel."""
        return SHARP_SUB_PIXELS if self.optics.psf_px == 0.0 else SUB_PIXELS

    def draws_pixels(self, cameras: Sequence[PinholeCamera]) -> bool:
        """Tell whether images are drawn directly on their pixels, without a finer grid."""
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
        replaces the default number of fine pixels. If ``shade`` is True, the windows are multiplied
        by the relative illumination.
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
        """Return a mask (m, k, patches) of the patches that could be visible in k windows at m
        moments.

        Each moment states camera_from_body (b, 4, 4). Windows have first pixels ``corners`` (k, 2).
        See ``windows`` for ``size`` and ``sub_pixels``.
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
        """Return windows of one size as the renderer draws them."""
        images = self.renderer.draw(
            self.drawable, Views.of_sides(sides, (size, size)), supersampling, self.background
        )
        return np.split(images, np.cumsum([len(at) for _, _, at in sides])[:-1])

    def _formed(
        self, sides: Sequence[Side], size: int, supersampling: int, sub_pixels: int
    ) -> list[NDArray[np.float32]]:
        """Return windows that are drawn finely, distorted, blurred and averaged over pixels."""
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
        distorted = [
            _distorted(
                side, windows, (places - at[:, None, None] + 0.5) * sub_pixels - 0.5, fine_size
            )
            for side, windows, places, at in zip(sides, drawn, nodes, first, strict=True)
        ]
        return [np.asarray(response @ fine @ response.T) for fine in distorted]


def _shown_places(
    camera: PinholeCamera, corners: NDArray[np.int_], size: int, margin: int, fine_size: int
) -> Array:
    """Return the ideal places (k, 3, 3, 2) of nodes in k windows with their margins.

    The nodes are the fine pixels in the first, middle and last row and column of a window.
    """
    half = 0.5 * (size + 2 * margin) * (1.0 - 1.0 / fine_size)
    ticks = 0.5 * (size - 1) + half * np.array([-1.0, 0.0, 1.0])
    grid = np.stack(np.meshgrid(ticks, ticks), axis=-1)
    return camera.undistort(corners[:, None, None] + grid)[0]


def _drawn_parts(nodes: Sequence[Array]) -> tuple[list[NDArray[np.int_]], int]:
    """Return the parts of ideal images that have to be drawn.

    The results are their first pixels (k, 2) for each camera, and their common size in px. The
    parts contain the places ``nodes`` (k, 3, 3, 2) of each camera.
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
    """Return distorted fine windows (k, fine_size, fine_size).

    For a lens without distortion, the windows are only cut out.
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
    """Return the weights of drawn sub-pixels in each pixel of a row.

    The weights (size, (size + 2 margin) sub_pixels) average a Gaussian of standard deviation
    ``psf_px`` over each pixel. Each drawn sub-pixel is a mean over its own width, so the sum over
    sub-pixels is the exact mean over a pixel.
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


def exposed_windows(
    formation: ImageFormation,
    camera: PinholeCamera,
    moments: Sequence[Array],
    corners: NDArray[np.int_],
    size: int,
    supersampling: int,
    sub_pixels: int | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the mean and the largest radiance (k, size, size) of windows over several moments.

    Each moment states camera_from_body (b, 4, 4). Windows have first pixels ``corners`` (k, 2). The
    result has no vignetting. See ``ImageFormation.windows`` for ``supersampling`` and
    ``sub_pixels``.
    """
    reached = formation.reached(camera, moments, corners, size, sub_pixels)
    # Mask of the patches whose bodies move.
    moves = np.ptp(np.stack(moments), axis=0).any(axis=(1, 2))[formation.drawable.body_index]
    drawn_often = np.asarray(reached[:, :, moves].any(axis=(0, 2)))
    drawn_once = np.asarray(reached.any(axis=(0, 2))) & ~drawn_often

    def draw(bodies: Array, which: NDArray[np.bool_]) -> NDArray[np.float32]:
        if not which.any():
            return np.empty((0, size, size), dtype=np.float32)
        sides = [Side(camera, bodies, corners[which])]
        return formation.windows(sides, size, supersampling, sub_pixels, shade=False)[0]

    mean = np.full((len(corners), size, size), formation.background, dtype=np.float32)
    mean[drawn_once] = draw(moments[0], drawn_once)
    total = draw(moments[0], drawn_often)
    largest = total.copy()
    for bodies in moments[1:]:
        window = draw(bodies, drawn_often)
        total += window
        np.maximum(largest, window, out=largest)
    brightest = mean.copy()
    mean[drawn_often] = total / np.float32(len(moments))
    brightest[drawn_often] = largest
    return mean, brightest


def whole_image(
    formation: ImageFormation, camera: PinholeCamera, moments: Sequence[Array], supersampling: int
) -> NDArray[np.float32]:
    """Return the mean radiance (height, width) of one camera's image over several moments.

    Each moment states camera_from_body (b, 4, 4). The image is drawn coarsely, except for finely
    drawn windows around bright spots.
    """
    image, bright = _coarse(formation, camera, moments)
    corners, size = _spots(
        bright, fixed_size=len(moments) == 1 and formation.draws_pixels([camera])
    )
    if len(corners):
        fine = exposed_windows(formation, camera, moments, corners, size, supersampling)[0]
        for (x, y), window in zip(corners, fine, strict=True):
            image[y : y + size, x : x + size] = window
    if formation.optics.vignetting == 0.0:
        return image
    pixels = np.stack(
        np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height))), axis=-1
    )
    return image * formation.optics.illumination(camera, pixels).astype(np.float32)


def _coarse(
    formation: ImageFormation, camera: PinholeCamera, moments: Sequence[Array]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the mean radiance (height, width), drawn with COARSE² samples per pixel.

    The second result is a mask of the pixels that are bright at one moment at least.
    """
    if len(moments) == 1 and formation.draws_pixels([camera]):
        view = View(camera.ideal, moments[0], (0, 0), (camera.width, camera.height))
        image = formation.renderer.draw(formation.drawable, [view], COARSE, formation.background)[0]
        return image, image > BRIGHT
    rows = -(-camera.height // TILE)
    columns = -(-camera.width // TILE)
    x, y = np.meshgrid(TILE * np.arange(columns), TILE * np.arange(rows))
    corners = np.column_stack([x.ravel(), y.ravel()])
    mean, brightest = (
        tiles.reshape(rows, columns, TILE, TILE)
        .swapaxes(1, 2)
        .reshape(rows * TILE, columns * TILE)[: camera.height, : camera.width]
        for tiles in exposed_windows(
            formation, camera, moments, corners, TILE, COARSE, sub_pixels=1
        )
    )
    return mean, brightest > BRIGHT


def _spots(bright: NDArray[np.bool_], fixed_size: bool) -> tuple[NDArray[np.int_], int]:
    """Return the first pixels (k, 2) of the windows around bright spots, and their side in px."""
    _, _, stats, centres = cv2.connectedComponentsWithStats(bright.astype(np.uint8))
    keep = np.isfinite(centres[1:]).all(axis=1)
    sides = stats[1:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1)
    size = PASTED_SIZE
    if not fixed_size:
        keep &= sides <= LARGEST_PASTED_SIZE - 2 * DARK_RIM
        size = max(size, int(sides[keep].max(initial=0)) + 2 * DARK_RIM)
    size = min(size, *bright.shape)
    highest = np.array(bright.shape[::-1]) - size
    return np.clip(np.rint(centres[1:][keep]).astype(int) - size // 2, 0, highest), size
