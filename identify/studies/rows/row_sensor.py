"""Sensors of rows, and figures of measured poses.

A sensor is taught exactly, or teaches itself, or draws noise without images. An exactly taught
sensor is built once per process for each content of a sensor file. `start_run` begins new noise
streams, so rows do not depend on earlier rows. A sensor from the cache thus gives the same numbers
as a new sensor.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

import cmmsim
from cmmsim.files import SensorFile
from cmmsim.measuring.measurement import lost_measurement, measurement_without_stickers
from cmmsim.teaching import exactly_taught
from identify.arrays import Array
from identify.experiment.sensor_in_loop import DrawnFrames, PoseSensor, SensorPlan, teach
from identify.progress import SilentProgress
from identify.scenario.section import Section
from identify.setup import Setup
from identify.studies.rows.kind import Column, Row

SENSORS_KEPT = 16  # number of cached sensors per process. A sensor takes about a megabyte.
DROPPED = "dropped frame"  # reason for which a drawn frame is lost
# Way of teaching. ``exact``: frames and sticker positions have no error, so rows show observation
# noise alone. ``sensor``: the sensor teaches itself from images, seeded by the row (1.4 s per row).
Teaching = Literal["exact", "sensor"]


class SensorOptions(Section):
    """Options of the sensor."""

    sensor: Literal["drawn", "images"] = Field(
        "drawn",
        description="drawn: noise of the stated covariance; images: measured by the scenario's "
        "renderer",
    )


@dataclass(frozen=True)
class RowSensor:
    """Sensor of a row, and true values for the comparison.

    sensor       The sensor.
    truth        Teaching without error.
    middle (3,)  Middle of the baseline in the base frame, m.
    rim          Mean radiance of a sticker and its ring, as a fraction of white.
    """

    sensor: cmmsim.Sensor
    truth: cmmsim.Taught
    middle: Array
    rim: float


def row_sensor(plan: SensorPlan, teaching: Teaching, seed: int) -> RowSensor:
    """Return a sensor at the beginning of a new run. It does not see the links of the robot."""
    if teaching == "exact":
        built = exact_sensor(plan.file.model_dump_json(), plan.method, plan.renderer)
    else:
        built = _built(plan.file, plan.method, plan.renderer, None, seed)
    built.sensor.start_run(seed)
    return built


@lru_cache(maxsize=SENSORS_KEPT)
def exact_sensor(file_json: str, method: str, renderer: str) -> RowSensor:
    """Return the exactly taught sensor for the content of a sensor file, from a cache."""
    file = SensorFile.model_validate_json(file_json)
    return _built(file, method, renderer, exactly_taught(file), 0)


def _built(
    file: SensorFile, method: str, renderer: str, taught: cmmsim.Taught | None, seed: int
) -> RowSensor:
    sensor = cmmsim.Sensor(file, seed, method, taught, renderer=renderer)
    rim = 0.5 * (file.stickers.sticker_level + file.stickers.ring_level) / 255.0
    return RowSensor(sensor, taught or exactly_taught(file), np.array(file.rig.position), rim)


class DrawnSensor:
    """Sensor that adds Gaussian noise to true poses, without images, and drops frames at random.

    It replaces a `cmmsim.Sensor`. The covariance (6, 6) of the noise is in m and rad.
    """

    sees_bodies = False

    def __init__(self, covariance: Array, dropout: float = 0.0) -> None:
        self._covariance = covariance
        self._dropout = dropout
        self._factor = np.linalg.cholesky(covariance)
        self.start_run(0)

    def start_run(self, seed: int) -> None:
        """Begin a new run with a new noise stream."""
        self._rng = np.random.default_rng(seed)

    def measure(
        self,
        pose: ArrayLike,
        obstacles: Mapping[str, Array] | None = None,
        pose_rate: ArrayLike | None = None,
    ) -> cmmsim.Measurement:
        """Return the pose (6,) with noise. Obstacles and speed have no effect."""
        noise, dropped = self._drawn()
        if dropped:
            return lost_measurement(DROPPED)
        return measurement_without_stickers(np.asarray(pose, dtype=float) + noise, self._covariance)

    def in_advance(self, frames: int) -> DrawnFrames:
        """Draw what the next calls of `measure` would draw, in their place."""
        drawn = [self._drawn() for _ in range(frames)]
        noise = np.array([one for one, _ in drawn]).reshape(frames, 6)
        reasons = [DROPPED if dropped else "" for _, dropped in drawn]
        return DrawnFrames(noise, self._covariance, reasons)

    def _drawn(self) -> tuple[Array, bool]:
        """Return the noise (6,) of the next frame, and whether the frame is dropped."""
        # Noise is also drawn for a dropped frame, so that dropout does not change later noise.
        noise = self._factor @ self._rng.standard_normal(6)
        return noise, self._rng.random() < self._dropout


def rms_um(errors: Array) -> float:
    """Return the root mean square over all entries, in units of 1e-6 (um or urad)."""
    return 1e6 * float(np.sqrt(np.mean(np.square(errors))))


def stated_um(covariances: Array) -> tuple[float, float]:
    """Return the rms standard deviations of positions, um, and orientations, urad.

    Each rms is over poses and axes. covariances (n, 6, 6): covariances of poses, m and rad.
    """
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    return 1e6 * float(np.sqrt(variances[:, :3].mean())), 1e6 * float(
        np.sqrt(variances[:, 3:].mean())
    )


# Figures of rows with measured poses.
POSE_COLUMNS = {
    "position_rms_um": Column(
        "um", "error of the measured position, rms over pictures and axes", main=True
    ),
    "orientation_rms_urad": Column(
        "urad", "error of the measured orientation, rms over pictures and axes", main=True
    ),
    "stated_position_rms_um": Column(
        "um", "error of the measured position according to the sensor's covariance"
    ),
    "stated_orientation_rms_urad": Column(
        "urad", "error of the measured orientation according to the sensor's covariance"
    ),
}


def pose_figures(errors: Array, covariances: Array) -> Row:
    """Return the figures of POSE_COLUMNS.

    Errors have shape (n, 6), stated covariances (n, 6, 6), in m and rad, with n >= 1.
    """
    figures = (rms_um(errors[:, :3]), rms_um(errors[:, 3:]), *stated_um(covariances))
    return dict(zip(POSE_COLUMNS, figures, strict=True))


def row_pose_sensor(setup: Setup, options: SensorOptions) -> PoseSensor:
    """Return the sensor of a row, taught if it has images. Raises the exceptions of the sensor."""
    if options.sensor == "drawn":
        covariance = setup.sensor_plan.covariance(setup.nominal.home_pose)
        return DrawnSensor(covariance, setup.plant.runs.timing.dropout)
    teach(setup.sensor, SilentProgress())
    return setup.sensor
