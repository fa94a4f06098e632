"""Whether the cameras still are as they were: told from the stickers' rigid pattern and the gaps of their rays."""

from cmmsim.drift_watch.finding import Finding
from cmmsim.drift_watch.watch import DriftWatch

__all__ = ["DriftWatch", "Finding"]
