"""Plant whose commands act later than its record says."""

from dataclasses import dataclass, replace

import numpy as np

from dynamics.closed_loop import IDEAL, ClosedLoopRun, Reference, Sensor
from dynamics.control.law_interface import LawInLoop
from identify.arrays import Array
from identify.experiment.plant import Plant


@dataclass(frozen=True, eq=False)
class LatePlant(Plant):
    """Plant whose commands act later by `late_s`, and by `late_per_s` more in each second."""

    late_s: float = 0.0
    late_per_s: float = 0.0

    def run(
        self,
        reference: Reference,
        sensor: Sensor = IDEAL,
        latencies: Array | None = None,
        load: Array | None = None,
        law: LawInLoop | None = None,
    ) -> ClosedLoopRun:
        """Follow a reference, as `Plant.run` does."""
        timing = self.settings.timing
        frames = len(reference.poses)
        stated = np.full(frames, timing.latency_s) if latencies is None else latencies
        seconds = np.arange(frames) / timing.frame_rate_hz
        true = stated + self.late_s + self.late_per_s * seconds
        return super().run(reference, sensor, true, load, law)


def late_plant(plant: Plant, late_s: float, late_per_s: float) -> LatePlant:
    """Return a plant whose commands act later, or later still if they are late already."""
    if isinstance(plant, LatePlant):
        return replace(
            plant, late_s=plant.late_s + late_s, late_per_s=plant.late_per_s + late_per_s
        )
    return LatePlant(**vars(plant), late_s=late_s, late_per_s=late_per_s)
