"""Loading of sensors by the name or the path of a sensor file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.measuring.taught import Taught
from cmmsim.sensor import Sensor
from cmmsim.teaching import Progress
from cmmsim.uncertainty.known_rig import KnownRig


def load_sensor(
    name: str | Path,
    seed: int = 0,
    method: str = "registration",
    taught: Taught | None = None,
    progress: Progress | None = None,
    renderer: str | None = None,
    changes: Mapping[str, Any] | None = None,
    known: KnownRig | None = None,
) -> Sensor:
    """Load a sensor.

    Parameters
    ----------
    name : str or Path
        Built-in name, or path of a TOML sensor file.
    seed : int
        Seed of teaching, and of the noise of the first run.
    method : {"registration", "planes"}
        Method that computes a pose from the stickers.
    taught : Taught, optional
        Result of an earlier teaching of the same cameras and bodies.
    progress : callable, optional
        Function that is called during teaching with the number of steps done and their total.
    renderer : {"pyrender", "analytic", "scene", "mitsuba", "auto", "statistical"}, optional
        Renderer to use instead of the renderer that the file names. ``module:name`` names a user's
        own renderer.
    changes : mapping, optional
        Entries that replace entries of the file, by dotted key.
    known : KnownRig, optional
        Rig that the estimator uses, if it differs from the file's rig. The file's rig forms the
        images. If ``taught`` is given, the estimator uses the rig that was known at teaching.

    Returns
    -------
    Sensor

    Raises
    ------
    UnknownSensorError
        If ``name`` is neither a built-in name nor the path of a file.
    SensorFileError
        If the file cannot be read or contains a wrong value.
    UnknownOptionError
        If there is no such method, renderer or detector.
    TeachingError
        If ``taught`` belongs to another sensor.
    CmmError
        If another argument has a wrong type, or the seed is negative.

    Examples
    --------
    >>> sensor = load_sensor("ctrack780", renderer="statistical", changes={"camera.gain": 0.12})
    >>> sensor.home
    array([0. , 0. , 0.2, 0. , 0. , 0. ])
    """
    return Sensor(read_sensor_file(name, changes), seed, method, taught, progress, renderer, known)
