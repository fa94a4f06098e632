"""Sections of a sensor file for lenses, light, and the imperfections of printed stickers.

All keys have defaults with which stickers are flat, round and evenly bright, and images are sharp
and free of other light.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from cmmsim.checks import Section
from cmmsim.files.quantities import Bounds, Direction3, Length, Level, Vector3, quantity

# Standard deviation of the narrowest point spread that the samples of drawn images resolve, px.
NARROWEST_PSF = 0.1
Share = Annotated[float, Bounds(0.0, 1.0)]
Offset = Annotated[float, Bounds(-100.0, 100.0, "px")]


class Lens(Section):
    """Blur, vignetting and reflections of both lenses.

    Distortion belongs to the entries of each camera. Teaching warns of a point spread that carries
    the light of the bodies over the rings of stickers, which moves their centres. The vignetting
    grows with the square of the distance from the principal point. With an ``aperture``, a point
    out of focus is a blur circle of the diameter focal length x aperture x abs(1 / focus - 1 /
    depth), px. It is drawn as a Gaussian of the same variance.
    """

    psf_px: Annotated[float, Field(ge=0.0, le=4.0)] = quantity(
        0.0, "px", "standard deviation of the Gaussian point spread"
    )
    vignetting: Annotated[float, Field(ge=0.0, le=0.9)] = quantity(
        0.0, "", "fraction of the light that is lost in the farthest corner of the image"
    )
    aperture: Annotated[float, Bounds(1e-5, 0.2, "m", zero=True)] = quantity(
        0.0, "m", "diameter of the aperture; 0 means that all depths are in focus"
    )
    focus: Length | None = quantity(
        None, "m", "depth in focus; without it, the distance from the cameras to rig.target"
    )
    ghost: Annotated[float, Bounds(0.0, 0.9)] = quantity(
        0.0, "", "light of the ghost, a copy by reflection, as a fraction of the image's light"
    )
    ghost_offset_px: tuple[Offset, Offset] = quantity(
        (6.0, 4.0), "px", "offset of the ghost from the image, whole pixels"
    )
    known: bool = quantity(True, "", "true if the estimator knows aperture, focus and ghost")

    @model_validator(mode="after")
    def _drawable(self) -> Lens:
        """Raise ValueError for a point spread or a ghost that cannot be drawn."""
        if 0.0 < self.psf_px < NARROWEST_PSF:
            raise ValueError(f"psf_px {self.psf_px:g} must be 0 or at least {NARROWEST_PSF:g} px")
        if any(offset != round(offset) for offset in self.ghost_offset_px):
            raise ValueError(
                f"ghost_offset_px {list(self.ghost_offset_px)} must be whole numbers of pixels"
            )
        return self


class Lamp(Section):
    """Lamp that shines on the stickers, at a position, or in a direction if it is far away."""

    place: Vector3 | None = quantity(None, "m", "position of the lamp in the base frame")
    direction: Direction3 | None = quantity(
        None, "", "direction from the scene to a lamp that is far away, in the base frame"
    )
    strength: Annotated[float, Bounds(0.0, 10.0)] = quantity(
        1.0, "", "fraction of its grey level that a face at rig.target has if it faces the lamp"
    )

    @model_validator(mode="after")
    def _one_place(self) -> Lamp:
        """Raise ValueError unless the lamp has either a position or a direction, not zero."""
        if (self.place is None) == (self.direction is None):
            raise ValueError("a lamp needs either place or direction")
        if self.direction is not None and not any(self.direction):
            raise ValueError("direction [0, 0, 0] of a lamp must not be zero")
        return self


class Light(Section):
    """Light on the stickers and their rings, and bright objects behind them.

    Without lamps, stickers have their grey level from all sides, as retro-reflective stickers have
    in the light of the cameras. With lamps, the level is multiplied by the sum of ``ambient`` and
    the light of all lamps. The light of a lamp is proportional to the cosine of its angle of
    incidence and, if it has a position, to the inverse square of its distance.
    """

    lamps: tuple[Lamp, ...] = quantity((), "", "lamps")
    ambient: Share = quantity(
        0.0, "", "fraction of the grey level without lamp light; used only with lamps"
    )
    fall_off: Annotated[float, Bounds(0.0, 20.0)] = quantity(
        0.0, "", "power of the cosine of the angle of view with which stickers become darker"
    )
    clutter: Annotated[int, Field(ge=0, le=10_000)] = quantity(
        0, "", "number of bright objects in the background of each image"
    )
    clutter_level: Level = quantity(255, "", "grey level of the brightest of these objects")
    clutter_seed: Annotated[int, Field(ge=0)] = quantity(0, "", "seed of these objects")


class Print(Section):
    """Thickness and print of the stickers, which are the same in all frames.

    ``unevenness`` and ``outline`` are drawn anew for each sticker, from ``seed``. With ``known``,
    the estimator knows the sizes of these errors, but not their values. It counts them among the
    errors that all frames have in common, with standard deviations of these sizes. The part of the
    errors that changes from frame to frame counts as noise.
    """

    thickness: Annotated[float, Bounds(1e-6, 5e-3, "m", zero=True)] = quantity(
        0.0, "m", "height of the printed faces above their rings, whose rims are seen from aside"
    )
    rim_level: Level | None = quantity(
        None, "", "grey level of the rims of thick stickers; without it, that of the stickers"
    )
    unevenness: Annotated[float, Bounds(0.0, 0.5)] = quantity(
        0.0, "", "relative differences of brightness within a sticker, rms"
    )
    outline: Annotated[float, Bounds(1e-7, 1e-3, "m", zero=True)] = quantity(
        0.0, "m", "differences of outlines from circles, rms"
    )
    retro_shift: Annotated[float, Bounds(-1e-3, 1e-3, "m")] = quantity(
        0.0,
        "m",
        "shift of retro-reflective stickers away from the camera at an angle of view of 40 "
        "degrees, in their planes",
    )
    seed: Annotated[int, Field(ge=0)] = quantity(0, "", "seed of unevenness and outlines")
    known: bool = quantity(True, "", "true if the estimator knows the sizes of these errors")

    @property
    def is_perfect(self) -> bool:
        """True if stickers are flat, round and evenly printed."""
        return not np.any([self.thickness, self.unevenness, self.outline, self.retro_shift])
