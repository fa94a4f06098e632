"""Renderer ``pyrender``: many small windows are drawn in one pass.

pyrender supplies the OpenGL context, the mesh buffers and the flat shader. The frame buffers have
one channel only, which draws faster than pyrender's four. One large frame buffer, the atlas, has a
cell for each window. Each window is drawn into its cell with its own projection, enlarged by the
supersampling factor. The drawn pixels are then averaged in linear light. Every drawn pixel has one
sample. Multisampling would be slower and hardly more accurate, because stickers have soft rims.

In a cell, only patches whose bounding box reaches into it are drawn. Projection and
camera_from_body are multiplied in double precision, so that the shader gets one well-scaled matrix.
Depth tests are used only where they are needed. If a solid fills a cell, the cell is cleared to the
level of the solid or of a sticker's ring on it, see ``PaintedWindows``. Each piece of the atlas is
sent to OpenGL as soon as it is ready, and drawn while the next one is prepared.
"""

import ctypes
import os
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmmsim.errors import CmmError, OpenGLMissingError
from cmmsim.imaging.pyrender_meshes import PaintedSolids, disc_mesh, ringed_mesh
from cmmsim.imaging.renderer import Drawable, Renderer, View, Views
from cmmsim.imaging.scene_bodies import DiscStack, Mesh, Patch

# Largest side of an atlas, drawn pixels, unless a single cell is larger.
ATLAS_SIDE_PX = 2048
# Number of frame buffers that are kept; a further one replaces the oldest.
KEPT_FRAME_BUFFERS = 12
# Number of pieces in which an atlas is sent to OpenGL.
PIECES = 3


