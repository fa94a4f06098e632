"""Geometry that servo and estimator know: from the robot file, or calibrated from static poses.

The true robot differs from the known robot by dg, a single random draw with the covariance of the
calibration. To first order, the poses of the true robot are those of the model plus J dg. J is the
derivative of the model's poses with respect to the geometric numbers. The servo uses the known
geometry throughout.

J is computed by central differences of whole runs, one standard deviation of dg to either side,
along independent directions. A direction is omitted if its effect on the poses is far below the
noise. The derivatives of the loop closure determine these directions.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import xarray as xr

from dynamics import DynamicsError, Robot, load_robot
from dynamics.closure import Closure
from identify.arrays import Array
from identify.errors import RecordError, ScenarioError
from identify.files.dataset import read_covariance
from identify.files.digest import check_toml
from identify.record.run_error_covariance import covariance_fault, factor, noticed_directions
from identify.runtime import in_threads
from identify.scenario.sections import Geometry

FOLDER = "geometry"  # folder within a run that holds the calibration of this run
# Name of the covariance file beside the file of a calibrated robot.
COVARIANCE_FILE = "covariance.nc"
# Largest difference of a calibrated number from the robot file, in tolerances of the geometry.
SAME_ROBOT = 20.0


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
    or not valid, the calibration is of another robot, or a folder is needed and None is given.
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
        names, covariance = read_covariance(path.parent / COVARIANCE_FILE)
    except (DynamicsError, RecordError) as error:
        raise ScenarioError(
            f"{said} is neither exact, calibrated, nor a robot.toml of `cmmsim geometry` with "
            f"{COVARIANCE_FILE}: {error}"
        ) from None
    _check_same(said, found, nominal, settings)
    if names != nominal.geometry.number_names:
        raise ScenarioError(
            f"{said}: {COVARIANCE_FILE} is not of the geometric numbers of {nominal.name}"
        )
    if fault := covariance_fault(covariance):
        raise ScenarioError(f"{said}: {COVARIANCE_FILE} {fault}")
    # The calibrated numbers are put into the nominal robot, whose functions are already compiled.
    return KnownGeometry(
        nominal.moved(found.geometry.deviations_from(nominal.geometry)), covariance
    )


def _check_same(said: str, found: Robot, nominal: Robot, settings: Geometry) -> None:
    """Raise ScenarioError if a calibration is of another robot, by its legs and numbers."""
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


COVARIANCE = "geometry_covariance"  # variable of a record with the covariance of the geometry
PREFIX = "geometry."  # beginning of the names of errors of the geometry


@dataclass(frozen=True)
class GeometryErrors:
    """Errors of the geometry of a known robot.

    covariance (g, g): covariance of the true geometric numbers about those of the robot, m and rad.
    poses (N, 6): poses of the run. whitener (6, 6): whitener of the noise of measured poses. Poses
    and whitener determine which directions are noticed.
    """

    robot: Robot
    covariance: Array
    poses: Array
    whitener: Array

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the g geometric numbers."""
        return tuple(PREFIX + name for name in self.robot.geometry.number_names)

    @property
    def factor(self) -> Array:
        """Factor F (g, g) with F F^T equal to the covariance.

        Its columns are independent directions, the most noticed direction first.
        """
        return self._noticed[0]

    def modes(self, poses_of: Callable[[Robot], Array]) -> Array:
        """Return the changes (N, 6, g) of a run's poses by each column of `factor`.

        The changes are set to zero for unnoticed directions. poses_of: function that returns the
        poses (N, 6) of a run of a robot near the known robot.
        """
        found = [*in_threads(poses_of, [robot for pair in self._moved for robot in pair])]
        modes = np.zeros((*self.poses.shape, len(self.covariance)))
        for column, (more, less) in enumerate(zip(found[::2], found[1::2], strict=True)):
            modes[:, :, column] = (more - less) / 2.0
        return modes

    def joints(self, poses: Array) -> Array:
        """Return the changes (N, n, k) of the joint coordinates along each noticed direction.

        poses (N, 6): poses of the platform, which are held.
        """
        chart = self.robot.geometry.chart
        held = chart.pose(chart.coordinates(poses))
        differences = [
            more.inverse_kinematics(held) - less.inverse_kinematics(held)
            for more, less in self._moved
        ]
        if not differences:
            return np.zeros((len(poses), self.robot.layout.joints, 0))
        return np.stack(differences, axis=2) / 2.0

    @cached_property
    def _noticed(self) -> tuple[Array, int]:
        """Factor of the covariance, and the number of noticed directions."""
        geometry = self.robot.geometry
        root = factor(self.covariance)
        chart = geometry.chart
        nominal = self.robot.functions_of
        poses = chart.pose(chart.coordinates(self.poses))
        off = geometry.deviations_from(nominal)
        joints = self.robot.inverse_kinematics(poses)
        by_numbers = Closure(nominal).derivatives(poses, joints, off)[0]
        seen = self.whitener[:, list(chart.freedoms)] @ by_numbers @ root
        return noticed_directions(root, seen)

    @cached_property
    def _moved(self) -> list[tuple[Robot, Robot]]:
        """Robots with the geometry changed by plus and minus each noticed direction."""
        directions, count = self._noticed
        return [(self.robot.moved(one), self.robot.moved(-one)) for one in directions.T[:count]]


def store_geometry_covariance(record: xr.Dataset, robot: Robot, covariance: Array) -> None:
    """Store with a record the covariance of the geometry of its robot."""
    names = list(robot.geometry.number_names)
    record[COVARIANCE] = xr.DataArray(
        covariance,
        dims=("geometric_number", "geometric_number_2"),
        attrs={
            "units": "m2, m rad and rad2",
            "long_name": "covariance of the true geometric numbers about the known numbers",
        },
    )
    record.coords.update({"geometric_number": names, "geometric_number_2": names})


def read_geometry_covariance(record: xr.Dataset, robot: Robot) -> Array | None:
    """Return the covariance (g, g) of a robot's geometric numbers, or None if a record has none.

    Raises RecordError if it is for other numbers, or if it is not finite or not a covariance.
    """
    if COVARIANCE not in record:
        return None
    covariance = np.asarray(record[COVARIANCE].values, dtype=float)
    stated = record["geometric_number"].values if "geometric_number" in record.coords else ()
    names = tuple(map(str, stated))
    if names != robot.geometry.number_names or covariance.shape != (len(names),) * 2:
        raise RecordError(
            f"{COVARIANCE} has shape {covariance.shape} and is not of the "
            f"{len(robot.geometry.number_names)} geometric numbers of {robot.name}, in their order"
        )
    if fault := covariance_fault(covariance):
        raise RecordError(f"{COVARIANCE} {fault}")
    return covariance
