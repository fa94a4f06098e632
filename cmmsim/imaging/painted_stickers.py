"""Stickers with uneven light and imperfect print, painted into the images of any renderer.

A renderer draws the scene with empty rings. It also draws a second image, which states the fraction
of each pixel in which a ring and its sticker are visible. In these pixels, the sticker is painted:
the point of the sticker that a pixel shows determines the pixel's level. Light and print are thus
the same for all renderers, and bodies still hide stickers. Drawn pixels must be much smaller than
stickers, because the rim is taken as straight within a pixel.
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
from cmmsim.geometry.camera import PinholeCamera
from cmmsim.geometry.pose import Array
from cmmsim.geometry.sticker_print import PrintSizes, SeenStickers, pinhole_slopes
from cmmsim.imaging.renderer import NEAR, Drawable, Renderer, Views
from cmmsim.imaging.scene_bodies import DiscStack, Mesh, Patch, SceneBody

if TYPE_CHECKING:
    from cmmsim.imaging.paint_kernels import Painted

# rad: largest angle between the line of sight and an object of the background, in each of two
# perpendicular directions, and the range of the objects' angular radii.
CLUTTERED = 0.5
SMALLEST_OBJECT = 4e-4
LARGEST_OBJECT = 8e-3


@dataclass(frozen=True)
class Paint:
    """Stickers with their print, in the axes of their bodies, and the light on them.

    bodies, places    (n,) and (n, 3) m, body and position of each sticker
    axes              (n, 3, 2), axes u and v of each sticker's plane
    radius            radius of the stickers, m
    ring_radius       radius of the rings, m
    face, ring        levels of stickers and rings
    sizes             sizes of the errors of the stickers
    prints, outlines  (n, 5) and (n, 8), coefficients of the modes of brightness and outline
    light             light of the sensor file
    target            (3,), point at which lamps have the stated strength, in base axes, m
    """

    bodies: NDArray[np.int_]
    places: Array
    axes: Array
    radius: float
    ring_radius: float
    face: float
    ring: float
    sizes: PrintSizes
    prints: Array
    outlines: Array
    light: Light
    target: Array

    def seen_by(self, camera: PinholeCamera, camera_from_bodies: Array) -> Painted:
        """Return the stickers that face a camera with a perfect lens and lie beyond NEAR.

        ``camera_from_bodies`` is (b, 4, 4), with the platform first and the base second.
        """
        # Imported late, because importing numba takes time.
        from cmmsim.imaging.paint_kernels import Painted

        moves = camera_from_bodies[self.bodies]
        centres = np.einsum("nij,nj->ni", moves[:, :3, :3], self.places) + moves[:, :3, 3]
        axes = moves[:, :3, :3] @ self.axes
        normals = np.cross(axes[..., 0], axes[..., 1])
        facing = np.einsum("ni,ni->n", centres, normals)
        kept = (facing < 0.0) & (centres[:, 2] - self.ring_radius > NEAR)
        centres, axes, normals, facing = (each[kept] for each in (centres, axes, normals, facing))
        slopes = pinhole_slopes(camera.focal_lengths, centres)
        seen = SeenStickers.of(centres, normals, axes, self.radius, slopes)
        rays = np.concatenate([self.radius * axes, centres[..., None]], axis=2)
        middles = camera.project(centres)[0]
        # A ring beside the optical axis is stretched.
        stretch = 1.0 + np.abs(middles - camera.centre) / camera.focal_lengths
        near = centres[:, 2:] - self.ring_radius
        reach = self.ring_radius * camera.focal_lengths * stretch / near + 1.0
        cosines = -facing / np.linalg.norm(centres, axis=1)
        return Painted(
            np.linalg.inv(camera.matrix @ rays),
            np.linalg.inv(seen.to_image),
            np.hstack([middles - reach, middles + reach]),
            self.sizes.thickness * seen.slopes,
            self.sizes.retro_shift * seen.retro_shifts,
            self._lights(camera_from_bodies[1], centres, normals, self.radius * axes),
            self.face * cosines**self.light.fall_off,
            self.ring,
            self.ring + self.sizes.rim * (self.face - self.ring),
            self.prints[kept],
            self.outlines[kept],
        )

    def _lights(
        self, camera_from_base: Array, centres: Array, normals: Array, steps: Array
    ) -> Array:
        """Return an array (n, 3) of the light at n stickers, and its changes along their two axes.

        The stickers have ``centres`` and ``normals`` (n, 3). ``steps`` (n, 3, 2) are their axes,
        one radius long. All are in camera axes.
        """

        def at(points: Array) -> Array:
            light = np.full(len(points), self.light.ambient if self.light.lamps else 1.0)
            for lamp in self.light.lamps:
                if lamp.direction is not None:
                    towards = np.tile(turn @ lamp.direction, (len(points), 1))
                    distance_factor = np.ones(len(points))
                elif lamp.place is not None:
                    towards = turn @ lamp.place + camera_from_base[:3, 3] - points
                    stated_squared = np.sum((np.array(lamp.place) - self.target) ** 2)
                    distance_factor = stated_squared / np.sum(towards**2, axis=1)
                cosines = np.einsum("ni,ni->n", towards, normals)
                cosines = cosines / np.linalg.norm(towards, axis=1)
                light += lamp.strength * np.maximum(cosines, 0.0) * distance_factor
            return light

        turn = camera_from_base[:3, :3]
        changes = [
            0.5 * (at(centres + steps[..., i]) - at(centres - steps[..., i])) for i in range(2)
        ]
        return np.column_stack([at(centres), *changes])


@dataclass(frozen=True)
class StickerPainter:
    """Painter of the stickers of a scene.

    ``rings`` is the scene with empty rings. ``visible`` has rings of level 1 and all else dark, and
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
        """Draw the radiance (n, h, w) of n windows, with stickers and far objects."""
        # Imported late, because importing numba takes time.
        from cmmsim.imaging.paint_kernels import paint_view, scatter_objects

        images = np.array(renderer.draw(self.rings, views, supersampling, background))
        shown = renderer.draw(self.visible, views, supersampling, 0.0)
        behind = shown
        if len(self.objects):
            behind = renderer.draw(self.dark, views, supersampling, 1.0)
        for seen in views.exposures:
            camera = seen.camera
            moves = seen.camera_from_bodies
            windows = seen.windows, np.asarray(views.corners[seen.windows], dtype=float)
            paint_view(images, shown, *windows, self.paint.seen_by(camera, moves))
            if len(self.objects):
                turn = np.ascontiguousarray(moves[1, :3, :3])
                lens = camera.focal_lengths, camera.centre
                scatter_objects(images, behind, *windows, self.objects, turn, *lens)
        return images


