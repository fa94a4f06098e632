"""Teaching and measuring from photographs, with a sensor file given by its name or path."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from cmmsim.errors import CmmError, SensorFileError
from cmmsim.files.rig_and_bodies import rig_from_file
from cmmsim.files.sensor_file import read_sensor_file
from cmmsim.loading import load_sensor
from cmmsim.measuring.taught import Taught
from cmmsim.photographs.measuring import MeasuredPair, measure_pairs
from cmmsim.photographs.pairs import Format, Photographs, Source
from cmmsim.photographs.photographed_teaching import PhotographedTeaching
from cmmsim.photographs.taught_file import read_taught
from cmmsim.sensor import Sensor
from cmmsim.uncertainty.known_rig import KnownRig

# Every sensor has a renderer, although photographs are not rendered. This renderer needs no OpenGL,
# and adds no error to the stated errors of centres.
RENDERER = "analytic"


def sensor_for(name: str | Path) -> Sensor:
    """Return the sensor of a file.

    If the file states a covariance of the cameras, the sensor takes it into account. Raises the
    same exceptions as read_sensor_file, and SensorFileError for a covariance that is not valid.
    """
    file = read_sensor_file(name)
    if file.rig.covariance is None:
        return Sensor(file, renderer=RENDERER)
    rig = rig_from_file(file.rig)[0]
    try:
        known = KnownRig(rig, np.array(file.rig.covariance.matrix))
    except CmmError as error:
        raise SensorFileError(f"sensor file {name}: rig.covariance.matrix: {error}") from error
    return Sensor(file, renderer=RENDERER, known=known)


def photographs_for(
    sensor: Sensor, left: Source, right: Source, colour: str | None = None
) -> Photographs:
    """Return pairs of photographs in the format of a sensor's images. Raises PhotographError."""
    rate = sensor.timing.frame_rate
    return Photographs(left, right, Format(sensor.rig, sensor.noise, rate, colour))


def teach(
    left: Source,
    right: Source,
    sensor: str | Path,
    colour: str | None = None,
    advance: Callable[[], None] = lambda: None,
) -> PhotographedTeaching:
    """Teach a sensor from photographs of its platform in several poses.

    The cameras and the base stand still, and the platform moves from pair to pair. Stickers need no
    labels: those at the same pixels in most pairs belong to the base, and those that move together
    belong to the platform. Each sticker is identified by its rough position in the sensor file. If
    the file states the covariance of the cameras, as a file of `cmmsim calibrate` does, the cameras
    are adjusted within this covariance.

    Parameters
    ----------
    left, right : str, Path, or iterable of ndarray
        Folders of images, videos, or arrays (height, width) of both cameras.
    sensor : str or Path
        Built-in name, or path of a TOML sensor file with the cameras, the radius of the stickers,
        and the planes with the rough positions of the stickers.
    colour : {"grey", "red", "green", "blue"}, optional
        Method that computes grey values from colours. Without it, images with colours are refused.
    advance : callable, optional
        Function that is called after each pair.

    Returns
    -------
    PhotographedTeaching
        Its ``taught`` can be passed to `load_sensor`, and its ``save`` writes a file.

    Raises
    ------
    PhotographError
        If images cannot be used; the message names the file.
    TeachingError
        If the stickers are not found, or do not determine the frames.
    UnknownSensorError, SensorFileError
        If there is no such sensor, or its file cannot be used.

    Examples
    --------
    >>> import cmmsim
    >>> try:
    ...     teach("no/left", "no/right", "ctrack780")
    ... except cmmsim.PhotographError as error:
    ...     print(error)
    no folder no/left; give one folder of left and one of right images
    """
    loaded = sensor_for(sensor)
    return loaded.teach_from(photographs_for(loaded, left, right, colour), advance)


def measure(
    left: Source,
    right: Source,
    sensor: str | Path,
    taught: str | Path | Taught,
    colour: str | None = None,
) -> Iterator[MeasuredPair]:
    """Measure the pose of the platform in each pair of photographs.

    Parameters
    ----------
    left, right, sensor, colour
        As in `teach`.
    taught : str, Path or Taught
        Result of teaching, or its file.

    Returns
    -------
    iterator of MeasuredPair
        Name, time and measurement of each pair. A pair is read when it is requested.

    Raises
    ------
    PhotographError
        If images cannot be used, or are those of the other camera; the message names the file.
    TeachingError
        If ``taught`` cannot be read, or belongs to another sensor.
    UnknownSensorError, SensorFileError
        If there is no such sensor, or its file cannot be used.

    Examples
    --------
    >>> import cmmsim
    >>> try:
    ...     measure("no/left", "no/right", "ctrack780", "no/taught.json")
    ... except cmmsim.TeachingError as error:
    ...     print(error)
    cannot read no/taught.json: No such file or directory
    """
    result = taught if isinstance(taught, Taught) else read_taught(taught)
    loaded = load_sensor(sensor, renderer=RENDERER, taught=result)
    return measure_pairs(photographs_for(loaded, left, right, colour), loaded.estimator)
