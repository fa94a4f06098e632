"""From the exposure to the use of a pose: a latency that differs from frame to frame."""

from __future__ import annotations

import numpy as np

from cmmsim.files.schema import Timing
from cmmsim.geometry.pose import Array

WIDEST = 3.0  # standard deviations: no frame's latency is farther from the mean


def largest_latency(timing: Timing) -> float:
    """The longest latency that can be drawn, s."""
    return timing.latency + _widest_deviation(timing)


def drawn_latencies(timing: Timing, frames: int, rng: np.random.Generator) -> Array:
    """Latency of each frame (frames,), s, from the middle of its exposure to the use of its pose.

    Normal about ``timing.latency`` with standard deviation ``timing.latency_jitter``, clipped on both sides to 3 of
    those or to the latency itself, whichever is less: none is negative, and the mean stays the stated latency.
    """
    widest = _widest_deviation(timing)
    return timing.latency + np.clip(rng.normal(0.0, timing.latency_jitter, frames), -widest, widest)


def _widest_deviation(timing: Timing) -> float:
    return min(WIDEST * timing.latency_jitter, timing.latency)
