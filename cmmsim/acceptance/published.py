"""Figures that makers and laboratories have published for real instruments, as they stand beside ours.

Each comes with its own test, volume and targets; none of them was measured here.
"""

from __future__ import annotations

from dataclasses import dataclass


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
