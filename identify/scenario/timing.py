"""Timing of sensor, servo and model: the times of exposures and of their commands.

The sensor file states the timing, with keys without units. A scenario can replace single values.
This module relates the two kinds of keys. It imports the sensor within functions, because the help
of the command line does not need the sensor.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field, ValidationError

from identify.arrays import Array
from identify.scenario.section import Section, quantity
from identify.scenario.settings_file import one_line

if TYPE_CHECKING:
    from cmmsim.files import SensorFile
    from cmmsim.files import Timing as SensorTiming

# The loop must allow a true mean latency this number of standard deviations above the stated one.
LATENCY_STDS = 5.0

# Keys in the file of the sensor, by the keys in ``[timing]`` of a scenario.
IN_FILE = {
    "frame_rate_hz": "frame_rate",
    "exposure_s": "exposure",
    "latency_s": "latency",
    "latency_jitter_s": "latency_jitter",
    "dropout": "dropout",
}


class Timing(Section):
    """Sampling of the pose sensor and of the visual servo.

    Frame rate, exposure, latency, jitter and dropout come from the file of the sensor unless the
    scenario states them. A measured pose is the pose in the middle of its exposure, which is the
    time of its frame.
    """

    frame_rate_hz: float = quantity(
        60.0, "Hz", "stereo frames per second; the servo acts once per frame", gt=0, le=2000
    )
    exposure_s: float = quantity(0.0, "s", "exposure time; 0 is an instant", ge=0, le=1)
    latency_s: float = quantity(
        0.0, "s", "mean latency from the middle of the exposure to the command", ge=0, le=1
    )
    latency_jitter_s: float = quantity(
        0.0, "s", "standard deviation of the latency between frames", ge=0, le=1
    )
    latency_std_s: float = quantity(
        0.0, "s", "standard deviation of the stated mean latency", ge=0, le=0.1
    )
    clock_offset_std_s: float = quantity(
        0.0,
        "s",
        "standard deviation of the offset of the commands' clock in a record; 0 is one clock",
        ge=0,
        le=10,
    )
    clock_drift_std: float = quantity(
        0.0,
        "1",
        "standard deviation of the drift of the commands' clock in a record, s per s",
        ge=0,
        le=0.01,
    )
    dropout: float = quantity(0.0, "1", "probability that a frame is lost", ge=0, le=1)
    hold: Literal["zero", "linear"] = Field("zero", description="joint command between two frames")

    @property
    def frame_period_s(self) -> float:
        """Time between two frames [s]."""
        return 1.0 / self.frame_rate_hz

    def frames(self, duration_s: float) -> int:
        """Return the number of frames in a duration."""
        return round(duration_s * self.frame_rate_hz)

    def frame_times(self, duration_s: float) -> Array:
        """Return the times (N,) [s] of the frames of a run, each in the middle of an exposure.

        The run has whole frames, and its end is excluded.
        """
        return np.arange(self.frames(duration_s), dtype=float) * self.frame_period_s

    def drawn_latencies(self, frames: int, rng: np.random.Generator) -> Array | None:
        """Draw the latency of each frame (frames,) [s], or return None if all equal the mean."""
        return self.of_sensor().drawn_latencies(frames, rng) if self.latency_jitter_s else None

    def of_sensor(self) -> "SensorTiming":
        """Return the same values in the form of a sensor file.

        Raises ValueError if they contradict each other.
        """
        from cmmsim.files import Timing as SensorTiming

        try:
            return SensorTiming(**{theirs: getattr(self, ours) for ours, theirs in IN_FILE.items()})
        except ValidationError as error:
            raise ValueError(f"timing: {error.errors()[0]['ctx']['error']}") from error

    def in_sensor_file(self, sensor: str, changes: Mapping[str, Any]) -> "SensorFile":
        """Return a sensor file (by name or path) with changes by dotted key and this timing."""
        from cmmsim.files import read_sensor_file

        file = read_sensor_file(sensor, changes)
        return file.model_copy(update={"timing": self.of_sensor()})

    def check(self) -> None:
        """Check that the values agree, and that the closed loop can delay commands by the latency.

        Raises ValueError if the values disagree, or if the latency can be too long.
        """
        from dynamics.closed_loop.loop_settings import MAX_DELAY_FRAMES

        # The true mean can be longer than the stated one, within its uncertainty.
        longest = self.of_sensor().largest_latency + LATENCY_STDS * self.latency_std_s
        if longest * self.frame_rate_hz > MAX_DELAY_FRAMES:
            raise ValueError(
                f"timing.latency_s = {self.latency_s:g} s with timing.latency_jitter_s = "
                f"{self.latency_jitter_s:g} s and timing.latency_std_s = {self.latency_std_s:g} s "
                f"reaches {longest:.4g} s, {longest * self.frame_rate_hz:.1f} frames of "
                f"{self.frame_rate_hz:g} Hz; at most {MAX_DELAY_FRAMES} frames are possible"
            )


def completed(
    stated: Timing, sensor: str, changes: Mapping[str, Any]
) -> tuple[Timing, tuple[str, str]]:
    """Return a timing completed from a sensor, and the note and the renderer of the sensor file.

    Values from the sensor do not count as set. With another sensor, they come from that sensor.

    stated   Timing that the scenario states. The other values come from the sensor.
    sensor   Name of a built-in sensor, or path of a sensor's file.
    changes  A scenario's ``[sensor_changes]`` by dotted key.

    Raises ValueError if a change has no effect, because the scenario itself states another value,
    or the timing is not valid. Raises cmmsim.CmmError if there is no such sensor, or its file is
    not valid.
    """
    from cmmsim.files import read_sensor_file

    file = read_sensor_file(sensor, changes)
    of_file = {ours: getattr(file.timing, theirs) for ours, theirs in IN_FILE.items()}
    own = {name: getattr(stated, name) for name in stated.model_fields_set}
    for name in own.keys() & IN_FILE.keys():
        if f"timing.{IN_FILE[name]}" in changes and own[name] != of_file[name]:
            raise ValueError(
                f"sensor_changes.timing.{IN_FILE[name]} = {of_file[name]:g} has no effect where "
                f"the scenario itself states timing.{name} = {own[name]:g}"
            )
    try:
        whole = Timing(**(of_file | own))
    except ValidationError as error:
        raise ValueError(f"timing of the sensor {sensor!r}: {one_line(error, Timing)}") from error
    # The values are validated already. Only the scenario's own count as set.
    timing = Timing.model_construct(_fields_set=set(own), **whole.model_dump())
    return timing, (file.note, file.renderer)


def sensor_names() -> list[str]:
    """Return the names of the built-in sensors."""
    from cmmsim.files import built_in_names

    return built_in_names()


def by_dotted_key(changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the ``[sensor_changes]`` of a scenario by dotted key of the sensor file.

    In the scenario, they can be nested tables.
    """
    from cmmsim.files import dotted

    return dotted(changes)
