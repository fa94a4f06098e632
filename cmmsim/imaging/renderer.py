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
from cmmsim.plugins import AUTO, RENDERERS, find

NEAR, FAR = 0.2, 10.0  # m
_WARNED: dict[str | tuple[str, type[Warning], int], int] = {}  # what this process has said once is not said again


@dataclass(frozen=True)
class View:
    """One window of a camera with a perfect lens: camera_from_body transforms (b,4,4), its first pixel (x, y) and its
    size (w, h) px."""

    camera: PinholeCamera
    camera_from_bodies: Array
    corner: tuple[float, float]
    size: tuple[int, int]


def projections(views: Sequence[View]) -> Array:
    """Clip-from-camera matrices (n,4,4) for OpenCV camera axes; row 0 of a drawing is the window's top row.

    The half pixel turns OpenCV's pixel-centre convention into OpenGL's pixel-corner convention.
    """
    principal = np.array([v.camera.centre for v in views]) + 0.5 - np.array([v.corner for v in views])
    focal, size = np.array([v.camera.focal_lengths for v in views]), np.array([v.size for v in views])
    matrices = np.zeros((len(views), 4, 4))
    for i in range(2):
        matrices[:, i, i], matrices[:, i, 2] = 2.0 * focal[:, i] / size[:, i], 2.0 * principal[:, i] / size[:, i] - 1.0
    matrices[:, 2, 2], matrices[:, 2, 3] = (FAR + NEAR) / (FAR - NEAR), -2.0 * FAR * NEAR / (FAR - NEAR)
    matrices[:, 3, 2] = 1.0
    return matrices


def window_bounds(views: Sequence[View]) -> Array:
    """Lowest x, y and highest x, y (n,4) of windows, px: the outer edges of their first and last pixels."""
    first = np.array([view.corner for view in views]) - 0.5
    return np.hstack([first, first + np.array([view.size for view in views])])


def same_exposure(views: Sequence[View]) -> list[list[int]]:
    """Indices of the views, grouped by camera and exposure."""
    groups: dict[tuple[int, int], list[int]] = {}
    for k, view in enumerate(views):
        groups.setdefault((id(view.camera), id(view.camera_from_bodies)), []).append(k)
    return list(groups.values())


class Drawable:
    """Patches of several bodies: which body each belongs to, the corners of its bounding box as columns (n,4,8), m and
    1, and the distance m from which they are usually looked at, for which discs are triangulated."""

    def __init__(self, patches: Sequence[Patch], body_index: Sequence[int], distance: float) -> None:
        self.patches = tuple(patches)
        self.body_index = np.array(body_index, dtype=int)
        self.boxes = np.array([[*zip(*product(*p.bounds.T), strict=True), np.ones(8)] for p in patches])
        self.distance = distance

    def reaching(self, views: Sequence[View], groups: Sequence[NDArray[np.int_]]) -> NDArray[np.bool_]:
        """Which patches may show in each window (n views, n patches): bounding boxes against windows.

        ``groups``: indices of the views of each camera and exposure.
        """
        windows, result = window_bounds(views), np.zeros((len(views), len(self.patches)), dtype=bool)
        for group in groups:
            view = views[group[0]]
            result[group] = self.reaching_windows(view.camera, view.camera_from_bodies, windows[group])
        return result

    def reaching_windows(self, camera: PinholeCamera, camera_from_bodies: Array, bounds: Array) -> NDArray[np.bool_]:
        """Which patches may show in each window (n windows, n patches) of one camera with a perfect lens.

        Parameters: camera_from_bodies (b,4,4); bounds (n,4): lowest x, y and highest x, y, px.
        """
        from cmmsim.imaging.kernels import boxes_reaching  # compiles, so it is loaded where it is first needed

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
