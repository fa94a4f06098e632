"""Statistics of errors with 95 % intervals, and the published figures that stand beside ours.

Published figures are those of makers and laboratories for real instruments. Each comes with its own test, volume and
targets; none of them was measured here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.stats import sem
from scipy.stats import t as student

from cmmsim.errors import ShapeError
from cmmsim.geometry.pose import Array

LEVEL = 0.95
RESAMPLES = 1000

Interval = tuple[float, float]


@dataclass(frozen=True)
class Statistics:
    """count of values; mean, rms, 95th percentile and maximum, in the unit of the values; interval: 95 % interval of
    mean, rms and p95 by resampling blocks (a maximum has none)."""

    count: int
    mean: float
    rms: float
    p95: float
    maximum: float
    interval: dict[str, Interval]


def summarise(values: Array, rng: np.random.Generator, block: int = 1) -> Statistics:
    """Statistics of magnitudes (n,) of errors.

    block: neighbours that are drawn together, because they are not independent. Raises ShapeError for no values or
    values that are not finite.
    """
    _require_finite(values)
    starts = rng.integers(0, len(values), (RESAMPLES, -(-len(values) // block)))
    drawn = ((starts[:, :, None] + np.arange(block)) % len(values)).reshape(RESAMPLES, -1)[:, : len(values)]
    sampled = values[drawn]
    interval = {name: _percentile_interval(figure(sampled)) for name, figure in _FIGURES.items()}
    mean, rms, p95 = (float(figure(values)) for figure in _FIGURES.values())
    return Statistics(len(values), mean, rms, p95, float(values.max()), interval)


def interval_of_mean(values: Array) -> Interval:
    """95 % interval of the mean of independent normal values (n,), n >= 2, by Student's t."""
    _require_finite(values)
    if len(values) < 2:
        raise ShapeError("the interval of a mean needs at least two values, got 1")
    low, high = student.interval(LEVEL, len(values) - 1, loc=values.mean(), scale=sem(values))
    return float(low), float(high)


def _rms(values: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(values**2, axis=-1)))


_FIGURES: dict[str, Callable[[Array], Array]] = {
    "mean": lambda values: np.asarray(values.mean(axis=-1)),
    "rms": _rms,
    "p95": lambda values: np.asarray(np.percentile(values, 95.0, axis=-1)),
}


def _percentile_interval(samples: Array) -> Interval:
    low, high = np.percentile(samples, [50.0 * (1.0 - LEVEL), 50.0 * (1.0 + LEVEL)])
    return float(low), float(high)


def _require_finite(values: Array) -> None:
    if values.ndim != 1 or len(values) == 0 or not np.all(np.isfinite(values)):
        raise ShapeError(f"statistics need at least one value and finite values (n,), got shape {values.shape}")


@dataclass(frozen=True)
class PublishedFigure:
    """instrument; quantity; value with its unit as published; note: what kind of figure it is."""

    instrument: str
    quantity: str
    value: float
    unit: str
    note: str


C_TRACK_STATIC_MM = 0.05
PUBLISHED = (
    PublishedFigure("Creaform C-Track 780", "position, static", C_TRACK_STATIC_MM, "mm", "published as ±"),
    PublishedFigure("Creaform C-Track 780", "orientation, static", 0.05, "deg", "published as ±"),
    PublishedFigure("Creaform C-Track 780", "position, moving", 0.20, "mm", "published as ±"),
    PublishedFigure("Creaform C-Track 780", "orientation, moving", 0.10, "deg", "published as ±"),
    PublishedFigure("NDI Polaris Vega", "position, static", 0.045, "mm", "published figure"),
    PublishedFigure("NDI Polaris Vega", "latency", 14.2, "ms", "published figure"),
    PublishedFigure("Vicon", "position, static", 0.15, "mm", "published figure"),
    PublishedFigure("NIST, 12 cameras", "position, static", 0.02, "mm", "published, bar with markers at both ends"),
    PublishedFigure("NIST, 12 cameras", "position, moving", 0.2, "mm", "published, bar with markers at both ends"),
)


def published(quantity: str) -> tuple[PublishedFigure, ...]:
    """Published figures of one quantity, such as "position, static"; none for a quantity that nobody published."""
    return tuple(figure for figure in PUBLISHED if figure.quantity == quantity)
