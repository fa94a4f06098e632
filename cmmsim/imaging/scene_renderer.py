"""Renderer ``scene``: whole frames by pyrender's own scene, camera, lamp and materials.

It shares no matrices, frame buffers or order of drawing with the renderer ``pyrender``. It is
slower, but it shades bodies realistically, and serves to check the other renderers.

Stickers are retro-reflective, so their level is the same in any light. Bodies are lit by a lamp at
the camera and by ambient light, in equal parts. A face that faces the camera has about the level
that the sensor file states, and other faces are darker. There are no shadows, because a lamp at the
camera casts none that the camera sees.

Every window is drawn by a camera of its own, whose principal point is shifted. A whole image is
drawn in pieces, and pieces without a body are left out. The scene has a perfect lens: distortion,
point spread and vignetting are applied to the drawn images later, as with every renderer.
"""

from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import product
from typing import Any
from weakref import WeakKeyDictionary, finalize

import cv2
import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.pose import Array
from cmmsim.imaging.pyrender_meshes import disc_mesh
from cmmsim.imaging.pyrender_renderer import opengl_context
from cmmsim.imaging.renderer import FAR, NEAR, Drawable, Renderer, View, Views
from cmmsim.imaging.scene_bodies import DiscStack, Mesh

# Number of drawn pixels along each side of the largest piece, and of the frame buffer for pieces.
LARGEST_PIECE = 512
ATLAS = 1024
# Ratio of the drawn samples to the requested ones, along each side. Materials and lamps make a
# sample five times as expensive as in the renderer `pyrender`.
SAMPLES = 5.0 / 9.0
# Fraction of a body's level that ambient light contributes.
AMBIENT = 0.5
# Radiance of the lamp, which contributes the rest of the level of a face that faces the camera.
# pyrender reflects 0.96² / pi of it diffusely and 0.04 / (4 pi) as rough gloss.
LAMP = (1.0 - AMBIENT) / (AMBIENT * 0.96**2 / np.pi + 0.04 / (4.0 * np.pi))
# pyrender's shader writes the radiance to the power 1 / GAMMA.
GAMMA = 2.2
# Radiance of each 8-bit value that the shader writes.
LINEAR = ((np.arange(256) / 255.0) ** GAMMA).astype(np.float32)
# Transform from the camera axes of OpenGL to those of OpenCV.
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def draw_frames(
    drawable: Drawable, views: Sequence[View], supersampling: int, background: float = 0.0
) -> NDArray[np.float32]:
    """Draw the radiance (n, h, w) float32, 0 to 1, of n windows of one size.

    Each pixel is the mean of s² drawn pixels, where s is SAMPLES times ``supersampling``, rounded,
    but at least 1. Raises OpenGLMissingError.
    """
    views = Views.of(views)
    supersampling = max(1, round(SAMPLES * supersampling))
    width, height = views.size
    images = np.full((len(views), height, width), background, dtype=np.float32)
    reach = LARGEST_PIECE // supersampling
    size = min(reach, width), min(reach, height)
    for shown in views.exposures:
        scene = _scene_of(drawable, shown.camera.focal_px * supersampling)
        moves = shown.camera_from_bodies
        cells = np.array(
            list(product(shown.windows, range(0, width, size[0]), range(0, height, size[1])))
        )
        low = views.corners[cells[:, 0]] + cells[:, 1:] - 0.5
        reached = drawable.reaching_windows(shown.camera, moves, np.hstack([low, low + size]))
        kept = reached.any(axis=1)
        # OpenCV's pixel coordinates refer to pixel centres, pyrender's to pixel corners.
        centres = supersampling * (shown.camera.centre - low[kept])
        focal_lengths = supersampling * shown.camera.focal_lengths
        drawn = scene.draw(
            moves,
            reached[kept],
            focal_lengths,
            centres,
            supersampling * np.array(size),
            background,
        )
        for (k, left, top), piece in zip(cells[kept].tolist(), drawn, strict=True):
            # Interpolation by area is the mean of the drawn pixels of each pixel.
            mean = cv2.resize(LINEAR[piece], size, interpolation=cv2.INTER_AREA)
            part = images[k, top : top + size[1], left : left + size[0]]
            part[:] = mean[: part.shape[0], : part.shape[1]]
    return images


SCENE = Renderer("scene", draw_frames, 0.0016)


