"""How the bar is moved: two rasters in three orientations of the bar, after standing still where each begins.

As in ASTM E3064-16 one raster goes to and fro along the volume's x axis while it advances along y, the other the other
way round, and the bar is held in three orientations. It is not held along the line of sight, where flat stickers cannot
be seen, but turned by ``TOWARDS_DEPTH`` from the image plane. On top of that it turns smoothly about all its axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cmmsim.acceptance.artefact import facing_rotation
from cmmsim.acceptance.artefact_sensor import pose_in_base
from cmmsim.acceptance.bar import HALF_LENGTH, HALF_WIDTH
from cmmsim.acceptance.volume import MeasuringVolume
from cmmsim.acceptance_errors import AcceptanceError
from cmmsim.geometry.pose import Array, rotation_exp

SECONDS = 3.0  # of motion a run
CYCLES = 1.5  # to and fro in this time
TURN = np.deg2rad(8.0)  # reach of the turning about each axis
TURN_CYCLES = np.array([1.0, 1.5, 0.5])
TOWARDS_DEPTH = np.deg2rad(35.0)
STEP = 1e-4  # s, of the difference quotient of a path
SPEED_SAMPLES = 100
RASTERS = {"x": 0, "y": 1}
ORIENTATIONS = {
    "along x": np.array([1.0, 0.0, 0.0]),
    "along y": np.array([0.0, 1.0, 0.0]),
    "towards depth": np.array([np.cos(TOWARDS_DEPTH), 0.0, np.sin(TOWARDS_DEPTH)]),
}


@dataclass(frozen=True)
class BarPath:
    """name; fast: index of the raster's axis; along (3,): direction of the bar, volume axes."""

    name: str
    fast: int
    along: Array
    volume: MeasuringVolume

    def pose(self, time: float) -> Array:
        """Pose (6,) of the bar in the base frame, ``time`` s after it starts to move, at rest there."""
        phase = 2.0 * np.pi * time / SECONDS
        slow = -np.cos(0.5 * phase) * self.reach
        slow[self.fast] = -np.cos(CYCLES * phase) * self.reach[self.fast]
        turn = rotation_exp(-TURN * np.cos(TURN_CYCLES * phase))
        rotation = facing_rotation(self.along, np.array([0.0, 0.0, -1.0])) @ turn
        return pose_in_base(self.volume.base_from_volume, rotation, slow)

    def pose_rate(self, time: float) -> Array:
        """Rate (6,) of the pose, by central differences."""
        return (self.pose(time + STEP) - self.pose(time - STEP)) / (2.0 * STEP)

    @property
    def largest_speed(self) -> float:
        """Largest speed of the bar's middle, m/s."""
        times = np.linspace(0.0, SECONDS, SPEED_SAMPLES)
        return max(float(np.linalg.norm(self.pose_rate(time)[:3])) for time in times)

    @property
    def reach(self) -> Array:
        """Largest distance (3,) of the bar's middle from that of the volume, so that the bar stays inside, m."""
        return 0.5 * self.volume.size - room_of_bar(self.along)


def room_of_bar(along: Array) -> Array:
    """Half sides (3,) of the cuboid in which a bar that turns by up to TURN stays, m."""
    across = HALF_WIDTH + HALF_LENGTH * np.sqrt(3.0) * np.sin(TURN)
    return np.asarray(HALF_LENGTH * np.abs(along) + across * np.sqrt(1.0 - along**2))


def bar_paths(volume: MeasuringVolume) -> tuple[BarPath, ...]:
    """The six paths of a volume. Raises AcceptanceError when the bar does not find room in it."""
    paths = tuple(
        BarPath(f"raster {raster}, bar {name}", axis, along, volume)
        for raster, axis in RASTERS.items()
        for name, along in ORIENTATIONS.items()
    )
    for path in paths:
        if path.reach.min() <= 0.0:
            needed = " x ".join(f"{2e3 * v:.0f}" for v in room_of_bar(path.along))
            raise AcceptanceError(f"{path.name}: the bar needs {needed} mm, the volume has {volume}")
    return paths
