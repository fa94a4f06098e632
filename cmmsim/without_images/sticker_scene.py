"""True positions of stickers, print errors of their centres, and solids that can hide them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cmmsim.files.schema import SensorFile
from cmmsim.geometry.pose import Array
from cmmsim.imaging.scene_bodies import ConvexSolid, Mesh, SceneBody
from cmmsim.measuring.print_allowance import centre_errors_px

if TYPE_CHECKING:
    from cmmsim.without_images.hiding_kernels import Solids

# Radius around a sticker within which no point may be hidden, in sticker radii. It is about that of
# the part of the image that is fitted.
CLEAR = 1.75


@dataclass(frozen=True)
class StickerScene:
    """Stickers with a common radius, m, and the solids of all bodies.

    Stickers have positions ``places`` (m, 3), m, and normals (m, 3) in the axes of the bodies
    ``owners`` (m,), which are 0 or 1. Solid k belongs to body k; solids without stickers come last.
    """

    places: Array
    normals: Array
    owners: NDArray[np.int_]
    radius: float
    solids: tuple[ConvexSolid, ...]

    @classmethod
    def of(cls, bodies: Sequence[SceneBody], obstacles: Sequence[Mesh]) -> StickerScene:
        """Return the scene of bodies with stickers and of further solids."""
        discs = [
            (stack.discs[-1], owner) for owner, body in enumerate(bodies) for stack in body.stickers
        ]
        return cls(
            np.array([disc.centre for disc, _ in discs]),
            np.array([disc.normal for disc, _ in discs]),
            np.array([owner for _, owner in discs]),
            discs[0][0].radius,
            tuple(
                ConvexSolid(mesh.vertices)
                for mesh in (*(body.solid for body in bodies), *obstacles)
            ),
        )

    def placed(self, camera_from_bodies: Array) -> tuple[Array, Array]:
        """Return the positions and normals (m, 3) of the stickers in the axes of a camera.

        ``camera_from_bodies`` is (b, 4, 4).
        """
        # Imported late, because importing numba takes time.
        from cmmsim.geometry.disc_kernels import place_discs

        places = np.empty_like(self.places)
        normals = np.empty_like(self.normals)
        place_discs(camera_from_bodies, self.owners, self.places, self.normals, places, normals)
        return places, normals

    def hidden(
        self, camera_from_bodies: Array, places: Array, normals: Array, tested: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Return the mask (m,) of stickers that a solid of another body hides.

        A sticker is hidden if a part of the disc of CLEAR radii around it is hidden. Stickers have
        positions ``places`` and normals (m, 3) in camera axes. Only stickers in the mask ``tested``
        (m,) are tested; the others count as not hidden.
        """
        from cmmsim.without_images.hiding_kernels import hidden_stickers

        hidden = np.empty(len(tested), dtype=bool)
        hidden_stickers(
            camera_from_bodies,
            places,
            normals,
            self.owners,
            CLEAR * self.radius,
            self.occluders,
            tested,
            hidden,
        )
        return hidden

    @cached_property
    def occluders(self) -> Solids:
        """Solids in the form that ``hidden_stickers`` takes."""
        from cmmsim.without_images.hiding_kernels import Solids

        faces = [solid.faces for solid in self.solids]
        middles = np.array([solid.middle for solid in self.solids])
        radii = [
            np.linalg.norm(solid.vertices - middle, axis=1).max()
            for solid, middle in zip(self.solids, middles, strict=True)
        ]
        starts = np.cumsum([0, *(len(normals) for normals, _ in faces)])
        normals, offsets = (np.concatenate(values) for values in zip(*faces, strict=True))
        return Solids(starts, normals, offsets, middles, np.array(radii))


# Number of the random stream of print errors of centres.
PRINT_STREAM = 2


@dataclass(frozen=True)
class CentreErrors:
    """Errors of sticker centres due to uneven print and outlines that are not round.

    ``constant`` (2, m, 2) px are the constant errors of the stickers in both images. Further errors
    are new in each exposure, with the standard deviation ``changing_px`` per coordinate.
    """

    constant: Array
    changing_px: float

    @classmethod
    def of(cls, file: SensorFile, radius_px: float, count: int) -> CentreErrors:
        """Draw the errors of ``count`` stickers with the radius ``radius_px`` in the image."""
        constant, changing = centre_errors_px(file, radius_px)
        rng = np.random.default_rng([file.print.seed, PRINT_STREAM])
        return cls(constant * rng.standard_normal((2, count, 2)), changing)

    def added_to(self, centres: Array, rng: np.random.Generator) -> Array:
        """Return the centres (2, m, 2) of one exposure, with their errors."""
        return centres + self.constant + self.changing_px * rng.standard_normal(centres.shape)
