"""Artefacts of the tests: long boards with a ridge, stickers on their three upper sides, and the sensor that sees them.

An artefact's frame has x along it, z out of its front side A and the origin in the middle of that side. Sides B and C
slope away from A by SLOPE, so that all stickers are seen from the front.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from cmmsim.files.schema import Body, HalfSpace, Planes, Platform, Rig, SensorFile, StickerPlane
from cmmsim.geometry.pose import Array

H = TypeVar("H", bound=HalfSpace)
SLOPE = np.deg2rad(15.0)
HALF_RIDGE = 0.020  # m: half the width of side A
SIDE = 0.060  # m: width of sides B and C
END = 0.020  # m: the board goes on beyond the outermost stickers
OUT_OF_SIGHT = 100.0  # m behind the cameras


@dataclass(frozen=True)
class StickerRow:
    """Stickers of one side: along (n,) m from the middle of the artefact, and across (n,) m from the edge of side A
    (sides B and C) or from its middle line (side A)."""

    along: ArrayLike
    across: ArrayLike


def board(a: StickerRow, b: StickerRow, c: StickerRow) -> Platform:
    """The sensor-file section of an artefact with rows of stickers on its sides A, B (towards +y) and C (towards -y).

    B's across counts away from A, C's as well.
    """
    reach = max(float(np.abs(row.along).max()) for row in (a, b, c)) + END
    sine, cosine = float(np.sin(SLOPE)), float(np.cos(SLOPE))
    sides = {
        "A": _side((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), a, 1.0),
        "B": _side((0.0, sine, cosine), (0.0, HALF_RIDGE, 0.0), b, 1.0),
        "C": _side((0.0, -sine, cosine), (0.0, -HALF_RIDGE, 0.0), c, -1.0),
    }
    width = HALF_RIDGE + SIDE * cosine
    cuts = [
        _half_space(normal, point)
        for normal, point in (
            ((1.0, 0.0, 0.0), (reach, 0.0, 0.0)),
            ((-1.0, 0.0, 0.0), (-reach, 0.0, 0.0)),
            ((0.0, 1.0, 0.0), (0.0, width, 0.0)),
            ((0.0, -1.0, 0.0), (0.0, -width, 0.0)),
            ((0.0, 0.0, -1.0), (0.0, 0.0, -SIDE * sine - 0.05)),
        )
    ]
    return Platform(planes=Planes(**sides), cuts=cuts, home=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))


def artefact_file(file: SensorFile, artefact: Platform) -> SensorFile:
    """The sensor file with an artefact in place of the platform and nothing else in sight.

    The artefact's stickers sit exactly at their places: they are what its certificate states.
    """
    stickers = file.stickers.model_copy(update={"placement": (0.0, 0.0)})
    return file.model_copy(update={"platform": artefact, "base": _behind(file.base, file.rig), "stickers": stickers})


def facing_rotation(along: Array, towards: Array) -> Array:
    """Rotation (3,3) that lays an artefact's x axis on ``along`` and turns its side A towards ``towards``, both (3,)
    and of any length."""
    x = along / np.linalg.norm(along)
    z = towards - (towards @ x) * x
    z = z / np.linalg.norm(z)
    return np.column_stack([x, np.cross(z, x), z])


def _side(
    normal: tuple[float, float, float], point: tuple[float, float, float], row: StickerRow, sign: float
) -> StickerPlane:
    """u runs along the artefact; v = n x u points to +y on all sides, so that C counts backwards."""
    return StickerPlane(
        normal=normal,
        point=point,
        across=(1.0, 0.0, 0.0),
        stickers=[(float(u), sign * float(v)) for u, v in np.column_stack([row.along, row.across])],
    )


def _half_space(normal: tuple[float, float, float], point: tuple[float, float, float]) -> HalfSpace:
    return HalfSpace(normal=normal, point=point)


def _behind(body: Body, rig: Rig) -> Body:
    """The body moved far behind both cameras."""
    view = np.array(rig.target) - np.array(rig.position)
    shift = -OUT_OF_SIGHT * view / np.linalg.norm(view)

    planes = Planes(A=_moved(body.planes.A, shift), B=_moved(body.planes.B, shift), C=_moved(body.planes.C, shift))
    return body.model_copy(update={"planes": planes, "cuts": [_moved(cut, shift) for cut in body.cuts]})


def _moved(half_space: H, shift: Array) -> H:
    x, y, z = np.array(half_space.point) + shift
    return half_space.model_copy(update={"point": (float(x), float(y), float(z))})