def painter_of(
    file: SensorFile,
    bodies: Sequence[SceneBody],
    marked: Sequence[MarkedBody],
    drawable: Drawable,
) -> StickerPainter | None:
    """Return the painter of a sensor file's light and print, or None if both are plain."""
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
    """Return the stickers of platform and base with their print, and the light on them."""
    counts = [len(body.sticker_places) for body in bodies]
    drawn = [drawn_print(file, n, k) for k, n in enumerate(counts)]
    prints, outlines = (np.concatenate(values) for values in zip(*drawn, strict=True))
    axes = np.concatenate([body.in_plane for body in marked])
    levels = file.stickers.sticker_level / 255.0, file.stickers.ring_level / 255.0
    return Paint(
        np.repeat(np.arange(len(counts)), counts),
        np.concatenate([body.sticker_places for body in bodies]),
        axes,
        file.stickers.radius,
        file.stickers.ring_radius,
        *levels,
        print_sizes(file),
        prints,
        outlines,
        file.light,
        np.array(file.rig.target),
    )


def _objects(file: SensorFile) -> Array:
    """Return the objects (o, 5) of ``scatter_objects``, at random around the line of sight."""
    light = file.light
    rng = np.random.default_rng(light.clutter_seed)
    sight = np.subtract(file.rig.target, file.rig.position)
    sight /= np.linalg.norm(sight)
    across = np.linalg.svd(sight[None])[2][1:]
    aside = np.tan(CLUTTERED) * rng.uniform(-1.0, 1.0, (light.clutter, 2))
    rays = sight + aside @ across
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    smallest, largest = np.log([SMALLEST_OBJECT, LARGEST_OBJECT])
    radii = np.exp(rng.uniform(smallest, largest, light.clutter))
    levels = rng.uniform(0.2, 1.0, light.clutter) * light.clutter_level / 255.0
    return np.column_stack([rays, radii, levels])
