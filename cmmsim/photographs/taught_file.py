"""The file taught.json: a result of teaching, written and read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from cmmsim.errors import TeachingError
from cmmsim.geometry.camera import camera_from
from cmmsim.geometry.pose import Array, rigid, rotation_exp
from cmmsim.geometry.stereo_rig import PARAMETER_NAMES, StereoRig
from cmmsim.measuring.taught import Taught
from cmmsim.uncertainty.known_rig import KnownRig


def taught_as_dict(taught: Taught) -> dict[str, Any]:
    """Return a result of teaching as a dictionary for JSON; lengths are in m, angles in rad."""
    known = taught.known
    return {
        "sensor": taught.sensor_name,
        "setup": json.loads(taught.setup or "null"),
        "base_from_camera": taught.base_from_camera.tolist(),
        "base_covariance": taught.base_covariance.tolist(),
        "platform_covariance": taught.platform_covariance.tolist(),
        "platform_stickers": list(taught.platform_ids),
        "platform_places": taught.platform_places.tolist(),
        "place_covariances": taught.place_covariances.tolist(),
        "base_places": taught.base_places.tolist(),
        "sticker_radius": taught.radius,
        "rig": None if known is None else _rig_as_dict(known),
        "by_rig": None if taught.by_rig is None else taught.by_rig.tolist(),
    }


def _rig_as_dict(known: KnownRig) -> dict[str, Any]:
    values = known.rig.parameters.tolist()
    return {
        "size_px": [known.rig.left.width, known.rig.left.height],
        "parameters": dict(zip(PARAMETER_NAMES, values, strict=True)),
        "covariance": known.covariance.tolist(),
        "exposure_std_s": known.exposure_std,
    }


def read_taught(path: str | Path) -> Taught:
    """Read a result of teaching from a file.

    Parameters
    ----------
    path : str or Path
        File ``taught.json`` that ``cmmsim teach`` or `PhotographedTeaching.save` wrote.

    Returns
    -------
    Taught

    Raises
    ------
    TeachingError
        If the file cannot be read, is not JSON, lacks an entry, or has an invalid one.

    Examples
    --------
    >>> try:
    ...     read_taught("no/taught.json")
    ... except TeachingError as error:
    ...     print(error)
    cannot read no/taught.json: No such file or directory
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise TeachingError(f"cannot read {path}: {error.strerror or error}") from error
    except ValueError as error:
        raise TeachingError(f"{path} is not JSON: {error}") from error
    try:
        return _taught(content)
    except (KeyError, TypeError, ValueError) as error:
        said = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
        if isinstance(content, dict) and "degrees_of_freedom" in content:
            said = "it is the calibration.json of `cmmsim calibrate`"
        raise TeachingError(f"{path} is no taught.json of `cmmsim teach`: {said}") from error


def _taught(content: dict[str, Any]) -> Taught:
    """Return the result of teaching that the content of a file states."""
    setup = content["setup"]
    rig = content["rig"]
    return Taught(
        str(content["sensor"]),
        _numbers(content, "base_from_camera", 4, 4),
        _numbers(content, "base_covariance", 6, 6),
        _numbers(content, "platform_places", -1, 3),
        _numbers(content, "place_covariances", -1, 3, 3),
        _numbers(content, "platform_covariance", 6, 6),
        _numbers(content, "base_places", -1, 3),
        "" if setup is None else json.dumps(setup, sort_keys=True),
        None if rig is None else _known(rig),
        None
        if content["by_rig"] is None
        else _numbers(content, "by_rig", -1, len(PARAMETER_NAMES)),
        tuple(str(name) for name in content["platform_stickers"]),
        None if content["sticker_radius"] is None else float(_numbers(content, "sticker_radius")),
    )


def _known(content: dict[str, Any]) -> KnownRig:
    values = np.array([_numbers(content["parameters"], name) for name in PARAMETER_NAMES])
    width, height = (int(side) for side in content["size_px"])
    left, right = (camera_from(each, width, height) for each in values[:18].reshape(2, 9))
    rig = StereoRig(left, right, rigid(rotation_exp(values[21:]), values[18:21]))
    covariance = np.array(content["covariance"], dtype=float)
    return KnownRig(rig, covariance, float(_numbers(content, "exposure_std_s")))


def _numbers(content: dict[str, Any], name: str, *shape: int) -> Array:
    """Return an entry as an array. Raises ValueError if a number is missing or not finite."""
    values = np.array(content[name], dtype=float).reshape(shape)
    if not np.isfinite(values).all():
        raise ValueError(f"{name} is not finite")
    return values
