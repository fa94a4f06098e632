"""The contract of all renderers: what is to be drawn, what comes back, and which renderer draws.

A renderer draws windows of cameras with perfect lenses, of the patches that reach into each of
them.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cmmsim.allowed_plugins import AUTO, RENDERERS, find
from cmmsim.checks import finite_array
from cmmsim.errors import CmmError, OpenGLMissingError
from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import Array
from cmmsim.imaging.scene_bodies import Patch
from cmmsim.imaging.views import NEAR, View, Views

_WARNED: dict[
    str | tuple[str, type[Warning], int], int
] = {}  # what this process has said once is not said again


class Drawable:
    """Patches of several bodies: which body each belongs to, the corners of its bounding box as
    columns (n,4,8), m and 1, and the distance m from which they are usually looked at, for which
    discs are triangulated."""

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
        """Mask (n views, n patches) of those that may show in each window, by bounding boxes."""
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
        """Mask of the patches that may show in each window (n windows, n patches) of one camera
        with a perfect lens.

        Parameters: camera_from_bodies (b,4,4); bounds (n,4): lowest x, y and highest x, y, px.
        """
        from cmmsim.imaging.window_kernels import (
            boxes_reaching,
        )  # compiles, so it is loaded where it is first needed

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
    """Radiance (n, h, w) float32, 0 to 1, of n views of one size; row 0 is a window's top row."""

    def __call__(
        self, drawable: Drawable, views: Sequence[View], supersampling: int, background: float = 0.0
    ) -> NDArray[np.float32]:
        """Draw; supersampling: how finely edges are sampled within a pixel."""


@dataclass(frozen=True)
class Renderer:
    """name; draw; sampling_error_px: rms error of a sticker's centre at supersampling 9, see
    ``centre_error_px``.
    """

    name: str
    draw: DrawWindows
    sampling_error_px: float = 0.0

    def centre_error_px(self, supersampling: int) -> float:
        """Error of a sticker's centre that sampling leaves, px rms.

        Measured with pyrender: 0.0041 at 3, 0.000069 at 32.
        """
        return self.sampling_error_px * (9.0 / supersampling) ** 1.7


def choose_renderer(name: str) -> Renderer:
    """The renderer of that name; "auto" is pyrender where OpenGL works, else analytic with one line
    of warning.

    ``module:name`` of one's own is a Renderer, or a function as ``DrawWindows`` describes, which
    may carry its ``sampling_error_px``. Raises UnknownOptionError with the valid names, CmmError
    for what cannot be imported or called.
    """
    if name == AUTO:
        from cmmsim.imaging.pyrender_renderer import require_opengl  # which imports this module

        try:
            require_opengl()
        except OpenGLMissingError as error:
            reason = " ".join(str(error.__cause__ or error).split())
            text = f"images are drawn by the analytic renderer, pyrender found no OpenGL: {reason}"
            # a place without source: one line
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
    """Raise CmmError unless a renderer of a user's own has returned what it should."""
    width, height = views[0].size
    shape = (len(views), height, width)
    wanted = f"{part} must return finite radiance {shape}"
    if not isinstance(found, np.ndarray) or found.dtype.kind != "f":
        raise CmmError(f"{wanted} of float32, got {type(found).__name__}")
    finite_array(found, shape, wanted)
