"""Effect of an inexactly known geometry on all poses of a record.

The true robot differs from the known robot by dg, a single random draw with the covariance of the
calibration. To first order the measured poses are the poses of the model plus J dg. J is the
derivative of the model's poses with respect to the geometric numbers. The servo uses the known
geometry throughout.

J is computed by central differences of whole runs, one standard deviation of dg to either side,
along independent directions. A direction is omitted if its effect on the poses is far below the
noise. The derivatives of the loop closure determine these directions.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import xarray as xr

from dynamics import Robot
from dynamics.closure import Closure
from identify.arrays import Array
from identify.errors import RecordError
from identify.record.run_error_covariance import covariance_fault, factor, noticed_directions
from identify.runtime import in_threads

COVARIANCE = "geometry_covariance"
PREFIX = "geometry."


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
        """Return the changes (N, 6, g) of a run's poses along each direction.

        The changes are zero along unnoticed directions. poses_of: function that returns the poses
        (N, 6) of a run of a robot near the known robot.
        """
        found = in_threads(poses_of, [robot for pair in self._moved for robot in pair])
        modes = np.zeros((*self.poses.shape, len(self.covariance)))
        for place, (more, less) in enumerate(zip(found[::2], found[1::2], strict=True)):
            modes[:, :, place] = (more - less) / 2.0
        return modes

    def joints(self, poses: Array) -> Array:
        """Return the changes (N, n, k) of the joint coordinates along each noticed direction.

        poses (N, 6): poses of the platform.
        """
        chart = self.robot.geometry.chart
        held = chart.pose(chart.coordinates(poses))
        apart = [
            more.inverse_kinematics(held) - less.inverse_kinematics(held)
            for more, less in self._moved
        ]
        if not apart:
            return np.zeros((len(poses), self.robot.layout.joints, 0))
        return np.stack(apart, axis=2) / 2.0

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
    """Return the covariance (g, g) of the geometric numbers of a record's robot, or None.

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
