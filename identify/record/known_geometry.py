"""The geometry as servo and estimator know it: that of the robot file, or as static poses have
calibrated it.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dynamics import DynamicsError, Robot, load_robot
from identify.arrays import Array
from identify.errors import RecordError, ScenarioError
from identify.files.dataset import read_covariance
from identify.files.seal import check_toml
from identify.record.covariance import covariance_fault
from identify.scenario import Scenario

FOLDER = "geometry"
"""Of a run: what its own calibration wrote."""
COVARIANCE = "covariance.nc"
"""Beside the file of a calibrated robot."""
SAME_ROBOT = 20.0
"""Tolerances by which a number of a calibrated robot may be off the robot file's."""


@dataclass(frozen=True)
class KnownGeometry:
    """The robot as it is known, and the covariance (g, g) of its true geometric numbers about it, m
    and rad; None where they are taken for exact."""

    robot: Robot
    covariance: Array | None = None


def known_geometry(
    scenario: Scenario, folder: Path | None = None, nominal: Robot | None = None
) -> KnownGeometry:
    """What a scenario's estimator knows: the robot file's geometry, one calibrated before, or that
    of a run's folder.

    nominal: the scenario's robot, where it is at hand; calibrated ones share its functions. Raises
    ScenarioError: no such file, no covariance beside it or one that is none, a calibration of
    another robot.
    """
    nominal = nominal or load_robot(scenario.robot)
    settings = scenario.geometry
    if settings.exact:
        return KnownGeometry(nominal)
    path = Path(settings.known)
    if settings.known == "calibrated":
        if folder is None:
            raise ScenarioError(
                "geometry.known = 'calibrated' is for a run with a folder, as of cmmsim run; "
                "elsewhere name the "
                "robot.toml of a calibration, which cmmsim geometry writes"
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
    _check_same(said, found, nominal, scenario)
    if names != nominal.geometry.number_names:
        raise ScenarioError(
            f"{said}: {COVARIANCE} is not of the geometric numbers of {nominal.name}"
        )
    if fault := covariance_fault(covariance):
        raise ScenarioError(f"{said}: {COVARIANCE} {fault}")
    return KnownGeometry(
        nominal.moved(found.geometry.deviations_from(nominal.geometry)), covariance
    )


def _check_same(said: str, found: Robot, nominal: Robot, scenario: Scenario) -> None:
    """Raise ScenarioError for a calibration of another robot than the scenario's, with the number
    that differs.
    """
    there = found.geometry
    here = nominal.geometry
    if [type(leg) for leg in there.legs] != [type(leg) for leg in here.legs]:
        raise ScenarioError(
            f"{said} is of another robot: {found.name} has other legs than {nominal.name}"
        )
    settings = scenario.geometry
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
            f"{here.number_units[worst]} "
            f"off that of {nominal.name}, limit {limits[worst]:.3g}"
        )
