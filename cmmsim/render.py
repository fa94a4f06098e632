"""Rendering of many small windows in one pass. The only module that imports pyrender.

pyrender supplies the OpenGL context, the mesh buffers and the flat shader; the frame buffers hold one channel only,
which draws faster than pyrender's four. Each window is drawn into its own cell of one large frame buffer with its own
projection, drawn larger by the supersampling factor, and averaged in linear light. Every drawn pixel has one sample:
several of pyrender's multisampling cost more than they gain on the stickers' soft rims. A cell draws only the patches
whose bounding box reaches into it. Projection and camera_from_body are multiplied in double precision, so that the
shader sees one well-scaled matrix.
"""

from __future__ import annotations

import os
import weakref
from collections.abc import Sequence
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .disc_mesh import disc_mesh
from .errors import CmmError, OpenGLMissingError
from .scene import DiscStack, Mesh
from .views import Drawable, View

ATLAS_SIDE_PX = 2048
KEPT_FRAME_BUFFERS = 12


def render_windows(drawable: Drawable, views: Sequence[View], supersampling: int,
                   background: float = 0.0) -> NDArray[np.float32]:
    """Radiance (n, h, w) float32, 0 to 1, of n windows of one size.

    Each pixel is the mean of ``supersampling``² drawn pixels of one sample each. Raises OpenGLMissingError.
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
        from OpenGL.raw.GL.VERSION import GL_1_0, GL_1_1, GL_2_0, GL_3_0  # without the conversion of arguments
        from pyrender.renderer import Renderer

        self._gl, self._pyrender = GL, pyrender
        self._viewport, self._draw_elements = GL_1_0.glViewport, GL_1_1.glDrawElements
        self._set_matrix, self._bind_mesh = GL_2_0.glUniformMatrix4fv, GL_3_0.glBindVertexArray
        self._context = pyrender.OffscreenRenderer(64, 64)
        self._shaders = Renderer(64, 64)
        self._flags = pyrender.RenderFlags.FLAT | pyrender.RenderFlags.OFFSCREEN
        self._frame_buffers: dict[tuple[int, int], _FrameBuffer] = {}
        self._uploaded: weakref.WeakKeyDictionary[Drawable, dict[float, list[Any]]] = weakref.WeakKeyDictionary()

    def draw(self, drawable: Drawable, views: Sequence[View], cell: tuple[int, int], columns: int, rows: int,
             background: float) -> NDArray[np.uint8]:
        """The drawn atlas (rows * cell_h, columns * cell_w) uint8, cells in reading order."""
        gl, width, height = self._gl, columns * cell[0], rows * cell[1]
        self._context._platform.make_current()
        primitives = self._primitives(drawable, views[0].camera.focal_px * cell[0] / views[0].size[0])
        frame_buffer = self._frame_buffer(width, height)
        frame_buffer.bind()
        gl.glEnable(gl.GL_DEPTH_TEST)
        gl.glDepthFunc(gl.GL_LESS)
        gl.glDisable(gl.GL_CULL_FACE)
        gl.glDisable(gl.GL_BLEND)
        gl.glClearColor(background, background, background, 1.0)
        gl.glClear(gl.GL_COLOR_BUFFER_BIT | gl.GL_DEPTH_BUFFER_BIT)
        self._program._bind()
        reaching, meshes = drawable.reaching(views), [(m._vaid, m.indices.size) for m in primitives]
        for k, view in enumerate(views):
            self._viewport((k % columns) * cell[0], (k // columns) * cell[1], *cell)
            clip_from_bodies = (view.projection() @ view.camera_from_bodies).astype(np.float32)
            body = -1
            for p in np.flatnonzero(reaching[k]).tolist():
                if drawable.body_index[p] != body:
                    body = drawable.body_index[p]
                    self._set_matrix(self._matrix_location, 1, gl.GL_TRUE, clip_from_bodies[body])
                mesh, count = meshes[p]
                self._bind_mesh(mesh)
                self._draw_elements(gl.GL_TRIANGLES, count, gl.GL_UNSIGNED_INT, None)
        gl.glBindVertexArray(0)
        return frame_buffer.read()

    def _primitives(self, drawable: Drawable, samples: float) -> list[Any]:
        """The patches in OpenGL's memory, their discs made for ``samples`` drawn pixels a radian."""
        known = self._uploaded.setdefault(drawable, {})
        if samples not in known:
            known[samples] = [self._upload(disc_mesh(p, drawable.distance / samples) if isinstance(p, DiscStack) else p)
                              for p in drawable.patches]
        return known[samples]

    def _upload(self, mesh: Mesh) -> Any:
        grey = np.repeat(mesh.levels[:, None], 3, axis=1)
        primitive = self._pyrender.Primitive(
            positions=mesh.vertices.astype(np.float32), indices=mesh.faces.astype(np.uint32),
            color_0=np.column_stack([grey, np.ones(len(grey))]).astype(np.float32),
            material=self._pyrender.MetallicRoughnessMaterial(baseColorFactor=(1.0, 1.0, 1.0, 1.0)), mode=4)
        primitive._add_to_context()
        return primitive

    def _frame_buffer(self, width: int, height: int) -> _FrameBuffer:
        if (width, height) not in self._frame_buffers:
            if len(self._frame_buffers) >= KEPT_FRAME_BUFFERS:
                self._frame_buffers.pop(next(iter(self._frame_buffers))).delete()
            self._frame_buffers[width, height] = _FrameBuffer(self._gl, width, height)
        return self._frame_buffers[width, height]

    @cached_property
    def _matrix_location(self) -> int:
        """Where the bound shader takes its matrix from."""
        return int(self._gl.glGetUniformLocation(self._program._program_id, "P"))

    @cached_property
    def _program(self) -> Any:
        """pyrender's flat shader with all matrices identity but P."""
        from pyrender.constants import ProgramFlags

        anything = self._upload(Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]]), np.zeros(3)))
        program = self._shaders._get_primitive_program(anything, self._flags, ProgramFlags.USE_MATERIAL)
        program._bind()
        for name in ("V", "M"):
            program.set_uniform(name, np.eye(4))
        program.set_uniform("material.base_color_factor", np.ones(4))
        return program