class _Scene:
    """pyrender's scene of a drawable: for each body, a node of its discs and one of its solids.

    Discs are triangulated for ``samples`` drawn pixels per radian.
    """

    def __init__(self, drawable: Drawable, samples: float) -> None:
        # The context selects OpenGL's platform, which must be done before pyrender is imported.
        context = opengl_context()
        import pyrender

        self._pyrender = pyrender
        self._scene = pyrender.Scene(ambient_light=[1.0, 1.0, 1.0])
        sample = drawable.distance / samples
        self._nodes = {}
        # For each node: the node, its primitive, and the indices of its patches.
        self.primitives = []
        for body in np.unique(drawable.body_index).tolist():
            own = np.flatnonzero(drawable.body_index == body)
            discs = [k for k in own if isinstance(drawable.patches[k], DiscStack)]
            solids = [k for k in own if isinstance(drawable.patches[k], Mesh)]
            # Stickers are drawn first, so that pixels of the body behind them are not shaded.
            for part, share in ((discs, 1.0), (solids, AMBIENT)):
                if part:
                    facets = [_facets_of(drawable.patches[k], sample) for k in part]
                    primitive = self._primitive(np.concatenate(facets), share)
                    node = self._scene.add(pyrender.Mesh([primitive]))
                    self._nodes[node] = body
                    self.primitives.append((node, primitive, part))
        self._scene.add(pyrender.DirectionalLight(intensity=LAMP), pose=OPENCV_FROM_OPENGL)
        self._camera = pyrender.IntrinsicsCamera(1.0, 1.0, 0.0, 0.0, znear=NEAR, zfar=FAR)
        self._scene.add(self._camera, pose=OPENCV_FROM_OPENGL)
        context.make_current()
        for _, primitive, _ in self.primitives:
            primitive._add_to_context()
        kept = [primitive for _, primitive, _ in self.primitives]
        finalize(self, _UNUSED.extend, kept).atexit = False

    def draw(
        self,
        camera_from_bodies: Array,
        reached: NDArray[np.bool_],
        focal_lengths: Array,
        centres: Array,
        size: NDArray[np.int_],
        background: float,
    ) -> Iterator[NDArray[np.uint8]]:
        """Yield the values (h, w) that the shader wrote in each of n pieces.

        ``reached`` (n, patches) are the patches that reach into each piece. ``focal_lengths`` (2,),
        the principal points ``centres`` (n, 2) and ``size`` (w, h) are in drawn pixels.
        """
        for node, body in self._nodes.items():
            self._scene.set_pose(node, camera_from_bodies[body])
        level = background ** (1.0 / GAMMA)
        self._scene.bg_color = np.array([level, level, level, 1.0])
        self._camera.fx, self._camera.fy = focal_lengths
        projections = np.empty((len(centres), 4, 4), dtype=np.float32)
        for k, centre in enumerate(centres):
            self._camera.cx, self._camera.cy = centre
            projections[k] = self._camera.get_projection_matrix(*size)
        drawn = [
            (node, primitive, reached[:, patches].any(axis=1))
            for node, primitive, patches in self.primitives
        ]
        columns, rows = ATLAS // size
        for first in range(0, len(centres), columns * rows):
            part = slice(first, first + columns * rows)
            parts = [(node, primitive, np.asarray(shown)[part]) for node, primitive, shown in drawn]
            atlas = _drawing().draw(self._scene, parts, projections[part], size)
            for k in range(len(projections[part])):
                row, column = divmod(k, columns)
                top = row * size[1]
                left = column * size[0]
                yield atlas[top : top + size[1], left : left + size[0]][::-1]

    def _primitive(self, facets: Array, share: float) -> Any:
        """Return triangles in pyrender's form. ``facets`` is a result of `_facets`.

        ``share`` is the fraction of the level that ambient light contributes.
        """
        positions, normals, levels = facets[:, :3], facets[:, 3:6], facets[:, 6:]
        return self._pyrender.Primitive(
            positions=positions.astype(np.float32),
            normals=normals.astype(np.float32),
            color_0=np.hstack([levels, levels, levels, np.ones_like(levels)]).astype(np.float32),
            material=self._pyrender.MetallicRoughnessMaterial(
                baseColorFactor=(share, share, share, 1.0),
                metallicFactor=0.0,
                roughnessFactor=1.0,
                # Solids are closed, so their inner sides are never seen.
                doubleSided=share == 1.0,
            ),
            mode=4,
        )


def _facets_of(patch: DiscStack | Mesh, sample: float) -> Array:
    """Return the facets of a solid, or of discs for drawing with samples ``sample`` m apart."""
    if isinstance(patch, Mesh):
        return _facets(patch, None)
    # The lamp does not light faces whose normals point away from it, so discs keep their level.
    return _facets(disc_mesh(patch, sample), -patch.discs[0].normal)


