"""The contract of all renderers: what is to be drawn, what comes back, and which renderer draws.

A renderer draws windows of cameras with perfect lenses, of the patches that reach into each of them.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cmmsim.errors import OpenGLMissingError
from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import Array
from cmmsim.imaging.scene import Patch
from cmmsim.imaging.views import NEAR, View, Views
from cmmsim.plugins import AUTO, RENDERERS, find

_WARNED: dict[str | tuple[str, type[Warning], int], int] = {}  # what this process has said once is not said again


class Drawable:
    """Patches of several bodies: which body each belongs to, the corners of its bounding box as columns (n,4,8), m and
    1, and the distance m from which they are usually looked at, for which discs are triangulated."""

    def __init__(self, patches: Sequence[Patch], body_index: Sequence[int], distance: float) -> None:
        self.patches = tuple(patches)
        self.body_index = np.array(body_index, dtype=int)
        self.boxes = np.array([[*zip(*product(*p.bounds.T), strict=True), np.ones(8)] for p in patches])
        self.distance = distance

    def reaching(self, views: Views) -> NDArray[np.bool_]:
        """Which patches may show in each window (n views, n patches): bounding boxes against windows."""
        windows, result = views.bounds, np.zeros((len(views), len(self.patches)), dtype=bool)
        for shown in views.exposures:
            result[shown.windows] = self.reaching_windows(
                shown.camera, shown.camera_from_bodies, windows[shown.windows]
            )
        return result

    def reaching_windows(self, camera: PinholeCamera, camera_from_bodies: Array, bounds: Array) -> NDArray[np.bool_]:
        """Which patches may show in each window (n windows, n patches) of one camera with a perfect lens.

        Parameters: camera_from_bodies (b,4,4); bounds (n,4): lowest x, y and highest x, y, px.
        """
        from cmmsim.imaging.window_kernels import boxes_reaching  # compiles, so it is loaded where it is first needed

        reaching = np.empty((len(bounds), len(self.patches)), dtype=bool)
        boxes_reaching(camera.matrix @ camera_from_bodies[:, :3], self.body_index, self.boxes, bounds, NEAR, reaching)
        return reaching


class DrawWindows(Protocol):
    """Radiance (n, h, w) float32, 0 to 1, of n views of one size; row 0 is a window's top row."""

    def __call__(
        self, drawable: Drawable, views: Sequence[View], supersampling: int, background: float = 0.0
    ) -> NDArray[np.float32]:
        """Draw; supersampling: how finely edges are sampled within a pixel."""


@dataclass(frozen=True)
class Renderer:
    """name; draw; sampling_error_px: rms error of a sticker's centre at supersampling 9, see ``centre_error_px``."""

    name: str
    draw: DrawWindows
    sampling_error_px: float = 0.0

    def centre_error_px(self, supersampling: int) -> float:
        """What sampling leaves in a sticker's centre, px rms; pyrender: measured 0.0041 at 3, 0.000069 at 32."""
        return self.sampling_error_px * (9.0 / supersampling) ** 1.7


def choose_renderer(name: str) -> Renderer:
    """The renderer of that name; "auto" is pyrender where OpenGL works, else analytic with one line of warning.

    ``module:name`` of one's own is a Renderer, or a function as ``DrawWindows`` describes, which may carry its
    ``sampling_error_px``. Raises UnknownOptionError with the valid names, CmmError for what cannot be imported or
    called.
    """
    if name == AUTO:
        from cmmsim.imaging.pyrender_renderer import require_opengl  # which imports this module

        try:
            require_opengl()
        except OpenGLMissingError as error:
            reason = " ".join(str(error.__cause__ or error).split())
            text = f"images are drawn by the analytic renderer, pyrender found no OpenGL: {reason}"
            warnings.warn_explicit(text, UserWarning, __name__, 0, registry=_WARNED)  # a place without source: one line
            return _renderer("analytic")
        return _renderer("pyrender")
    return _renderer(name)


@lru_cache
def _renderer(name: str) -> Renderer:
    return find("renderer", name, RENDERERS, Renderer)
