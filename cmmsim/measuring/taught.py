"""Result of teaching: the base frame relative to the cameras, and sticker places on the platform.

A result is valid for the cameras, planes, sticker places and print of one sensor file. It does not
depend on noise, lens blur, timing, detector and renderer, because these do not change the true
frames.
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
from cmmsim.geometry.stereo_rig import PARAMETER_NAMES
from cmmsim.uncertainty.known_rig import KnownRig

# Largest numbers of differing entries in a message, and of characters of a value.
SHOWN_CHANGES = 3
SHOWN_CHARACTERS = 40


@dataclass(frozen=True)
class Taught:
    """Result of teaching one sensor.

    It consists of plain arrays, so that it can be sent to another process.

    Attributes
    ----------
    sensor_name : str
        Name of the sensor.
    base_from_camera : ndarray, shape (4, 4)
        Transform from the camera frame to the base frame.
    base_covariance : ndarray, shape (6, 6)
        Covariance of the small error [dt, dphi] of the base frame, in base axes.
    platform_places, place_covariances : ndarray, shapes (n, 3) and (n, 3, 3)
        Places of the platform's stickers in platform axes, m, and their covariances.
    platform_covariance : ndarray, shape (6, 6)
        Covariance of the small error [dt, dphi] of the platform frame, in platform axes.
    base_places : ndarray, shape (k, 3)
        Places of the base's stickers in base axes, m.
    setup : str
        Entries of the sensor file for which the result is valid, see ``setup_of``. It is empty for
        a result that was not made by teaching.
    known : KnownRig or None
        Rig that was used for teaching, if it differs from the file's rig.
    by_rig : ndarray, shape (6 + 3 n, 24), or None
        Derivative of the errors of ``base_from_camera`` and of the platform's places with respect
        to the errors of the known rig, if teaching has adjusted the rig. The covariances are then
        those for an exact rig. If it is None, the derivative is computed from the geometry of
        simulated teaching.
    platform_ids : tuple of str
        Names of the platform's stickers, if they are not all stickers of the sensor file.
    radius : float or None
        Radius of the stickers in the images, m, if teaching has measured it.

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
    by_rig: Array | None = None
    platform_ids: tuple[str, ...] = ()
    radius: float | None = None

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
        if self.by_rig is not None:
            shapes["by_rig"] = (6 + 3 * stickers, len(PARAMETER_NAMES))
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
        """Return a teaching result without errors, for example from a certificate.

        All covariances are zero.

        Parameters
        ----------
        sensor_name, base_from_camera, platform_places, base_places, setup
            See `Taught`.

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
        """Return the covariance of the pose error due to errors of teaching.

        This error is the same in every frame.

        Parameters
        ----------
        pose : ndarray, shape (6,)
            Pose of the platform.
        method : {"registration", "planes"}
            Method that computes poses. With "planes", the platform frame is found anew in every
            image, so only the error of the base frame counts.

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
    """Return the entries of a sensor file that teaching depends on, as JSON with sorted keys."""
    # The stated position already accounts for the distance. The covariance changes no true frame.
    rig = file.rig.model_dump(exclude={"distance", "covariance"})
    bodies = {
        name: {"planes": getattr(file, name).planes.model_dump()} for name in ("platform", "base")
    }
    stickers = file.stickers.model_dump(include={"placement", "placement_seed"})
    entries = {"rig": rig, "stickers": stickers, **bodies}
    # Print moves the taught places. Results for perfect print have no entry for it.
    if not file.print.is_perfect:
        entries["print"] = file.print.model_dump(exclude={"known"})
    return json.dumps(entries, sort_keys=True)


def require_taught_for(taught: Taught, file: SensorFile, stickers: int) -> None:
    """Raise TeachingError unless a result of teaching is valid for a sensor file.

    The message names the entries that differ. ``stickers`` is the number of the platform's stickers
    in the file. A result without a setup must have the name of the file's sensor.
    """
    if not taught.setup and taught.sensor_name != file.name:
        raise TeachingError(
            f"taught belongs to sensor {taught.sensor_name!r}, not to {file.name!r}"
        )
    if taught.setup and taught.setup != setup_of(file):
        raise TeachingError(
            f"taught belongs to sensor {taught.sensor_name!r} with other entries: "
            f"{_changes(taught.setup, setup_of(file))}; teach this sensor anew"
        )
    if len(taught.platform_places) != (len(taught.platform_ids) or stickers):
        raise TeachingError(
            f"taught has {len(taught.platform_places)} stickers of the platform, sensor "
            f"{file.name!r} has {stickers}"
        )


def _changes(there: str, here: str) -> str:
    """Describe the first entries that differ between the setups of a teaching and of a file."""
    then, now = (dotted(json.loads(text)) for text in (there, here))
    keys = [key for key in sorted({*then, *now}) if then.get(key) != now.get(key)]
    shown = [
        f"{key} was {_short(then.get(key))}, is {_short(now.get(key))}"
        for key in keys[:SHOWN_CHANGES]
    ]
    more = len(keys) - len(shown)
    return "; ".join(shown) + (f"; and {more} more" if more else "")


def _short(value: Any) -> str:
    """Show a value on one line, shortened to `SHOWN_CHARACTERS`."""
    text = "not stated" if value is None else json.dumps(value)
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[: SHOWN_CHARACTERS - 3]}..."
