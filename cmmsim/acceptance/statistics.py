"""Statistics of errors with 95 % intervals, and published values for comparison.

The published values are those of makers and laboratories for real instruments. They come from
different tests with different volumes and targets, and not from this package.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from cmmsim.errors import ShapeError
from cmmsim.geometry.pose import Array

# Probability that an interval contains the true value.
LEVEL = 0.95
# Number of resamples of the bootstrap.
RESAMPLES = 1000

Interval = tuple[float, float]


@dataclass(frozen=True)
class Statistics:
    """Number, mean, root mean square, 95th percentile and maximum of values, in their unit.

    ``interval`` contains the 95 % intervals of mean, rms and p95 by name, from a block bootstrap.
    """

    count: int
    mean: float
    rms: float
    p95: float
    maximum: float
    interval: dict[str, Interval]


def summarise(values: Array, rng: np.random.Generator, block: int = 1) -> Statistics:
    """Return the statistics of values (n,), which are magnitudes of errors.

    Neighbouring values can depend on each other, so blocks of ``block`` values are resampled.
    scipy.stats.bootstrap cannot do this, because it resamples single values only. Raises ShapeError
    if there are no values, or if a value is not finite.
    """
    _require_finite(values)
    starts = rng.integers(0, len(values), (RESAMPLES, -(-len(values) // block)))
    # blocks continue at the beginning of the values, so that all values are drawn equally often
    drawn = ((starts[:, :, None] + np.arange(block)) % len(values)).reshape(RESAMPLES, -1)[
        :, : len(values)
    ]
    limits = {
        key: np.percentile(resampled, [50.0 * (1.0 - LEVEL), 50.0 * (1.0 + LEVEL)])
        for key, resampled in _mean_rms_p95(values[drawn]).items()
    }
    by_name = {name: float(value) for name, value in _mean_rms_p95(values).items()}
    return Statistics(
        len(values),
        **by_name,
        maximum=float(values.max()),
        interval={key: (float(low), float(high)) for key, (low, high) in limits.items()},
    )


def _mean_rms_p95(values: Array) -> dict[str, Array]:
    """Return mean, root mean square and 95th percentile of values (..., n)."""
    return {
        "mean": np.mean(values, axis=-1),
        "rms": np.sqrt(np.mean(values**2, axis=-1)),
        "p95": np.percentile(values, 95.0, axis=-1),
    }


def interval_of_mean(values: Array) -> Interval:
    """Return Student's 95 % interval of the mean of independent normal values (n,).

    Raises ShapeError for fewer than two values, and if a value is not finite.
    """
    _require_finite(values)
    if len(values) < 2:
        raise ShapeError("the interval of a mean needs at least two values, got 1")
    half = float(
        stdtrit(len(values) - 1, 0.5 + 0.5 * LEVEL) * values.std(ddof=1) / np.sqrt(len(values))
    )
    return float(values.mean()) - half, float(values.mean()) + half


def _require_finite(values: Array) -> None:
    """Raise ShapeError unless values (n,) are at least one and all finite."""
    if values.ndim != 1 or len(values) == 0 or not np.all(np.isfinite(values)):
        raise ShapeError(
            "statistics need at least one value and only finite values (n,), got shape "
            f"{values.shape}"
        )


@dataclass(frozen=True)
class PublishedFigure:
    """Accuracy or latency that was published for an instrument.

    ``value`` is in the published ``unit``. ``note`` states how the value was published.
    """

    instrument: str
    quantity: str
    value: float
    unit: str
    note: str


C_TRACK_STATIC_MM = 0.05
PUBLISHED = (
    PublishedFigure(
        "Creaform C-Track 780", "position, static", C_TRACK_STATIC_MM, "mm", "published as ±"
    ),
    PublishedFigure("Creaform C-Track 780", "orientation, static", 0.05, "deg", "published as ±"),
    PublishedFigure("Creaform C-Track 780", "position, moving", 0.20, "mm", "published as ±"),
    PublishedFigure("Creaform C-Track 780", "orientation, moving", 0.10, "deg", "published as ±"),
    PublishedFigure("NDI Polaris Vega", "position, static", 0.045, "mm", "published figure"),
    PublishedFigure("NDI Polaris Vega", "latency", 14.2, "ms", "published figure"),
    PublishedFigure("Vicon", "position, static", 0.15, "mm", "published figure"),
    PublishedFigure(
        "NIST, 12 cameras",
        "position, static",
        0.02,
        "mm",
        "published, bar with markers at both ends",
    ),
    PublishedFigure(
        "NIST, 12 cameras",
        "position, moving",
        0.2,
        "mm",
        "published, bar with markers at both ends",
    ),
)


def published(quantity: str) -> tuple[PublishedFigure, ...]:
    """Return the published values of one quantity, such as "position, static".

    The result can be empty.
    """
    return tuple(figure for figure in PUBLISHED if figure.quantity == quantity)
