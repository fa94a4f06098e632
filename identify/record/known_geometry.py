"""Geometry that servo and estimator know: from the robot file, or calibrated from static poses."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dynamics import DynamicsError, Robot, load_robot
from identify.arrays import Array
from identify.errors import RecordError, ScenarioError
from identify.files.dataset import read_covariance
from identify.files.digest import check_toml
from identify.record.run_error_covariance import covariance_fault
from identify.scenario.sections import Geometry

FOLDER = "geometry"
"""Folder within a run that holds the calibration of this run."""

COVARIANCE = "covariance.nc"
"""Name of the covariance file beside the file of a calibrated robot."""

SAME_ROBOT = 20.0
"""Largest difference of a calibrated number from the robot file, in tolerances of the geometry."""


@dataclass(frozen=True)
class KnownGeometry:
    """Robot with its known geometry, and the covariance (g, g) of the geometry, m and rad.

    The covariance is None if the geometry is assumed exact.
    """

    robot: Robot
    covariance: Array | None = None


def known_geometry(nominal: Robot, settings: Geometry, folder: Path | None = None) -> KnownGeometry:
    """Return the known geometry of a robot according to the settings.

    The geometry comes from the robot file, from an earlier calibration, or from the calibration in
    the folder of a run. Raises ScenarioError if the file does not exist, its covariance is missing
    or not valid, or the calibration is of another robot.
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
    # The calibrated numbers are put into the nominal robot, whose functions are already compiled.
    return KnownGeometry(
        nominal.moved(found.geometry.deviations_from(nominal.geometry)), covariance
    )


def _check_same(said: str, found: Robot, nominal: Robot, settings: Geometry) -> None:
    """Raise ScenarioError if a calibration is of another robot. The message names the number."""
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
