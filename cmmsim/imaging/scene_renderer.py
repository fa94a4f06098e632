"""Renderer ``scene``: whole frames by pyrender's own scene, camera, lamp and materials.

It shares no matrices, frame buffers or order of drawing with the renderer ``pyrender``. It is
slower, shows a robot as people know it, and checks the other renderers.

Stickers send light back to the camera, so they have their level under any light. Bodies are lit by
a lamp at the camera and from all sides, in equal parts: a face that looks at the camera has about
the level that the sensor file states, and other faces are darker. There are no shadows, because a
lamp at the camera casts none that the camera sees.

Every window is drawn by a camera of its own, whose principal point is shifted. A whole image is
drawn in pieces, and pieces without a body are left out. The scene has a perfect lens: distortion,
point spread and vignetting are applied to what is drawn, as with every renderer.
"""

from collections.abc import Sequence
from functools import lru_cache
from itertools import product
from typing import Any
from weakref import WeakKeyDictionary

import cv2
import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.pose import Array
from cmmsim.imaging.pyrender_meshes import disc_mesh
from cmmsim.imaging.pyrender_renderer import opengl_context
from cmmsim.imaging.renderer import FAR, NEAR, Drawable, Renderer, View, Views
from cmmsim.imaging.scene_bodies import DiscStack, Mesh

# Drawn pixels along each side of the largest piece.
LARGEST_PIECE = 1024
# Share of a body's level that comes from all sides.
AMBIENT = 0.5
# Radiance of the lamp that adds the rest to a face that looks at the camera. pyrender reflects
# 0.96² / pi of it diffusely and 0.04 / (4 pi) in its rough gloss.
LAMP = (1.0 - AMBIENT) / (AMBIENT * 0.96**2 / np.pi + 0.04 / (4.0 * np.pi))
# pyrender's shader writes powers of the radiance.
GAMMA = 2.2
LINEAR = ((np.arange(256) / 255.0) ** GAMMA).astype(np.float32)
# Camera axes of OpenGL in those of OpenCV.
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def draw_frames(
    drawable: Drawable, views: Sequence[View], supersampling: int, background: float = 0.0
) -> NDArray[np.float32]:
    """Draw the radiance (n, h, w) float32, 0 to 1, of n windows of one size.

    Each pixel is the mean of ``supersampling``² drawn pixels. Raises OpenGLMissingError.
    """
    views = Views.of(views)
    width, height = views.size
    images = np.full((len(views), height, width), background, dtype=np.float32)
    reach = LARGEST_PIECE // supersampling
    for shown in views.exposures:
        scene = _scene_of(drawable, shown.camera.focal_px * supersampling)
        for k, left, top in product(
            shown.windows.tolist(), range(0, width, reach), range(0, height, reach)
        ):
            shape = min(reach, height - top), min(reach, width - left)
            low = views.corners[k] + [left, top] - 0.5
            bounds = np.hstack([low, low + shape[::-1]])[None]
            places = shown.camera_from_bodies
            if drawable.reaching_windows(shown.camera, places, bounds).any():
                # OpenCV's pixel coordinates refer to pixel centres, pyrender's to pixel corners.
                centre = supersampling * (shown.camera.centre - low)
                focal_lengths = supersampling * shown.camera.focal_lengths
                size = shape[1] * supersampling, shape[0] * supersampling
                drawn = scene.draw(places, focal_lengths, centre, size, background)
                # The mean of supersampling² drawn pixels.
                images[k, top : top + shape[0], left : left + shape[1]] = cv2.resize(
                    drawn, shape[::-1], interpolation=cv2.INTER_AREA
                )
    return images


SCENE = Renderer("scene", draw_frames, 0.00058)


