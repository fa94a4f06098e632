"""Result of teaching: the place of the base in the camera frame, and the stickers' places on the
platform.

What of a sensor file a teaching holds for: the cameras, and where the planes and stickers of both
bodies are. Noise, lens blur, timing, detector and renderer are no part of it: they change how well
a pose is seen, not which one.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from cmmsim.errors import ShapeError, TeachingError
from cmmsim.files.schema import SensorFile
from cmmsim.files.sensor_file import dotted
from cmmsim.geometry.pose import Array, compose_covariance, pose_covariance, pose_to_transform, skew
from cmmsim.uncertainty.known_rig import KnownRig

SHOWN_CHANGES = 3
SHOWN_CHARACTERS = 40  # of what differs between two setups


@dataclass(frozen=True)
class Taught:
    """Result of teaching one sensor; plain arrays, so that it can be sent to another process.

    sensor_name; base_from_camera (4,4) and base_covariance (6,6) of its small error [dt, dphi];
    platform_places (n,3) sticker coordinates in platform axes, m, and place_covariances (n,3,3);
    platform_covariance (6,6): error of the platform frame itself, in platform axes; base_places
    (k,3) sticker coordinates in base axes, m. setup: what of the sensor file this holds for, see
    ``setup_of``; empty for one put together by hand. known: the rig that it was taught with, where
    that is another than the file's.
    """

    sensor_name: str
    base_from_camera: Array
    base_covariance: Array
    platform_places: Array
    place_covariances: Array
    platform_covariance: Array
    base_places: Array
    setup: str = ""
    known: KnownRig | None = None

    def __post_init__(self) -> None:
        stickers = len(self.platform_places)
        base_stickers = len(self.base_places)
        shapes = {
            "base_from_camera": (4, 4),
            "base_covariance": (6, 6),
            "platform_places": (stickers, 3),
            "place_covariances": (stickers, 3, 3),
            "platform_covariance": (6, 6),
            "base_places": (base_stickers, 3),
        }
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ShapeError(
                    f"taught {name} must have the shape {shape}, got {getattr(self, name).shape}"
                )
        for name in self.__dataclass_fields__:
            if isinstance(value := getattr(self, name), np.ndarray):
                value.setflags(write=False)

    @classmethod
    def without_error(
        cls,
        sensor_name: str,
        base_from_camera: Array,
        platform_places: Array,
        base_places: Array,
        setup: str = "",
    ) -> Taught:
        """Exact knowledge, as by a certificate: all covariances are zero."""
        exact = np.zeros((6, 6))
        places = np.zeros((len(platform_places), 3, 3))
        return cls(
            sensor_name, base_from_camera, exact, platform_places, places, exact, base_places, setup
        )

    def __repr__(self) -> str:
        stickers = (
            f"{len(self.platform_places)} stickers of the platform, "
            f"{len(self.base_places)} of the base"
        )
        return f"Taught({self.sensor_name!r}, {stickers})"

    def calibration_covariance(self, pose: Array, method: str = "registration") -> Array:
        """Covariance (6,6) of the part of the pose error that teaching left; the same in every
        frame.

        ``method`` "planes": the platform's frame is found anew in every frame, and only the base's
        was taught.
        """
        base_from_platform = pose_to_transform(pose)
        lever = np.eye(6)
        lever[:3, 3:] = -skew(base_from_platform[:3, 3])
        total = lever @ self.base_covariance @ lever.T
        if method == "registration":
            total += compose_covariance(base_from_platform, self.platform_covariance)
        return pose_covariance(base_from_platform, total)


def setup_of(file: SensorFile) -> str:
    """JSON of the entries that teaching depends on, the same for the same entries."""
    rig = file.rig.model_dump(exclude={"distance"})  # it has become part of the position
    bodies = {
        name: {"planes": getattr(file, name).planes.model_dump()} for name in ("platform", "base")
    }
    stickers = file.stickers.model_dump(include={"placement", "placement_seed"})
    return json.dumps({"rig": rig, "stickers": stickers, **bodies}, sort_keys=True)


def require_taught_for(taught: Taught, file: SensorFile, stickers: int) -> None:
    """Raise TeachingError, naming what differs, unless ``taught`` holds for this file and its
    ``stickers`` ones.

    One that was put together by hand states no setup: then the name of its sensor must be the
    file's.
    """
    if not taught.setup and taught.sensor_name != file.name:
        raise TeachingError(
            f"taught belongs to sensor {taught.sensor_name!r}, not to {file.name!r}"
        )
    if taught.setup and taught.setup != setup_of(file):
        raise TeachingError(
            f"taught belongs to sensor {taught.sensor_name!r} set up differently: "
            f"{_changes(taught.setup, setup_of(file))}; teach this sensor anew"
        )
    if len(taught.platform_places) != stickers:
        raise TeachingError(
            f"taught holds {len(taught.platform_places)} stickers of the platform, sensor "
            f"{file.name!r} has {stickers}"
        )


def _changes(there: str, here: str) -> str:
    """The first few entries in which two setups differ, with both values."""
    then, now = (dotted(json.loads(text)) for text in (there, here))
    keys = [key for key in sorted({*then, *now}) if then.get(key) != now.get(key)]
    shown = [
        f"{key} {_short(then.get(key))} there, {_short(now.get(key))} here"
        for key in keys[:SHOWN_CHANGES]
    ]
    more = len(keys) - len(shown)
    return "; ".join(shown) + (f"; and {more} more" if more else "")


def _short(value: Any) -> str:
    """A value on one line, cut where it is long."""
    text = "nothing" if value is None else json.dumps(value)
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[: SHOWN_CHARACTERS - 3]}..."
