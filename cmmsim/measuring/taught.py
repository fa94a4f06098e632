"""Result of teaching: the place of the base in the camera frame, and of stickers on the platform.

A teaching holds for the cameras and the places of planes and stickers of both bodies in a sensor
file. It does not depend on noise, lens blur, timing, detector and renderer: they change how well a
pose is seen, not which one.
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
# Characters of a value that differs between two setups.
SHOWN_CHARACTERS = 40


@dataclass(frozen=True)
class Taught:
    """Result of teaching one sensor.

    It holds plain arrays, so that it can be sent to another process.

    Attributes
    ----------
    sensor_name : str
        Name of the sensor.
    base_from_camera : ndarray, shape (4, 4)
        Place of the cameras.
    base_covariance : ndarray, shape (6, 6)
        Covariance of its small error [dt, dphi].
    platform_places, place_covariances : ndarray, shapes (n, 3) and (n, 3, 3)
        Stickers in platform axes, m.
    platform_covariance : ndarray, shape (6, 6)
        Covariance of the error of the platform frame itself, in platform axes.
    base_places : ndarray, shape (k, 3)
        Stickers in base axes, m.
    setup : str
        Entries of the sensor file for which the teaching is valid, see ``setup_of``; empty if made
        by hand.
    known : KnownRig or None
        Rig that was used for teaching, if it differs from the file's rig.

    Raises
    ------
    ShapeError
        If an array has another shape.

    Examples
    --------
    >>> Taught.without_error("mine", np.eye(4), np.zeros((3, 3)), np.zeros((0, 3)))
    Taught('mine', 3 stickers of the platform, 0 of the base)
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
        """Return a teaching result without error, such as from a certificate: all covariances are
        zero.

        Parameters
        ----------
        sensor_name, base_from_camera, platform_places, base_places, setup
            As of the class.

        Returns
        -------
        Taught
        """
        exact = np.zeros((6, 6))
        places = np.zeros((len(platform_places), 3, 3))
        return cls(
            sensor_name, base_from_camera, exact, platform_places, places, exact, base_places, setup
        )

    def __repr__(self) -> str:
        stickers = (
            f"{len(self.platform_places)} stickers of the platform, {len(self.base_places)} of the "
            "base"
        )
        return f"Taught({self.sensor_name!r}, {stickers})"

    def calibration_covariance(self, pose: Array, method: str = "registration") -> Array:
        """Return the covariance of the part of the pose error that teaching left, the same in every
        frame.

        Parameters
        ----------
        pose : ndarray, shape (6,)
            Pose of the platform.
        method : {"registration", "planes"}
            By "planes", the platform's frame is found anew in every image, and only the base's
            was taught.

        Returns
        -------
        ndarray, shape (6, 6)
        """
        base_from_platform = pose_to_transform(pose)
        lever = np.eye(6)
        lever[:3, 3:] = -skew(base_from_platform[:3, 3])
        total = lever @ self.base_covariance @ lever.T
        if method == "registration":
            total += compose_covariance(base_from_platform, self.platform_covariance)
        return pose_covariance(base_from_platform, total)


def setup_of(file: SensorFile) -> str:
    """Return the entries that teaching depends on as JSON, the same for the same entries."""
    # The distance has become part of the position.
    rig = file.rig.model_dump(exclude={"distance"})
    bodies = {
        name: {"planes": getattr(file, name).planes.model_dump()} for name in ("platform", "base")
    }
    stickers = file.stickers.model_dump(include={"placement", "placement_seed"})
    return json.dumps({"rig": rig, "stickers": stickers, **bodies}, sort_keys=True)


def require_taught_for(taught: Taught, file: SensorFile, stickers: int) -> None:
    """Raise TeachingError, naming what differs, unless ``taught`` holds for a file and its
    stickers.

    One that was made by hand states no setup: the name of its sensor must then be the file's.
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
    """Describe the first few entries in which two setups differ, with both values."""
    then, now = (dotted(json.loads(text)) for text in (there, here))
    keys = [key for key in sorted({*then, *now}) if then.get(key) != now.get(key)]
    shown = [
        f"{key} {_short(then.get(key))} there, {_short(now.get(key))} here"
        for key in keys[:SHOWN_CHANGES]
    ]
    more = len(keys) - len(shown)
    return "; ".join(shown) + (f"; and {more} more" if more else "")


def _short(value: Any) -> str:
    """Show a value on one line, shortened where it is long."""
    text = "nothing" if value is None else json.dumps(value)
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[: SHOWN_CHARACTERS - 3]}..."
