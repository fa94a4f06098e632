"""When the sensor looks and when its poses are used: the sensor's file says so, and a scenario may say otherwise.

The two name the same quantities, the scenario with their units. Imports of the sensor stand in the functions: the
command line's help must not wait for them.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

if TYPE_CHECKING:
    from cmmsim.files.schema import Timing as SensorTiming

NAMES = {
    "frame_rate_hz": "frame_rate",
    "exposure_s": "exposure",
    "latency_s": "latency",
    "latency_jitter_s": "latency_jitter",
    "dropout": "dropout",
}
"""The sensor file's key of each key of a scenario's ``[timing]``."""


def timing_in_file(sensor: str, changes: Mapping[str, Any]) -> tuple[dict[str, float], str]:
    """Timing of a built-in sensor or of a sensor file under the scenario's names, and the file's note.

    ``changes``: a scenario's ``[sensor_changes]``.

    Raises:
        cmmsim.CmmError: no such sensor, or a bad file.
    """
    from cmmsim.files.sensor_file import read_sensor_file

    file = read_sensor_file(sensor, changes)
    return {ours: getattr(file.timing, theirs) for ours, theirs in NAMES.items()}, file.note


def by_dotted_key(changes: Mapping[str, Any]) -> dict[str, Any]:
    """A scenario's ``[sensor_changes]``, also as tables in tables, by dotted key of the sensor's file."""
    from cmmsim.files.sensor_file import dotted

    return dotted(changes)


def sensor_timing(timing: Mapping[str, Any]) -> "SensorTiming":
    """The values of a scenario's ``[timing]`` in the form of a sensor file.

    Raises:
        ValueError: values that contradict each other.
    """
    from cmmsim.files.schema import Timing as SensorTiming

    try:
        return SensorTiming(**{theirs: timing[ours] for ours, theirs in NAMES.items()})
    except ValidationError as error:
        raise ValueError(f"timing: {error.errors()[0]['ctx']['error']}") from error


def check_delay(timing: "SensorTiming") -> None:
    """Refuse a latency that the closed loop cannot hold back.

    Raises:
        ValueError: with the longest one that is possible.
    """
    from cmmsim.latency import largest_latency
    from dynamics.closed_loop.problem import MAX_DELAY_FRAMES

    longest = largest_latency(timing)
    if longest * timing.frame_rate > MAX_DELAY_FRAMES:
        raise ValueError(
            f"timing.latency_s = {timing.latency:g} s with timing.latency_jitter_s = {timing.latency_jitter:g} s "
            f"reaches {longest:.4g} s, {longest * timing.frame_rate:.1f} frames of {timing.frame_rate:g} Hz; at most "
            f"{MAX_DELAY_FRAMES} frames are possible"
        )
