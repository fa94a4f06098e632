"""Interface of all renderers, their input, and the choice of a renderer by name.

A renderer draws windows of cameras with perfect lenses. A patch is a piece of a body. In each
window, the patches that reach into the window are drawn.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import Protocol, overload

import numpy as np
from numpy.typing import NDArray

from cmmsim.allowed_plugins import AUTO, RENDERERS, find
from cmmsim.checks import finite_array
from cmmsim.errors import CmmError, OpenGLMissingError
from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import Array
from cmmsim.imaging.scene_bodies import Patch

# m: what has a smaller or a larger depth than these need not be drawn.
NEAR = 0.2
FAR = 10.0


@dataclass(frozen=True)
class View:
    """One window of a camera with a perfect lens.

    ``camera_from_bodies`` are the transforms camera_from_body (b, 4, 4). ``corner`` is the window's
    first pixel (x, y), and ``size`` its size (w, h), px.
    """

    camera: PinholeCamera
    camera_from_bodies: Array
    corner: tuple[float, float]
    size: tuple[int, int]


@dataclass(frozen=True)
class Exposure:
    """Camera with a perfect lens that sees bodies at camera_from_body (b, 4, 4).

    ``windows`` (k,) are the indices of the windows that belong to this camera and these transforms.
    """

    camera: PinholeCamera
    camera_from_bodies: Array
    windows: NDArray[np.int_]


class Views(Sequence[View]):
    """Windows of one size (w, h) px with first pixels ``corners`` (n, 2), grouped by exposure."""

    def __init__(
        self, exposures: Sequence[Exposure], corners: Array, size: tuple[int, int]
    ) -> None:
        self.exposures = tuple(exposures)
        self.corners = corners
        self.size = size

    @classmethod
    def of(cls, views: Sequence[View]) -> Views:
        """Group single windows by camera and transforms of bodies.

        Windows form a group if their camera and their transforms are the very same objects.
        """
        if isinstance(views, Views):
            return views
        groups: dict[tuple[int, int], list[int]] = {}
        for k, view in enumerate(views):
            groups.setdefault((id(view.camera), id(view.camera_from_bodies)), []).append(k)
        shown = [
            Exposure(views[group[0]].camera, views[group[0]].camera_from_bodies, np.array(group))
            for group in groups.values()
        ]
        return cls(
            shown,
            np.array([view.corner for view in views], dtype=float).reshape(-1, 2),
            views[0].size,
        )

    @classmethod
    def of_sides(
        cls, sides: Sequence[tuple[PinholeCamera, Array, NDArray]], size: tuple[int, int]
    ) -> Views:
        """Return the windows of several cameras, one camera after the other.

        Each side is a camera, its camera_from_body (b, 4, 4), and the first pixels (k, 2) of its
        windows.
        """
        starts = np.cumsum([0, *(len(corners) for _, _, corners in sides)])
        shown = [
            Exposure(camera, bodies, np.arange(start, start + len(corners)))
            for (camera, bodies, corners), start in zip(sides, starts, strict=False)
            if len(corners)
        ]
        return cls(shown, np.concatenate([corners for _, _, corners in sides]), size)

    def __len__(self) -> int:
        return len(self.corners)

    @overload
    def __getitem__(self, index: int) -> View: ...
    @overload
    def __getitem__(self, index: slice) -> Views: ...
    def __getitem__(self, index: int | slice) -> View | Views:
        if isinstance(index, slice):
            start, stop, _ = index.indices(len(self))
            parts = [
                Exposure(
                    e.camera,
                    e.camera_from_bodies,
                    e.windows[(e.windows >= start) & (e.windows < stop)] - start,
                )
                for e in self.exposures
            ]
            return Views(
                [part for part in parts if len(part.windows)], self.corners[start:stop], self.size
            )
        place = range(len(self))[index]
        shown = next(e for e in self.exposures if place in e.windows)
        x, y = self.corners[place].tolist()
        return View(shown.camera, shown.camera_from_bodies, (x, y), self.size)

    @property
    def bounds(self) -> Array:
        """Lowest x, y and highest x, y (n, 4) of the windows, at the outer edges of pixels, px."""
        return np.hstack([self.corners - 0.5, self.corners - 0.5 + self.size])

    @property
    def projections(self) -> Array:
        """Clip-from-camera matrices (n, 4, 4) for OpenCV camera axes.

        Row 0 of a drawn image is the top row of a window. OpenCV's pixel coordinates refer to pixel
        centres, OpenGL's to pixel corners, so half a pixel is added.
        """
        matrices = np.zeros((len(self), 4, 4))
        for shown in self.exposures:
            principal = shown.camera.centre + 0.5 - self.corners[shown.windows]
            for i in range(2):
                matrices[shown.windows, i, i] = 2.0 * shown.camera.focal_lengths[i] / self.size[i]
                matrices[shown.windows, i, 2] = 2.0 * principal[:, i] / self.size[i] - 1.0
        matrices[:, 2, 2] = (FAR + NEAR) / (FAR - NEAR)
        matrices[:, 2, 3] = -2.0 * FAR * NEAR / (FAR - NEAR)
        matrices[:, 3, 2] = 1.0
        return matrices

    def clip_from_bodies(self) -> Array:
        """Return the clip-from-body matrices (n, b, 4, 4) of the windows."""
        projections = self.projections
        matrices = np.empty((len(self), len(self.exposures[0].camera_from_bodies), 4, 4))
        for shown in self.exposures:
            matrices[shown.windows] = projections[shown.windows, None] @ shown.camera_from_bodies
        return matrices


# Warnings that were issued in this process. They are not repeated.
_WARNED: dict[str | tuple[str, type[Warning], int], int] = {}


class Drawable:
    """Patches of several bodies.

    ``body_index`` (n,) is the index of each patch's body. ``boxes`` (n, 4, 8) are the corners of
    each patch's bounding box as columns (x, y, z in m, 1). ``distance`` in m is the usual distance
    from the cameras, for which discs are triangulated.
    """

    def __init__(
        self, patches: Sequence[Patch], body_index: Sequence[int], distance: float
    ) -> None:
        self.patches = tuple(patches)
        self.body_index = np.array(body_index, dtype=int)
        self.boxes = np.array(
            [[*zip(*product(*p.bounds.T), strict=True), np.ones(8)] for p in patches]
        )
        self.distance = distance

    def reaching(self, views: Views) -> NDArray[np.bool_]:
        """Return a mask (views, patches) of the windows into which a bounding box reaches."""
        windows = views.bounds
        result = np.zeros((len(views), len(self.patches)), dtype=bool)
        for shown in views.exposures:
            result[shown.windows] = self.reaching_windows(
                shown.camera, shown.camera_from_bodies, windows[shown.windows]
            )
        return result

    def reaching_windows(
        self, camera: PinholeCamera, camera_from_bodies: Array, bounds: Array
    ) -> NDArray[np.bool_]:
        """Return a mask (windows, patches), as in ``reaching``.

        All windows belong to one camera with a perfect lens. ``camera_from_bodies`` are the
        transforms camera_from_body (b, 4, 4). ``bounds`` (n, 4) are lowest x, y and highest x, y of
        the windows, px.
        """
        # Imported late, because importing numba takes time.
        from cmmsim.imaging.window_kernels import boxes_reaching

        reaching = np.empty((len(bounds), len(self.patches)), dtype=bool)
        boxes_reaching(
            camera.matrix @ camera_from_bodies[:, :3],
            self.body_index,
            self.boxes,
            bounds,
            NEAR,
            reaching,
        )
        return reaching


class DrawWindows(Protocol):
    """Function that draws the radiance (n, h, w) float32, 0 to 1, of n views of one size.

    Row 0 is the top row of a window. Where no patch is seen, the radiance is ``background``.
    """

    def __call__(
        self, drawable: Drawable, views: Sequence[View], supersampling: int, background: float = 0.0
    ) -> NDArray[np.float32]:
        """Draw the views with about ``supersampling`` samples per pixel and axis at edges."""


@dataclass(frozen=True)
class Renderer:
    """Renderer with its name and its drawing function.

    ``sampling_error_px`` is the rms error of a sticker's centre at supersampling 9.
    """

    name: str
    draw: DrawWindows
    sampling_error_px: float = 0.0

    def centre_error_px(self, supersampling: int) -> float:
        """Return the error of a sticker's centre due to sampling, px rms.

        The exponent fits errors measured with pyrender: 0.0041 px at supersampling 3, and 0.000069
        px at 32.
        """
        return self.sampling_error_px * (9.0 / supersampling) ** 1.7


def choose_renderer(name: str) -> Renderer:
    """Return the renderer with a name.

    "auto" selects pyrender if OpenGL works, and otherwise analytic, with a warning of one line.
    ``module:name`` is a user's own Renderer, or a function as described by ``DrawWindows``. Such a
    function can have an attribute ``sampling_error_px``. Raises UnknownOptionError, which lists the
    valid names, and CmmError if a user's own renderer cannot be imported or called.
    """
    if name == AUTO:
        # Imported here, because that module imports this one.
        from cmmsim.imaging.pyrender_renderer import require_opengl

        try:
            require_opengl()
        except OpenGLMissingError as error:
            reason = " ".join(str(error.__cause__ or error).split())
            text = (
                "images are drawn by the analytic renderer, because pyrender found no OpenGL: "
                f"{reason}"
            )
            # With line 0, Python cannot add a source line, so the warning is one line.
            warnings.warn_explicit(text, UserWarning, __name__, 0, registry=_WARNED)
            return _renderer("analytic")
        return _renderer("pyrender")
    return _renderer(name)


@lru_cache
def _renderer(name: str) -> Renderer:
    return find("renderer", name, RENDERERS, Renderer, _check_images)


def _check_images(
    part: str, found: object, drawable: Drawable, views: Sequence[View], *_: object
) -> None:
    """Raise CmmError unless a user's own renderer returned finite radiance of the right shape."""
    width, height = views[0].size
    shape = (len(views), height, width)
    wanted = f"{part} must return finite radiance {shape}"
    if not isinstance(found, np.ndarray) or found.dtype.kind != "f":
        got = getattr(found, "dtype", type(found).__name__)
        raise CmmError(f"{wanted} of floats, got {got}")
    finite_array(found, shape, wanted)
