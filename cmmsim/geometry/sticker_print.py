"""Imperfect print of stickers, and the shifts of their centres that it causes.

Points on a sticker have coordinates (u, v) along two axes in its plane, in radii of the sticker.
Brightness varies over a sticker by the modes 2 u, 2 v, √24 u v, √6 (u² - v²) and √12 (u² + v² - ½).
They are orthogonal, and have a mean square of 1 on the disc. The radius of the outline varies by
the harmonics 2 to 5 of the angle.

**Shift of a fitted centre.** Errors of a sticker move its apparent rim by rho, px, along the
normal n of the rim in the image. A fit to grey values minimises the squared distance between
ellipse and rim along the rim. The shape of the ellipse takes up the part of rho that is equal on
opposite sides. The shift of the centre is therefore

    (integral of n n' ds)^-1  integral of n rho ds.

The rim is the image c + M q of the unit circle q, so that n is M^-T q, scaled to length one. An
inclined thick sticker also shows the side of its rim, which enlarges its outline. A brightness that
rises across a sticker would move its centre as well, but this rise is estimated together with the
centre, see ``detection.light_kernels``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cmmsim.geometry.pose import Array

# Number of modes of brightness.
PRINT_MODES = 5
# Harmonics of the outline, each with a coefficient of the cosine and one of the sine.
HARMONICS = (2, 3, 4, 5)
OUTLINE_MODES = 2 * len(HARMONICS)
# Angle of view at which the shift of a retro-reflective sticker is stated, rad.
RETRO_ANGLE = np.radians(40.0)
# Number of points on a rim at which integrals along the rim are evaluated.
RIM_POINTS = 32


@dataclass(frozen=True)
class PrintSizes:
    """Sizes of the errors of stickers.

    ``thickness``, ``outline`` and ``retro_shift`` are in radii of a sticker. ``outline`` is the rms
    error of the outline's radius, and ``retro_shift`` the shift at RETRO_ANGLE. ``unevenness`` is
    the rms variation of the brightness relative to its mean. ``rim`` is the brightness of the rim's
    side, 0 for that of the ring and 1 for that of the sticker.
    """

    thickness: float = 0.0
    rim: float = 1.0
    unevenness: float = 0.0
    outline: float = 0.0
    retro_shift: float = 0.0

    def drawn(self, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Draw the coefficients of brightness (n, 5) and of the outline (n, 8) of n stickers."""
        prints = self.unevenness / np.sqrt(PRINT_MODES) * rng.standard_normal((count, PRINT_MODES))
        # The mean square of each harmonic is half the sum of the squares of its coefficients.
        size = self.outline / np.sqrt(len(HARMONICS))
        return prints, size * rng.standard_normal((count, OUTLINE_MODES))


