"""What a kind of row reads of a scenario and of its sensor's file: all that a study can vary, beside its options."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from identify.scenario.timing import NAMES


@dataclass(frozen=True)
class Idle:
    """Keys that do nothing where all of `where` hold: dotted paths with what is asked of their values; `why`, in words
    behind "where"."""

    keys: tuple[str, ...]
    where: Mapping[str, Callable[[Any], bool]]
    why: str


@dataclass(frozen=True)
class Reads:
    """What a kind reads: `keys`, dotted paths, or sections that end in a dot; not `but`; not always `idle`.

    It reads all of its options.
    """

    keys: tuple[str, ...]
    but: tuple[str, ...] = ()
    idle: tuple[Idle, ...] = ()

    def covers(self, path: str) -> bool:
        """Whether the kind ever reads a dotted path."""
        return path.startswith("options.") or (among(path, self.keys) and not among(path, self.but))

    def __str__(self) -> str:
        read, left = (
            ", ".join(f"{key}*" if key.endswith(".") else key for key in keys) for keys in (self.keys, self.but)
        )
        return f"{read}{' but ' if left else ''}{left}"


def among(path: str, keys: tuple[str, ...]) -> bool:
    """Whether a path is one of the keys, or in a section of them."""
    return any(path == key or (key.endswith(".") and path.startswith(key)) for key in keys)


def timing(*names: str) -> tuple[str, ...]:
    """Both paths of keys of a scenario's ``[timing]``: there, and in the sensor's file."""
    return tuple(path for name in names for path in (f"scenario.timing.{name}", f"sensor.timing.{NAMES[name]}"))


SENSOR = (
    "sensor.rig.", "sensor.camera.", "sensor.lens.", "sensor.detection.", "sensor.stickers.", "sensor.platform.",
    "sensor.base.",
)  # fmt: skip
"""All of a sensor's file but its timing and its labels; a scenario always says itself what draws."""

PICTURES = ("scenario.sensor", "scenario.renderer", "scenario.pose_method", *SENSOR)
"""What pictures, and the poses measured in them, depend on beside the timing."""

NOISE_OFF = Idle(
    tuple(f"sensor.camera.{name}" for name in ("dark_noise", "prnu", "dsnu", "pattern_seed")),
    {"sensor.camera.noise": lambda noise: not noise},
    "sensor.camera.noise is false: pictures have no noise, and only what is stated of it would change",
)

PLANT = (
    Idle(
        ("scenario.plant.geometry_seed",),
        {"scenario.plant.geometry_error_m": lambda error: error == 0},
        "scenario.plant.geometry_error_m is 0",
    ),
    Idle(
        ("scenario.plant.joint_damping_N_m_s_rad", "scenario.plant.motor_inertia_kg_m2"),
        {"scenario.plant.joint_stiffness_N_m_rad": lambda stiffness: stiffness is None},
        "scenario.plant.joint_stiffness_N_m_rad is not given: the joints are rigid",
    ),
)
"""Keys of a plant that does not have what they belong to."""
