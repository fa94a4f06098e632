"""Rendering of many small windows in one pass. The only module that imports pyrender.

pyrender supplies the OpenGL context, the mesh buffers, the flat shader and the four-sample frame buffer. Each window
is drawn into its own cell of one large frame buffer with its own projection, drawn larger by the supersampling factor,
and averaged in linear light. A cell draws only the patches whose bounding box reaches into it. Projection and
camera_from_body are multiplied in double precision, so that the shader sees one well-scaled matrix.
"""

from __future__ import annotations

import os
import weakref
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .errors import OpenGLMissingError
from .scene import Patch
from .views import Drawable, View

ATLAS_SIDE_PX = 2048
KEPT_FRAME_BUFFERS = 12


def render_windows(drawable: Drawable, views: Sequence[View], supersampling: int,
                   background: float = 0.0) -> NDArray[np.float32]:
    """Radiance (n, h, w) float32, 0 to 1, of n windows of one size.

    Each pixel is the mean of ``supersampling``² drawn pixels of four samples each. Raises OpenGLMissingError.
    """
    width, height = views[0].size
    cell_w, cell_h = width * supersampling, height * supersampling
    columns = max(1, min(ATLAS_SIDE_PX // cell_w, int(np.ceil(np.sqrt(len(views))))))
    per_pass = columns * max(1, ATLAS_SIDE_PX // cell_h)
    windows = []
    for first in range(0, len(views), per_pass):
        part = views[first:first + per_pass]
        rows = -(-len(part) // columns)
        atlas = _shared_atlas().draw(drawable, part, (cell_w, cell_h), columns, rows, background)
        pooled = atlas.astype(np.float32)
        if supersampling > 1:
            pooled = cv2.resize(pooled, (columns * width, rows * height), interpolation=cv2.INTER_AREA)
        cells = pooled.reshape(rows, height, columns, width).swapaxes(1, 2).reshape(-1, height, width)
        windows.append(cells[:len(part)] / np.float32(255.0))
    return np.concatenate(windows)


def require_opengl() -> None:
    """Raise OpenGLMissingError, naming the packages to install, where nothing can be rendered."""
    _shared_atlas()


@lru_cache(maxsize=1)
def _shared_atlas() -> _Atlas:
    """The one renderer of this process; making another would leak memory."""
    if not os.environ.get("DISPLAY"):
        os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    try:
        import pyrender

        return _Atlas(pyrender)
    except Exception as error:  # PyOpenGL's platform plugins fail with many types
        raise OpenGLMissingError(error) from error


class _Atlas:
    """Draws cells into pyrender's frame buffers."""

    def __init__(self, pyrender: Any) -> None:
        from OpenGL import GL
        from pyrender.renderer import Renderer

        self._gl, self._pyrender, self._renderer_class = GL, pyrender, Renderer
        self._context = pyrender.OffscreenRenderer(64, 64)
        self._flags = pyrender.RenderFlags.FLAT | pyrender.RenderFlags.OFFSCREEN
        self._frame_buffers: dict[tuple[int, int], Any] = {}
        self._primitives: weakref.WeakKeyDictionary[Drawable, list[Any]] = weakref.WeakKeyDictionary()

    def draw(self, drawable: Drawable, views: Sequence[View], cell: tuple[int, int], columns: int, rows: int,
             background: float) -> NDArray[np.uint8]:
        """The drawn atlas (rows * cell_h, columns * cell_w) uint8, cells in reading order."""
        gl, width, height = self._gl, columns * cell[0], rows * cell[1]
        self._context._platform.make_current()
        primitives = self._uploaded(drawable)
        renderer = self._frame_buffer(width, height)
        renderer._configure_forward_pass_viewport(self._flags)
        gl.glEnable(gl.GL_MULTISAMPLE)
        gl.glDisable(gl.GL_CULL_FACE)
        gl.glDisable(gl.GL_BLEND)
        gl.glClearColor(background, background, background, 1.0)
        gl.glClear(gl.GL_COLOR_BUFFER_BIT | gl.GL_DEPTH_BUFFER_BIT)
        matrix_location = self._bind_program(renderer, primitives[0])
        reaching = drawable.reaching(views)
        for k, view in enumerate(views):
            gl.glViewport((k % columns) * cell[0], (k // columns) * cell[1], *cell)
            clip_from_bodies = (view.projection() @ view.camera_from_bodies).astype(np.float32)
            body = -1
            for p in np.flatnonzero(reaching[k]):
                if drawable.body_index[p] != body:
                    body = drawable.body_index[p]
                    gl.glUniformMatrix4fv(matrix_location, 1, gl.GL_TRUE, clip_from_bodies[body])
                primitive = primitives[p]
                gl.glBindVertexArray(primitive._vaid)
                gl.glDrawElementsInstanced(gl.GL_TRIANGLES, primitive.indices.size, gl.GL_UNSIGNED_INT, None, 1)
        gl.glBindVertexArray(0)
        return self._read(renderer, width, height)

    def _uploaded(self, drawable: Drawable) -> list[Any]:
        if drawable not in self._primitives:
            self._primitives[drawable] = [self._upload(p) for p in drawable.patches]
        return self._primitives[drawable]

    def _upload(self, patch: Patch) -> Any:
        grey = np.repeat(patch.levels[:, None], 3, axis=1)
        primitive = self._pyrender.Primitive(
            positions=patch.vertices.astype(np.float32), indices=patch.faces.astype(np.uint32),
            color_0=np.column_stack([grey, np.ones(len(grey))]).astype(np.float32),
            material=self._pyrender.MetallicRoughnessMaterial(baseColorFactor=(1.0, 1.0, 1.0, 1.0)), mode=4)
        primitive._add_to_context()
        return primitive

    def _frame_buffer(self, width: int, height: int) -> Any:
        if (width, height) not in self._frame_buffers:
            if len(self._frame_buffers) >= KEPT_FRAME_BUFFERS:
                self._frame_buffers.pop(next(iter(self._frame_buffers))).delete()
            self._frame_buffers[width, height] = self._renderer_class(width, height)
        return self._frame_buffers[width, height]

    def _bind_program(self, renderer: Any, primitive: Any) -> int:
        """Binds pyrender's flat shader with all matrices identity but P; returns the place of P."""
        from pyrender.constants import ProgramFlags

        program = renderer._get_primitive_program(primitive, self._flags, ProgramFlags.USE_MATERIAL)
        program._bind()
        for name in ("V", "M"):
            program.set_uniform(name, np.eye(4))
        program.set_uniform("material.base_color_factor", np.ones(4))
        return self._gl.glGetUniformLocation(program._program_id, "P")

    def _read(self, renderer: Any, width: int, height: int) -> NDArray[np.uint8]:
        """Resolves the four samples and reads the red channel only."""
        gl = self._gl
        gl.glBindFramebuffer(gl.GL_READ_FRAMEBUFFER, renderer._main_fb_ms)
        gl.glBindFramebuffer(gl.GL_DRAW_FRAMEBUFFER, renderer._main_fb)
        gl.glBlitFramebuffer(0, 0, width, height, 0, 0, width, height, gl.GL_COLOR_BUFFER_BIT, gl.GL_LINEAR)
        gl.glBindFramebuffer(gl.GL_READ_FRAMEBUFFER, renderer._main_fb)
        gl.glPixelStorei(gl.GL_PACK_ALIGNMENT, 1)
        pixels = gl.glReadPixels(0, 0, width, height, gl.GL_RED, gl.GL_UNSIGNED_BYTE)
        return np.frombuffer(pixels, dtype=np.uint8).reshape(height, width)
