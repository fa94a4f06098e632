"""Stickers with light and print, painted into what any renderer has drawn.

A renderer draws the scene with empty rings. It also draws in which share of each pixel a ring, with
its sticker, is visible. The sticker is then painted where it is visible, pixel by pixel, from the
place on the sticker that a pixel sees. So all renderers have the same light and print, and bodies
hide stickers as before. Pixels must be much finer than the rims of stickers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cmmsim.files.light_and_print import Light
from cmmsim.files.printed import drawn_print, print_sizes
from cmmsim.files.rig_and_bodies import MarkedBody
from cmmsim.files.schema import SensorFile
from cmmsim.geometry.pose import Array
from cmmsim.geometry.sticker_print import RETRO_ANGLE
from cmmsim.imaging.renderer import NEAR, Drawable, Renderer, Views
from cmmsim.imaging.scene_bodies import DiscStack, Mesh, Patch, SceneBody

if TYPE_CHECKING:
    from cmmsim.imaging.paint_kernels import Paint

# rad: largest angle between the line of sight and an object of the background, and the range of
# the objects' radii.
CLUTTERED = 0.5
SMALLEST_OBJECT = 4e-4
LARGEST_OBJECT = 8e-3


@dataclass(frozen=True)
class StickerPainter:
    """Painter of the stickers of a scene, see the beginning of this file.

    ``rings`` is the scene with empty rings, ``visible`` has rings of level 1 in a dark scene, and
    ``dark`` is wholly dark. ``objects`` (o, 5) are the objects of the background.
    """

    rings: Drawable
    visible: Drawable
    dark: Drawable
    paint: Paint
    objects: Array

    @property
    def paints_background(self) -> bool:
        """True if windows without any body show objects of the background."""
        return len(self.objects) > 0

    def draw(
        self, renderer: Renderer, views: Views, supersampling: int, background: float
    ) -> NDArray[np.float32]:
        """Return the radiance (n, h, w) of n windows, with stickers."""
        # Imported late, because importing numba takes time.
        from cmmsim.imaging.paint_kernels import paint_view, scatter_objects

        images = np.array(renderer.draw(self.rings, views, supersampling, background))
        shown = renderer.draw(self.visible, views, supersampling, 0.0)
        behind = shown
        if len(self.objects):
            behind = renderer.draw(self.dark, views, supersampling, 1.0)
        for seen in views.exposures:
            camera = seen.camera
            places = np.ascontiguousarray(seen.camera_from_bodies)
            figures = camera.focal_lengths, camera.centre
            at = seen.windows, np.asarray(views.corners[seen.windows], dtype=float)
            paint_view(images, shown, *at, self.paint, places, *figures, NEAR)
            if len(self.objects):
                turn = np.ascontiguousarray(places[1, :3, :3])
                scatter_objects(images, behind, *at, self.objects, turn, *figures)
        return images


def painter_of(
    file: SensorFile,
    bodies: Sequence[SceneBody],
    marked: Sequence[MarkedBody],
    drawable: Drawable,
) -> StickerPainter | None:
    """Return the painter of a sensor file's light and print, or None if it has neither."""
    light = file.light
    plain = file.print.is_perfect and not light.lamps and light.fall_off == 0.0
    if plain and light.clutter == 0:
        return None
    ring = file.stickers.ring_level / 255.0
    return StickerPainter(
        _with_levels(drawable, ring, None),
        _with_levels(drawable, 1.0, 0.0),
        _with_levels(drawable, 0.0, 0.0),
        _paint(file, bodies, marked),
        _objects(file),
    )


def _with_levels(drawable: Drawable, ring: float, solid: float | None) -> Drawable:
    """Return a drawable in which all discs have the level ``ring``, and solids ``solid``.

    Solids keep their levels if ``solid`` is None.
    """

    def changed(patch: Patch) -> Patch:
        if isinstance(patch, DiscStack):
            return DiscStack(tuple(replace(disc, level=ring) for disc in patch.discs))
        if solid is None:
            return patch
        return Mesh(patch.vertices, patch.faces, np.full(len(patch.vertices), solid))

    patches = [changed(patch) for patch in drawable.patches]
    return Drawable(patches, drawable.body_index.tolist(), drawable.distance)


def _paint(file: SensorFile, bodies: Sequence[SceneBody], marked: Sequence[MarkedBody]) -> Paint:
    """Return the stickers of platform and base with their print, and the lamps."""
    # Imported late, because importing numba takes time.
    from cmmsim.imaging.paint_kernels import Paint

    stickers = file.stickers
    sizes = print_sizes(file)
    counts = [len(body.sticker_places) for body in bodies]
    drawn = [drawn_print(file, n, k) for k, n in enumerate(counts)]
    prints, outlines = (np.concatenate(values) for values in zip(*drawn, strict=True))
    axes = np.concatenate([body.in_plane for body in marked])
    face, ring = stickers.sticker_level / 255.0, stickers.ring_level / 255.0
    return Paint(
        np.repeat(np.arange(len(counts)), counts),
        np.concatenate([body.sticker_places for body in bodies]),
        np.cross(axes[..., 0], axes[..., 1]),
        np.ascontiguousarray(axes),
        stickers.radius,
        stickers.ring_radius,
        face,
        ring,
        ring + sizes.rim * (face - ring),
        sizes.thickness,
        sizes.retro_shift,
        RETRO_ANGLE,
        prints,
        outlines,
        file.light.fall_off,
        *_lamps(file.light, np.array(file.rig.target)),
    )


def _lamps(light: Light, target: Array) -> tuple[float, Array, Array, Array]:
    """Return the light without lamps, and the lamps (l, 4), strengths (l,) and distances (l,)."""
    rows = [
        [*lamp.direction, 0.0] if lamp.place is None else [*lamp.place, 1.0]  # type: ignore[misc]
        for lamp in light.lamps
    ]
    lamps = np.array(rows, dtype=float).reshape(-1, 4)
    strengths = np.array([lamp.strength for lamp in light.lamps], dtype=float)
    distances = np.linalg.norm(lamps[:, :3] - target, axis=1)
    return (light.ambient if light.lamps else 1.0), lamps, strengths, distances


def _objects(file: SensorFile) -> Array:
    """Return the bright objects (o, 5) of the background, far away around the line of sight."""
    light = file.light
    rng = np.random.default_rng(light.clutter_seed)
    sight = np.subtract(file.rig.target, file.rig.position)
    sight /= np.linalg.norm(sight)
    across = np.linalg.svd(sight[None])[2][1:]
    aside = np.tan(CLUTTERED) * rng.uniform(-1.0, 1.0, (light.clutter, 2))
    rays = sight + aside @ across
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    smallest, largest = np.log([SMALLEST_OBJECT, LARGEST_OBJECT])
    sizes = np.exp(rng.uniform(smallest, largest, light.clutter))
    levels = rng.uniform(0.2, 1.0, light.clutter) * light.clutter_level / 255.0
    return np.column_stack([rays, sizes, levels])
