"""The rigid bar: two clusters of six stickers at its ends, each a rigid body of its own to the sensor."""

from __future__ import annotations

import numpy as np

from cmmsim.acceptance.artefact import HALF_RIDGE, SIDE, StickerRow, board
from cmmsim.acceptance.artefact_sensor import part_of_body
from cmmsim.files.marked_body import MarkedBody
from cmmsim.files.schema import Platform

LENGTH = 0.300  # m between the origins of the clusters, which lie on the bar's x axis
HALF_LENGTH, HALF_WIDTH = 0.5 * LENGTH + 0.065, HALF_RIDGE + SIDE
END_FROM_END = np.eye(4)  # first_from_second, what is true of the two clusters
END_FROM_END[0, 3] = LENGTH
END_FROM_END.setflags(write=False)


def rigid_bar() -> Platform:
    """The sensor-file section of the bar. The clusters differ, so that one cannot be taken for the other."""
    return board(
        StickerRow((-0.190, -0.115, 0.110, 0.186), (0.006, -0.010, 0.010, -0.004)),
        StickerRow((-0.172, -0.120, 0.126, 0.194), (0.018, 0.045, 0.044, 0.030)),
        StickerRow((-0.194, -0.138, 0.108, 0.160), (0.044, 0.022, 0.028, 0.046)),
    )


def bar_ends(bar: MarkedBody) -> tuple[MarkedBody, MarkedBody]:
    """The clusters at -x and at +x, with their origins on the bar's axis, ``LENGTH`` apart, and axes like the bar's."""
    first = np.flatnonzero(bar.nominal[:, 0] < 0.0)
    second = np.flatnonzero(bar.nominal[:, 0] > 0.0)
    middle = np.array([0.5 * LENGTH, 0.0, 0.0])
    return (
        part_of_body(bar, "first end of the bar", first, -middle),
        part_of_body(bar, "second end of the bar", second, middle),
    )
