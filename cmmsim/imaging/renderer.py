"""The two renderers behind one contract, and which of them draws."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cmmsim.errors import OpenGLMissingError, UnknownOptionError
from cmmsim.imaging import analytic
from cmmsim.imaging import pyrender_renderer as render
from cmmsim.imaging.views import Drawable, View

RENDERER_NAMES = ("analytic", "auto", "pyrender")
_WARNED: dict[str | tuple[str, type[Warning], int], int] = {}  # what this process has said once is not said again


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
    sampling_error_px: float

    def centre_error_px(self, supersampling: int) -> float:
        """What sampling leaves in a sticker's centre, px rms; pyrender: measured 0.0041 at 3, 0.000069 at 32."""
        return self.sampling_error_px * (9.0 / supersampling) ** 1.7


PYRENDER = Renderer("pyrender", render.render_windows, 0.00058)
ANALYTIC = Renderer("analytic", analytic.draw_windows, 0.0)


def choose_renderer(name: str) -> Renderer:
    """The renderer of that name; "auto" is pyrender where OpenGL works, else analytic with one line of warning.

    Raises UnknownOptionError.
    """
    if name not in RENDERER_NAMES:
        raise UnknownOptionError("renderer", name, RENDERER_NAMES)
    if name == "auto":
        try:
            render.require_opengl()
        except OpenGLMissingError as error:
            reason = " ".join(str(error.__cause__ or error).split())
            text = f"images are drawn by the analytic renderer, pyrender found no OpenGL: {reason}"
            warnings.warn_explicit(text, UserWarning, __name__, 0, registry=_WARNED)  # a place without source: one line
            return ANALYTIC
    return ANALYTIC if name == "analytic" else PYRENDER