@dataclass(frozen=True)
class SeenStickers:
    """Views of k stickers by a camera.

    to_image  (k, 2, 2), derivative d(pixels) / d(u, v) at the centre
    slopes    (k, 2), apparent shift, in radii, of a point one radius below the sticker's face
    """

    to_image: Array
    slopes: Array

    @classmethod
    def of(
        cls, centres: Array, normals: Array, axes: Array, radius: float, jacobians: Array
    ) -> SeenStickers:
        """Return the views of stickers with centres and normals (k, 3), and axes u, v (k, 3, 2).

        All are in camera axes. ``radius`` is that of the stickers, m, and ``jacobians`` (k, 2, 3)
        are the derivatives d(pixels) / d(point).
        """
        across = np.einsum("kij,ki->kj", axes, centres)
        facing = np.einsum("ki,ki->k", normals, centres)
        return cls(radius * jacobians @ axes, across / facing[:, None])

    @classmethod
    def through(
        cls, focal_lengths: Array, centres: Array, normals: Array, radius: float
    ) -> SeenStickers:
        """Return the views through a perfect lens, with any axes in the planes of the stickers.

        Centres and normals are (k, 3) in camera axes, and ``focal_lengths`` (2,) in px.
        """
        axes = np.linalg.svd(normals[:, None])[2][:, 1:].swapaxes(1, 2)
        return cls.of(centres, normals, axes, radius, pinhole_slopes(focal_lengths, centres))

    @property
    def retro_shifts(self) -> Array:
        """Directions (k, 2) away from the camera in (u, v), scaled by angle of view / RETRO_ANGLE.

        The shift of a retro-reflective sticker is ``PrintSizes.retro_shift`` times its direction.
        """
        size = np.linalg.norm(self.slopes, axis=1)
        factor = np.arctan(size) / RETRO_ANGLE / np.where(size > 0.0, size, 1.0)
        return -factor[:, None] * self.slopes

    def centre_shifts(self, rims: Array) -> Array:
        """Return the shifts (k, 2, ...) px of the centres that movements of the rims cause.

        ``rims`` (k, RIM_POINTS, ...) px are the movements along the rim's normal in the image.
        """
        normals, lengths = self._rim
        weights = lengths[:, None] * normals
        matrix = np.einsum("kip,kjp->kij", weights, normals)
        right_hand_side = np.einsum("kip,kp...->ki...", weights, rims)
        flat = right_hand_side.reshape(*right_hand_side.shape[:2], -1)
        return np.asarray(np.linalg.solve(matrix, flat).reshape(right_hand_side.shape))

    @property
    def _rim(self) -> tuple[Array, Array]:
        """Normals (k, 2, RIM_POINTS) of the rims in the image, and lengths per unit of angle."""
        along = np.stack([-CIRCLE[1], CIRCLE[0]])
        normals = np.linalg.inv(self.to_image).swapaxes(1, 2) @ CIRCLE
        normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        return normals, np.linalg.norm(self.to_image @ along, axis=1)

    def rims_of_growth(self, growth: Array) -> Array:
        """Return the movements (k, RIM_POINTS, ...) px of rims that grow in (u, v) by ``growth``.

        ``growth`` (k, RIM_POINTS, ...) is in radii, along the direction from the centre.
        """
        steps = 1.0 / np.linalg.norm(np.linalg.inv(self.to_image).swapaxes(1, 2) @ CIRCLE, axis=1)
        return np.asarray(steps.reshape(*steps.shape, *(1,) * (growth.ndim - 2)) * growth)

    def shifts_of_kind(self, sizes: PrintSizes) -> Array:
        """Return the shifts (k, 2, 2) px of the centres due to thickness and retro-reflection.

        The last axis has the cause, thickness first. The same view shifts all stickers alike.
        """
        rims = self.rims_of_growth(sizes.thickness * sizes.rim * self.rim_growth)
        retro = sizes.retro_shift * np.einsum("kij,kj->ki", self.to_image, self.retro_shifts)
        return np.stack([self.centre_shifts(rims), retro], axis=-1)

    @property
    def rim_growth(self) -> Array:
        """Growth (k, RIM_POINTS) of outlines by the side of the rim, per radius of thickness."""
        return np.maximum(self.slopes @ CIRCLE, 0.0)


def pinhole_slopes(focal_lengths: Array, points: Array) -> Array:
    """Return the derivatives d(pixels) / d(point) (k, 2, 3) of points (k, 3) in camera axes."""
    slopes = np.zeros((len(points), 2, 3))
    for i, focal in enumerate(focal_lengths):
        slopes[:, i, i] = focal / points[:, 2]
        slopes[:, i, 2] = -focal * points[:, i] / points[:, 2] ** 2
    return slopes


def outline_modes(angle: Array) -> Array:
    """Return the modes (..., 8) of the outline at angles: cosine and sine of each harmonic."""
    return np.stack([wave(k * angle) for k in HARMONICS for wave in (np.cos, np.sin)], axis=-1)


_ANGLES = 2.0 * np.pi * np.arange(RIM_POINTS) / RIM_POINTS
CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)])  # points (2, RIM_POINTS) of the unit circle
CIRCLE.setflags(write=False)