def render_windows(
    drawable: Drawable, views: Sequence[View], supersampling: int, background: float = 0.0
) -> NDArray[np.float32]:
    """Draw the radiance (n, h, w) float32, 0 to 1, of n windows of one size.

    Each pixel is the mean of ``supersampling``² drawn pixels. Raises OpenGLMissingError.
    """
    # Imported late, because importing numba takes time.
    from cmmsim.imaging.window_kernels import mean_of_cells

    views = Views.of(views)
    width, height = views.size
    cell_w = width * supersampling
    cell_h = height * supersampling
    columns = max(1, min(ATLAS_SIDE_PX // cell_w, int(np.ceil(np.sqrt(len(views))))))
    per_pass = columns * max(1, ATLAS_SIDE_PX // cell_h)
    windows = np.empty((len(views), height, width), dtype=np.float32)
    for first in range(0, len(views), per_pass):
        part = views[first : first + per_pass]
        atlas = _shared_atlas().draw(
            drawable, part, (cell_w, cell_h), columns, -(-len(part) // columns), background
        )
        mean_of_cells(atlas, columns, supersampling, windows[first : first + per_pass])
    return windows


PYRENDER = Renderer("pyrender", render_windows, 0.00058)


def require_opengl() -> None:
    """Check that pyrender can draw.

    Raises
    ------
    OpenGLMissingError
        If pyrender cannot draw. The message names the packages to install.
    """
    _shared_atlas()


def opengl_context() -> Any:
    """Return the platform of this process's only OpenGL context. Raises OpenGLMissingError."""
    return _shared_atlas().platform


@lru_cache(maxsize=1)
def _shared_atlas() -> "_Atlas":
    """Return the only atlas of this process. A second one would leak memory."""
    if not os.environ.get("DISPLAY"):
        os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    try:
        import pyrender

        return _Atlas(pyrender)
    except Exception as error:  # PyOpenGL's platform plugins raise exceptions of many types
        raise OpenGLMissingError(error) from error


@dataclass(frozen=True)
class _Patch:
    """Patch in OpenGL's memory.

    The vertex indices of its triangles are stored twice: from front to back, and in reverse order.
    ``indices`` is the number of indices of one order, and ``backwards`` the byte offset at which
    the reverse order begins. ``solid`` is False for a stack of discs.
    """

    vertex_array: int
    indices: int
    backwards: int
    solid: bool


@dataclass(frozen=True)
class _Uploaded:
    """Parts of a drawable in OpenGL's memory.

    ``patches`` maps a resolution, drawn pixels per radian, to all patches. ``ringed`` does the
    same, but its stacks of discs come from ``ringed_mesh``, for cells that are cleared to the level
    of the lowest disc.
    """

    patches: dict[float, list[_Patch]]
    ringed: dict[float, list[_Patch]]
    solids: PaintedSolids


class _Atlas:
    """Drawing of windows into the cells of one large frame buffer, with shaders of pyrender."""

    def __init__(self, pyrender: Any) -> None:
        from OpenGL import GL
        from pyrender.renderer import Renderer

        self._gl = GL
        self._pyrender = pyrender
        self._context = pyrender.OffscreenRenderer(64, 64)
        self._viewport = _called("glViewport", *[ctypes.c_int] * 4)
        address = ctypes.c_size_t  # a plain number, because PyOpenGL would inspect a pointer
        self._draw_elements = _called(
            "glDrawElements", ctypes.c_uint, ctypes.c_int, ctypes.c_uint, address
        )
        self._set_matrix = _called(
            "glUniformMatrix4fv", ctypes.c_int, ctypes.c_int, ctypes.c_ubyte, address
        )
        self._bind_mesh = _called("glBindVertexArray", ctypes.c_uint)
        self._constants = int(GL.GL_TRIANGLES), int(GL.GL_UNSIGNED_INT)
        self._shaders = Renderer(64, 64)
        GL.glDepthFunc(GL.GL_LESS)
        for switch in (GL.GL_CULL_FACE, GL.GL_BLEND, GL.GL_DEPTH_TEST):
            GL.glDisable(switch)
        GL.glPixelStorei(GL.GL_PACK_ALIGNMENT, 1)
        self._flags = pyrender.RenderFlags.FLAT | pyrender.RenderFlags.OFFSCREEN
        self._frame_buffers: dict[tuple[int, int], _FrameBuffer] = {}
        self._known: weakref.WeakKeyDictionary[Drawable, _Uploaded] = weakref.WeakKeyDictionary()

    @property
    def platform(self) -> Any:
        """pyrender's platform, which owns the context."""
        return self._context._platform

    def draw(
        self,
        drawable: Drawable,
        views: Views,
        cell: tuple[int, int],
        columns: int,
        rows: int,
        background: float,
    ) -> NDArray[np.uint8]:
        """Draw the atlas (rows * cell_h, columns * cell_w) uint8, with cells in reading order.

        The result is valid until the next call. Discs are triangulated for the first camera.
        """
        self.platform.make_current()
        # Drawn pixels per radian.
        samples = views.exposures[0].camera.focal_px * cell[0] / views.size[0]
        known = self._uploaded(drawable, samples)
        frame_buffer = self._frame_buffer(columns * cell[0], rows * cell[1])
        frame_buffer.bind()
        reaching = drawable.reaching(views)
        laid = known.solids.painted(views, reaching)
        reaching[np.flatnonzero(laid.filled), laid.solid[laid.filled]] = False
        cells = [
            ((k % columns) * cell[0], (k // columns) * cell[1], *cell) for k in range(len(views))
        ]
        grounds = known.solids.levels[np.where(laid.ringed < 0, laid.solid, laid.ringed)]
        self._clear(np.where(laid.filled, grounds, background), cells, bool((laid.solid < 0).any()))
        self._program._bind()
        clip_from_bodies = np.ascontiguousarray(views.clip_from_bodies(), dtype=np.float32)
        shown = [np.flatnonzero(row).tolist() for row in reaching]
        per_piece = -(-rows // PIECES) * columns
        address = clip_from_bodies.ctypes.data
        strides = clip_from_bodies.strides
        for k, (place, deep, ringed) in enumerate(
            zip(cells, laid.solid < 0, laid.ringed >= 0, strict=True)
        ):
            if k and k % per_piece == 0:
                self._gl.glFlush()
            self._viewport(*place)
            matrices = {
                p: address + k * strides[0] + int(drawable.body_index[p]) * strides[1]
                for p in shown[k]
            }
            draw = self._draw_by_depth if deep else self._draw_in_order
            draw(matrices, (known.ringed if ringed else known.patches)[samples])
        self._bind_mesh(0)
        return frame_buffer.read()

    def _draw_by_depth(self, matrices: Mapping[int, int], patches: Sequence[_Patch]) -> None:
        """Draw the patches of a cell with depth tests.

        ``matrices`` maps each patch to the address of its matrix.
        """
        gl = self._gl
        triangles, unsigned = self._constants
        gl.glEnable(gl.GL_DEPTH_TEST)
        for p, matrix in matrices.items():
            self._set_matrix(self._matrix_location, 1, True, matrix)
            self._bind_mesh(patches[p].vertex_array)
            self._draw_elements(triangles, patches[p].indices, unsigned, 0)
        gl.glDisable(gl.GL_DEPTH_TEST)

    def _draw_in_order(self, matrices: Mapping[int, int], patches: Sequence[_Patch]) -> None:
        """Draw the patches of a cell over each other: the solid, then the stack that lies on it.

        The triangles are drawn from back to front. ``matrices`` maps each patch to the address of
        its matrix. All patches belong to one body.
        """
        triangles, unsigned = self._constants
        for p in sorted(matrices, key=lambda p: not patches[p].solid):
            self._set_matrix(self._matrix_location, 1, True, matrices[p])
            self._bind_mesh(patches[p].vertex_array)
            self._draw_elements(triangles, patches[p].indices, unsigned, patches[p].backwards)

    def _clear(
        self, grounds: NDArray[np.float64], cells: Sequence[tuple[int, ...]], with_depth: bool
    ) -> None:
        """Clear cells (x, y, w, h) to their ``grounds``, and the depth buffer if ``with_depth``."""
        gl = self._gl
        level = float(grounds[0])
        gl.glClearColor(level, level, level, 1.0)
        gl.glClear(gl.GL_COLOR_BUFFER_BIT | (gl.GL_DEPTH_BUFFER_BIT if with_depth else 0))
        others = np.flatnonzero(grounds != level).tolist()
        if others:
            gl.glEnable(gl.GL_SCISSOR_TEST)
            for k in others:
                gl.glScissor(*cells[k])
                gl.glClearColor(*[float(grounds[k])] * 3, 1.0)
                gl.glClear(gl.GL_COLOR_BUFFER_BIT)
            gl.glDisable(gl.GL_SCISSOR_TEST)

    def _uploaded(self, drawable: Drawable, samples: float) -> _Uploaded:
        """Return the parts of a drawable in OpenGL's memory, where the first call stores them.

        Discs are triangulated for ``samples`` drawn pixels per radian.
        """
        known = self._known.get(drawable)
        if known is None:
            known = self._known[drawable] = _Uploaded({}, {}, PaintedSolids(drawable))
        if samples not in known.patches:
            sample = drawable.distance / samples
            solids = known.solids
            known.patches[samples] = []
            known.ringed[samples] = []
            for k, patch in enumerate(drawable.patches):
                drawn = self._patch(
                    disc_mesh(patch, sample) if isinstance(patch, DiscStack) else patch, patch
                )
                known.patches[samples].append(drawn)
                carrier = solids.carrier(k)
                if isinstance(patch, DiscStack) and carrier is not None:
                    drawn = self._patch(
                        ringed_mesh(patch, sample, float(solids.levels[carrier])), patch
                    )
                known.ringed[samples].append(drawn)
        return known

    def _patch(self, mesh: Mesh, patch: Patch) -> _Patch:
        behind = mesh.faces.size * np.uint32().itemsize
        return _Patch(
            int(self._upload(mesh)._vaid), mesh.faces.size, behind, isinstance(patch, Mesh)
        )

    def _upload(self, mesh: Mesh) -> Any:
        grey = np.repeat(mesh.levels[:, None], 3, axis=1)
        primitive = self._pyrender.Primitive(
            positions=mesh.vertices.astype(np.float32),
            indices=np.concatenate([mesh.faces, mesh.faces[::-1]]).astype(np.uint32),
            color_0=np.column_stack([grey, np.ones(len(grey))]).astype(np.float32),
            material=self._pyrender.MetallicRoughnessMaterial(baseColorFactor=(1.0, 1.0, 1.0, 1.0)),
            mode=4,
        )
        primitive._add_to_context()
        return primitive

    def _frame_buffer(self, width: int, height: int) -> "_FrameBuffer":
        if (width, height) not in self._frame_buffers:
            if len(self._frame_buffers) >= KEPT_FRAME_BUFFERS:
                self._frame_buffers.pop(next(iter(self._frame_buffers))).delete()
            self._frame_buffers[width, height] = _FrameBuffer(self._gl, width, height)
        return self._frame_buffers[width, height]

    @cached_property
    def _matrix_location(self) -> int:
        """Location of the matrix P of the bound shader."""
        return int(self._gl.glGetUniformLocation(self._program._program_id, "P"))

    @cached_property
    def _program(self) -> Any:
        """pyrender's flat shader, in which all matrices except P are the identity."""
        from pyrender.constants import ProgramFlags

        anything = self._upload(Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]]), np.zeros(3)))
        program = self._shaders._get_primitive_program(
            anything, self._flags, ProgramFlags.USE_MATERIAL
        )
        program._bind()
        for name in ("V", "M"):
            program.set_uniform(name, np.eye(4))
        program.set_uniform("material.base_color_factor", np.ones(4))
        return program


def _called(name: str, *arguments: type) -> Any:
    """Return a function of OpenGL that takes plain numbers and addresses.

    OpenGL's errors are not checked after each call, because this would take most of the time.
    """
    from OpenGL.platform import PLATFORM

    return PLATFORM.constructFunction(name, PLATFORM.GL, None, arguments, error_checker=None)


class _FrameBuffer:
    """Frame buffer with a red channel and depth, one sample per pixel."""

    def __init__(self, gl: Any, width: int, height: int) -> None:
        from OpenGL.raw.GL.VERSION import GL_1_0  # its glReadPixels writes to a given address

        self._gl = gl
        self._size = (width, height)
        self._read_pixels = GL_1_0.glReadPixels
        self._pixels = np.empty((height, width), dtype=np.uint8)
        self._target = self._pixels.ctypes.data_as(ctypes.c_void_p)
        self._name = gl.glGenFramebuffers(1)
        self._buffers = [
            self._attached(gl.GL_COLOR_ATTACHMENT0, gl.GL_R8),
            self._attached(gl.GL_DEPTH_ATTACHMENT, gl.GL_DEPTH_COMPONENT24),
        ]
        self.bind()
        state = gl.glCheckFramebufferStatus(gl.GL_FRAMEBUFFER)
        if state != gl.GL_FRAMEBUFFER_COMPLETE:
            raise CmmError(f"OpenGL cannot draw {self._size} px: frame buffer state {state}")

    def bind(self) -> None:
        """Make this frame buffer the target of drawing and reading."""
        self._gl.glBindFramebuffer(self._gl.GL_FRAMEBUFFER, self._name)

    def read(self) -> NDArray[np.uint8]:
        """Return the image (height, width). The next call overwrites its memory."""
        self._read_pixels(
            0, 0, *self._size, self._gl.GL_RED, self._gl.GL_UNSIGNED_BYTE, self._target
        )
        return self._pixels

    def delete(self) -> None:
        """Free the frame buffer's memory."""
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