class _Scene:
    """pyrender's scene of the patches of a drawable, one node a body."""

    def __init__(self, drawable: Drawable, samples: float) -> None:
        # Only the context's owner imports pyrender before this.
        opengl_context()
        import pyrender

        self._pyrender = pyrender
        self._scene = pyrender.Scene(ambient_light=[1.0, 1.0, 1.0])
        sample = drawable.distance / samples
        self._bodies = {}
        for body in np.unique(drawable.body_index).tolist():
            own = np.flatnonzero(drawable.body_index == body)
            patches = [drawable.patches[k] for k in own]
            stickers = [p for p in patches if isinstance(p, DiscStack)]
            solids = [p for p in patches if isinstance(p, Mesh)]
            lit = [_facets(mesh, None) for mesh in solids]
            # Discs are seen from one side. Normals to the other side keep the lamp from them.
            even = [_facets(disc_mesh(p, sample), -p.discs[0].normal) for p in stickers]
            primitives = [
                self._primitive(np.concatenate(facets), share)
                for facets, share in ((lit, AMBIENT), (even, 1.0))
                if facets
            ]
            self._bodies[body] = self._scene.add(pyrender.Mesh(primitives))
        self._scene.add(pyrender.DirectionalLight(intensity=LAMP), pose=OPENCV_FROM_OPENGL)
        self._camera = pyrender.IntrinsicsCamera(1.0, 1.0, 0.0, 0.0, znear=NEAR, zfar=FAR)
        self._scene.add(self._camera, pose=OPENCV_FROM_OPENGL)

    def draw(
        self,
        camera_from_bodies: Array,
        focal_lengths: Array,
        centre: Array,
        size: tuple[int, int],
        background: float,
    ) -> NDArray[np.float32]:
        """Return the radiance (h, w) of drawn pixels.

        ``focal_lengths`` (2,), ``centre`` (2,) and ``size`` (w, h) are in drawn pixels.
        """
        for body, node in self._bodies.items():
            self._scene.set_pose(node, camera_from_bodies[body])
        self._camera.fx, self._camera.fy = focal_lengths
        self._camera.cx, self._camera.cy = centre
        level = background ** (1.0 / GAMMA)
        self._scene.bg_color = np.array([level, level, level, 1.0])
        return LINEAR[_drawing().draw(self._scene, size)]

    def _primitive(self, facets: Array, share: float) -> Any:
        """Return triangles in pyrender's form. ``facets`` is as `_facets` returns it.

        ``share`` is the share of the level that comes from all sides.
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
                # The lower side of a body is hidden, and lies behind its upper side.
                doubleSided=share == 1.0,
            ),
            mode=4,
        )


def _facets(mesh: Mesh, normal: Array | None) -> Array:
    """Return place, normal and level (3 m, 7) of the corners of a mesh's m triangles.

    Each triangle has its own corners, so that edges are sharp. ``normal`` (3,) replaces the normals
    of the triangles.
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
    """Return what draws pyrender's scenes in this process."""
    context = opengl_context()
    from OpenGL import GL
    from pyrender import RenderFlags
    from pyrender.renderer import Renderer as SceneRenderer

    class Drawing(SceneRenderer):
        """pyrender's own drawing. Only one channel is read, and no depths."""

        def draw(self, scene: Any, size: tuple[int, int]) -> NDArray[np.uint8]:
            """Return the values (h, w) that the shader wrote, for a size (w, h)."""
            context.make_current()
            self.viewport_width, self.viewport_height = size
            drawn: NDArray[np.uint8] = self.render(scene, RenderFlags.OFFSCREEN)
            # The renderer `pyrender` relies on these switches.
            for switch in (GL.GL_CULL_FACE, GL.GL_BLEND, GL.GL_DEPTH_TEST):
                GL.glDisable(switch)
            return drawn

        def _configure_forward_pass_viewport(self, flags: int) -> None:
            super()._configure_forward_pass_viewport(flags)
            # Discs have soft rims. Several samples a drawn pixel would only take time.
            GL.glBindFramebuffer(GL.GL_DRAW_FRAMEBUFFER, self._main_fb)

        def _read_main_framebuffer(self, scene: Any, flags: int) -> NDArray[np.uint8]:
            GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._main_fb)
            width, height = self._main_fb_dims
            read = GL.glReadPixels(0, 0, width, height, GL.GL_RED, GL.GL_UNSIGNED_BYTE)
            return np.frombuffer(read, dtype=np.uint8).reshape(height, width)[::-1]

    context.make_current()
    return Drawing(LARGEST_PIECE, LARGEST_PIECE)


_SCENES: "WeakKeyDictionary[Drawable, dict[float, _Scene]]" = WeakKeyDictionary()


def _scene_of(drawable: Drawable, samples: float) -> _Scene:
    """Return the scene of a drawable, with discs for ``samples`` drawn pixels per radian."""
    known = _SCENES.setdefault(drawable, {})
    if samples not in known:
        known[samples] = _Scene(drawable, samples)
    return known[samples]