class _FrameBuffer:
    """Red channel and depth with one sample a pixel."""

    def __init__(self, gl: Any, width: int, height: int) -> None:
        self._gl, self._size = gl, (width, height)
        self._name = gl.glGenFramebuffers(1)
        self._buffers = [self._attached(gl.GL_COLOR_ATTACHMENT0, gl.GL_R8),
                         self._attached(gl.GL_DEPTH_ATTACHMENT, gl.GL_DEPTH_COMPONENT24)]
        self.bind()
        state = gl.glCheckFramebufferStatus(gl.GL_FRAMEBUFFER)
        if state != gl.GL_FRAMEBUFFER_COMPLETE:
            raise CmmError(f"OpenGL cannot draw {self._size} px: frame buffer state {state}")

    def bind(self) -> None:
        """What is drawn from now on goes here, what is read comes from here."""
        self._gl.glBindFramebuffer(self._gl.GL_FRAMEBUFFER, self._name)

    def read(self) -> NDArray[np.uint8]:
        """The image (height, width)."""
        gl, (width, height) = self._gl, self._size
        self.bind()
        gl.glPixelStorei(gl.GL_PACK_ALIGNMENT, 1)
        pixels = gl.glReadPixels(0, 0, width, height, gl.GL_RED, gl.GL_UNSIGNED_BYTE)
        return np.frombuffer(pixels, dtype=np.uint8).reshape(height, width)

    def delete(self) -> None:
        """Give the memory back."""
        self._gl.glDeleteFramebuffers(1, [self._name])
        self._gl.glDeleteRenderbuffers(len(self._buffers), self._buffers)

    def _attached(self, attachment: int, kind: int) -> int:
        gl = self._gl
        buffer = int(gl.glGenRenderbuffers(1))
        self.bind()
        gl.glBindRenderbuffer(gl.GL_RENDERBUFFER, buffer)
        gl.glRenderbufferStorage(gl.GL_RENDERBUFFER, kind, *self._size)
        gl.glFramebufferRenderbuffer(gl.GL_FRAMEBUFFER, attachment, gl.GL_RENDERBUFFER, buffer)
        return buffer
