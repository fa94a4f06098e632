"""Radius of a board's dots as a picture shows it, whatever the board file says."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cmmsim.geometry.pose import Array

CELL_SIDE = 41  # samples along each side of the square around a dot
EXTREMES = (2.0, 98.0)  # percentiles of a cell whose middle parts ground from dot
LARGEST_GAP = 0.1  # of the board's radius, by which the measured one may differ: more costs the dots' correction 20 %


def covered_radius(bright: NDArray[np.uint8], centres: Array, steps: Array) -> float:
    """Median radius of bright dots in units of the reach of the cells: half the distance to the nearest neighbour.

    Parameters: image; centres (n,2) px; steps (n,2,2) px that carry the unit disc to each dot's cell. In each cell the
    grey values' share of the step from ground to dot adds up to the dot's area. Dots that blur leaves without a level
    top seem larger: of 2.5 px radius, blurred by 1 px, by a quarter.
    """
    ticks = np.linspace(-1.0, 1.0, CELL_SIDE)
    within = np.hypot(*np.meshgrid(ticks, ticks)) <= 1.0
    cell = np.stack(np.meshgrid(ticks, ticks), axis=-1)[within]
    places = (centres[:, None] + cell @ steps.swapaxes(1, 2)).astype(np.float32)
    values = cv2.remap(bright, places[..., 0], places[..., 1], cv2.INTER_LINEAR).astype(float)
    middle = np.percentile(values, EXTREMES, axis=1).mean(axis=0)[:, None]
    ground = np.nanmedian(np.where(values <= middle, values, np.nan), axis=1)
    dot = np.nanmedian(np.where(values >= middle, values, np.nan), axis=1)
    area = (values.mean(axis=1) - ground) / np.maximum(dot - ground, 1.0)
    return float(np.sqrt(max(np.median(area), 0.0)))


def differs(measured: float | None, given: float | None) -> bool:
    """Whether a measured radius contradicts a given one; not where either is missing."""
    return measured is not None and given is not None and bool(abs(measured - given) > LARGEST_GAP * given)
