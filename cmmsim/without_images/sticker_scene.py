"""True places of stickers, and the convex solids that may hide them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.pose import Array
from cmmsim.imaging.scene_bodies import ConvexSolid, Mesh, SceneBody

if TYPE_CHECKING:
    from cmmsim.without_images.hiding_kernels import Solids

# Radii of a sticker within which nothing may stand before it and its ring: about the fitted part.
CLEAR = 1.75


@dataclass(frozen=True)
class StickerScene:
    """Stickers of one radius, m, and the solids of all bodies.

    They are at places (m, 3) with normals (m, 3) in the axes of their owners (m,), bodies 0 and 1.
    Solids that carry no stickers come last.
    """

    places: Array
    normals: Array
    owners: NDArray[np.int_]
    radius: float
    solids: tuple[ConvexSolid, ...]

    @classmethod
    def of(cls, bodies: Sequence[SceneBody], obstacles: Sequence[Mesh]) -> "StickerScene":
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

    def placed(self, moves: Array) -> tuple[Array, Array]:
        """Return places and normals (m, 3) in the axes of a camera, where bodies stand at (b, 4,
        4).
        """
        # Late, as numba takes time to import.
        from cmmsim.geometry.disc_kernels import place_discs

        places = np.empty_like(self.places)
        normals = np.empty_like(self.normals)
        place_discs(moves, self.owners, self.places, self.normals, places, normals)
        return places, normals

    def hidden(
        self, moves: Array, places: Array, normals: Array, asked: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Tell whether a solid stands before any part of stickers (m,).

        They have places and normals (m, 3) in camera axes; only those ``asked`` (m,) are looked at.
        """
        from cmmsim.without_images.hiding_kernels import hidden_stickers

        hidden = np.empty(len(asked), dtype=bool)
        hidden_stickers(
            moves, places, normals, self.owners, CLEAR * self.radius, self.hiding, asked, hidden
        )
        return hidden

    @cached_property
    def hiding(self) -> "Solids":
        """Solids as ``hidden_stickers`` takes them."""
        from cmmsim.without_images.hiding_kernels import Solids

        faces = [solid.faces for solid in self.solids]
        middles = np.array([solid.middle for solid in self.solids])
        radii = [
            np.linalg.norm(s.vertices - m, axis=1).max()
            for s, m in zip(self.solids, middles, strict=True)
        ]
        starts = np.cumsum([0, *(len(normals) for normals, _ in faces)])
        normals, offsets = (np.concatenate(values) for values in zip(*faces, strict=True))
        return Solids(starts, normals, offsets, middles, np.array(radii))
