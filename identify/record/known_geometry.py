"""Geometry as servo and estimator know it: of the robot file, or calibrated from static poses."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dynamics import DynamicsError, Robot, load_robot
from identify.arrays import Array
from identify.errors import RecordError, ScenarioError
from identify.files.dataset import read_covariance
from identify.files.seal import check_toml
from identify.record.run_error_covariance import covariance_fault
from identify.scenario.sections import Geometry

FOLDER = "geometry"
"""Folder within a run that holds the run's own calibration."""

COVARIANCE = "covariance.nc"
"""Name of the file that stands beside the file of a calibrated robot."""

SAME_ROBOT = 20.0
"""Tolerances by which a number of a calibrated robot may be off the robot file's."""


@dataclass(frozen=True)
class KnownGeometry:
    """Robot as it is known, and the covariance (g, g) of its true geometric numbers, m and rad.

    The covariance is None if the numbers are taken as exact.
    """

    robot: Robot
    covariance: Array | None = None


def known_geometry(nominal: Robot, settings: Geometry, folder: Path | None = None) -> KnownGeometry:
    """Return the geometry of a robot as the settings have it known.

    It is that of the robot file, of an earlier calibration, or of the calibration in a run's
    folder. Raises ScenarioError if the file does not exist, the covariance beside it is missing or
    not valid, or the calibration is of another robot.
    """
    if settings.exact:
        return KnownGeometry(nominal)
    path = Path(settings.known)
    if settings.known == "calibrated":
        if folder is None:
            raise ScenarioError(
                "geometry.known = 'calibrated' is for a run with a folder, as of cmmsim run; "
                "elsewhere name the robot.toml of a calibration, which cmmsim geometry writes"
            )
        path = check_toml(folder / FOLDER / "robot.toml")
    said = f"geometry.known = {str(path)!r}"
    try:
        found = load_robot(path)
        names, covariance = read_covariance(path.parent / COVARIANCE)
    except (DynamicsError, RecordError) as error:
        raise ScenarioError(
            f"{said} is neither exact, calibrated, nor a robot.toml of `cmmsim geometry` with "
            f"{COVARIANCE}: {error}"
        ) from None
    _check_same(said, found, nominal, settings)
    if names != nominal.geometry.number_names:
        raise ScenarioError(
            f"{said}: {COVARIANCE} is not of the geometric numbers of {nominal.name}"
        )
    if fault := covariance_fault(covariance):
        raise ScenarioError(f"{said}: {COVARIANCE} {fault}")
    # the nominal robot with the calibrated numbers has functions that are compiled already
    return KnownGeometry(
        nominal.moved(found.geometry.deviations_from(nominal.geometry)), covariance
    )


def _check_same(said: str, found: Robot, nominal: Robot, settings: Geometry) -> None:
    """Raise ScenarioError, with the number that differs, for a calibration of another robot."""
    there = found.geometry
    here = nominal.geometry
    if [type(leg) for leg in there.legs] != [type(leg) for leg in here.legs]:
        raise ScenarioError(
            f"{said} is of another robot: {found.name} has other legs than {nominal.name}"
        )
    tolerances = [
        settings.tolerance_m if unit == "m" else settings.tolerance_rad
        for unit in here.number_units
    ]
    limits = SAME_ROBOT * np.array(tolerances)
    off = np.abs(there.deviations_from(here))
    worst = int(np.argmax(off / limits))
    if off[worst] > limits[worst]:
        raise ScenarioError(
            f"{said} is of another robot: {here.number_names[worst]} is {off[worst]:.3g} "
            f"{here.number_units[worst]} off that of {nominal.name}, limit {limits[worst]:.3g}"
        )
