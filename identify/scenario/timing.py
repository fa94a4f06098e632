"""When the sensor looks and when its poses are used: the one timing of sensor, servo and model.

The sensor's file states it, in keys without units, and a scenario may state single values
otherwise; this is the only place that knows both spellings. Imports of the sensor stand in the
functions: the command line's help must not wait for them.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field, ValidationError

from identify.arrays import Array
from identify.scenario.section import Section, quantity
from identify.scenario.settings_file import one_line

if TYPE_CHECKING:
    from cmmsim.files import Timing as SensorTiming

LATENCY_STDS = 5.0
"""Standard deviations by which the mean latency may be longer than stated."""

IN_FILE = {
    "frame_rate_hz": "frame_rate",
    "exposure_s": "exposure",
    "latency_s": "latency",
    "latency_jitter_s": "latency_jitter",
    "dropout": "dropout",
}
"""The sensor file's key of each key of a scenario's ``[timing]``."""


class Timing(Section):
    """Sampling of the pose sensor and of the visual servo.

    All but the hold is the sensor file's where a scenario does not state it. A measured pose is
    that in the middle of its exposure, which is the time of its frame.
    """

    frame_rate_hz: float = quantity(
        60.0, "Hz", "stereo frames a second; the servo acts once a frame", gt=0, le=2000
    )
    exposure_s: float = quantity(
        0.0, "s", "time in which a picture gathers light; 0 is an instant", ge=0, le=1
    )
    latency_s: float = quantity(
        0.0, "s", "mean delay from the middle of the exposure to the command", ge=0, le=1
    )
    latency_jitter_s: float = quantity(
        0.0, "s", "standard deviation of the latency between frames", ge=0, le=1
    )
    latency_std_s: float = quantity(
        0.0, "s", "how well the mean latency is known, standard deviation", ge=0, le=0.1
    )
    dropout: float = quantity(0.0, "1", "probability that a frame is lost on its way", ge=0, le=1)
    hold: Literal["zero", "linear"] = Field("zero", description="joint command between two frames")

    @property
    def frame_period_s(self) -> float:
        """Time between two frames [s]."""
        return 1.0 / self.frame_rate_hz

    def frames(self, duration_s: float) -> int:
        """Number of frames in a duration."""
        return round(duration_s * self.frame_rate_hz)

    def frame_times(self, duration_s: float) -> Array:
        """Instants of exposure (N,) [s], each the middle of one, of a run: whole frames, its end
        excluded.
        """
        return np.arange(self.frames(duration_s), dtype=float) * self.frame_period_s

    def drawn_latencies(self, frames: int, rng: np.random.Generator) -> Array | None:
        """Latency of each frame (frames,) [s] of a run; None where all have the mean."""
        return self.of_sensor().drawn_latencies(frames, rng) if self.latency_jitter_s else None

    def of_sensor(self) -> "SensorTiming":
        """The same values as a sensor's file holds them. Raises ValueError: values that contradict
        each other.
        """
        from cmmsim.files import Timing as SensorTiming

        try:
            return SensorTiming(**{theirs: getattr(self, ours) for ours, theirs in IN_FILE.items()})
        except ValidationError as error:
            raise ValueError(f"timing: {error.errors()[0]['ctx']['error']}") from error

    def check(self) -> None:
        """Refuse values that contradict each other, and a latency that the closed loop cannot hold
        back.

        Raises ValueError: with the longest latency that is possible.
        """
        from dynamics.closed_loop.loop_settings import (
            MAX_DELAY_FRAMES,
        )

        longest = self.of_sensor().largest_latency + LATENCY_STDS * self.latency_std_s
        if longest * self.frame_rate_hz > MAX_DELAY_FRAMES:
            raise ValueError(
                f"timing.latency_s = {self.latency_s:g} s with timing.latency_jitter_s = "
                f"{self.latency_jitter_s:g} s "
                f"and timing.latency_std_s = {self.latency_std_s:g} s reaches {longest:.4g} s, "
                f"{longest * self.frame_rate_hz:.1f} frames of {self.frame_rate_hz:g} Hz; at most "
                f"{MAX_DELAY_FRAMES} "
                "frames are possible"
            )


def completed(stated: Timing, sensor: str, changes: Mapping[str, Any]) -> tuple[Timing, str]:
    """Timing with what it does not state itself from a built-in sensor or a sensor's file, and the
    note of that file.

    What comes from the sensor does not count as set: with another sensor it is taken from that one.
    ``changes``: a scenario's ``[sensor_changes]`` by dotted key.

    Raises ValueError: changes without effect, as the scenario itself states otherwise; or a timing
    that none may have. Raises cmmsim.CmmError: no such sensor, or a bad file.
    """
    from cmmsim.files import read_sensor_file

    file = read_sensor_file(sensor, changes)
    of_file = {ours: getattr(file.timing, theirs) for ours, theirs in IN_FILE.items()}
    own = {name: getattr(stated, name) for name in stated.model_fields_set}
    for name in own.keys() & IN_FILE.keys():
        if f"timing.{IN_FILE[name]}" in changes and own[name] != of_file[name]:
            raise ValueError(
                f"sensor_changes.timing.{IN_FILE[name]} = {of_file[name]:g} has no effect where "
                "the scenario itself "
                f"states timing.{name} = {own[name]:g}"
            )
    try:
        whole = Timing(**(of_file | own))
    except ValidationError as error:
        raise ValueError(f"timing of the sensor {sensor!r}: {one_line(error, Timing)}") from error
    return Timing.model_construct(_fields_set=set(own), **whole.model_dump()), file.note


def sensor_names() -> list[str]:
    """Names of the built-in sensors."""
    from cmmsim.files import built_in_names

    return built_in_names()


def by_dotted_key(changes: Mapping[str, Any]) -> dict[str, Any]:
    """A scenario's ``[sensor_changes]``, also as tables in tables, by dotted key of the sensor's
    file.
    """
    from cmmsim.files import dotted

    return dotted(changes)