def _facets(mesh: Mesh, normal: Array | None) -> Array:
    """Return position, normal and level (3 m, 7) of the corners of a mesh's m triangles.

    Each triangle has its own corners, so that edges are sharp. ``normal`` (3,), unless it is None,
    replaces the normals of the triangles.
    """
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.where(lengths > 0.0, lengths, 1.0)
    if normal is not None:
        normals = np.broadcast_to(normal, normals.shape)
    return np.hstack(
        [
            corners.reshape(-1, 3),
            np.repeat(normals, 3, axis=0),
            mesh.levels[mesh.faces].reshape(-1, 1),
        ]
    )


@lru_cache(maxsize=1)
def _drawing() -> Any:
    """Return the only object in this process that draws pyrender's scenes."""
    context = opengl_context()
    from OpenGL import GL
    from pyrender.constants import ProgramFlags, RenderFlags
    from pyrender.renderer import Renderer as SceneRenderer

    class Drawing(SceneRenderer):
        """pyrender's own drawing of many pieces into one frame buffer, the atlas.

        Each mesh is drawn with pyrender's own shader, lamps and material into all pieces before the
        next one. Meshes stay in OpenGL's memory as long as their scene exists.
        """

        def draw(
            self,
            scene: Any,
            parts: Sequence[tuple[Any, Any, NDArray[np.bool_]]],
            projections: NDArray[np.float32],
            size: NDArray[np.int_],
        ) -> NDArray[np.uint8]:
            """Return the values (rows, ATLAS) uint8 that the shader wrote, the lowest row first.

            The pieces lie beside each other in rows. ``parts`` contains nodes of meshes with their
            primitives, and masks (n,) of the pieces in which each is drawn. ``projections``
            (n, 4, 4) belong to the pieces of ``size`` (w, h).
            """
            context.make_current()
            while _UNUSED:
                _UNUSED.pop().delete()
            self._configure_forward_pass_viewport(RenderFlags.OFFSCREEN)
            GL.glClearColor(*scene.bg_color)
            GL.glClear(GL.GL_COLOR_BUFFER_BIT | GL.GL_DEPTH_BUFFER_BIT)
            pose = scene.get_pose(scene.main_camera_node)
            for node, primitive, shown in parts:
                program = self._get_primitive_program(
                    primitive, RenderFlags.OFFSCREEN, ProgramFlags.USE_MATERIAL
                )
                program._bind()
                program.set_uniform("V", np.linalg.inv(pose))
                program.set_uniform("cam_pos", pose[:3, 3])
                self._bind_lighting(scene, program, node, RenderFlags.OFFSCREEN)
                move = scene.get_pose(node)
                for n, k in enumerate(np.flatnonzero(shown).tolist()):
                    row, column = divmod(k, ATLAS // int(size[0]))
                    GL.glViewport(column * int(size[0]), row * int(size[1]), *size.tolist())
                    program.set_uniform("P", projections[k])
                    if n == 0:
                        self._bind_and_draw_primitive(
                            primitive, move, program, RenderFlags.OFFSCREEN
                        )
                        primitive._bind()
                        continue
                    # Everything but the projection is as in the first piece.
                    GL.glDrawArraysInstanced(primitive.mode, 0, len(primitive.positions), 1)
                primitive._unbind()
                program._unbind()
            # The renderer `pyrender` relies on these switches.
            for switch in (GL.GL_CULL_FACE, GL.GL_BLEND, GL.GL_DEPTH_TEST):
                GL.glDisable(switch)
            GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._main_fb)
            rows = -(-len(projections) // (ATLAS // int(size[0]))) * int(size[1])
            read = GL.glReadPixels(0, 0, ATLAS, rows, GL.GL_RED, GL.GL_UNSIGNED_BYTE)
            return np.frombuffer(read, dtype=np.uint8).reshape(rows, ATLAS)

        def _configure_forward_pass_viewport(self, flags: int) -> None:
            super()._configure_forward_pass_viewport(flags)
            # This frame buffer has one sample per pixel, which is enough for soft rims.
            GL.glBindFramebuffer(GL.GL_DRAW_FRAMEBUFFER, self._main_fb)

    context.make_current()
    return Drawing(ATLAS, ATLAS)


# Primitives of scenes that no longer exist. They stay in OpenGL's memory until the next drawing.
_UNUSED: list[Any] = []
_SCENES: "WeakKeyDictionary[Drawable, dict[float, _Scene]]" = WeakKeyDictionary()


def _scene_of(drawable: Drawable, samples: float) -> _Scene:
    """Return the scene of a drawable, with discs for ``samples`` drawn pixels per radian."""
    known = _SCENES.setdefault(drawable, {})
    if samples not in known:
        known[samples] = _Scene(drawable, samples)
    return known[samples]
