"""What a geometry that is known only so well does to all poses of a record: how the model's poses
change with it.

The true robot is off the known one by dg, one draw with the covariance of its calibration. To first
order the measured poses are those of the model plus J dg, with J the derivative of the model's
poses by the geometric numbers; the servo knows the known geometry all along. J is taken by central
differences of whole runs, one standard deviation of dg to either side, along independent
directions. Those that move no pose of the run by what its noise would show are left out, as the
loops' closure says.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import xarray as xr

from dynamics import Robot
from dynamics.closure import Closure
from identify.arrays import Array
from identify.errors import RecordError
from identify.record.covariance import covariance_fault, factor, noticed_directions
from identify.runtime import cores

COVARIANCE = "geometry_covariance"
PREFIX = "geometry."


@dataclass(frozen=True)
class GeometryErrors:
    """Errors of the geometry of a known robot: covariance (g, g) of the true numbers about its own,
    m and rad.

    poses (N, 6) are those of the run, and whitener (6, 6) that of its noise: they say which
    directions are noticed.
    """

    robot: Robot
    covariance: Array
    poses: Array
    whitener: Array

    @property
    def names(self) -> tuple[str, ...]:
        """Of the numbers (g)."""
        return tuple(PREFIX + name for name in self.robot.geometry.number_names)

    @property
    def factor(self) -> Array:
        """F (g, g) with F F^T the covariance: its columns are independent directions, the most
        noticed ones first.
        """
        return self._noticed[0]

    def modes(self, poses_of: Callable[[Robot], Array]) -> Array:
        """Changes (N, 6, g) of a run's poses by each direction, zero where it is not noticed;
        poses_of: the poses (N, 6) of a run of a robot near the known one."""
        with ThreadPoolExecutor(cores()) as pool:  # the compiled loop runs without Python's lock
            found = list(pool.map(poses_of, [robot for pair in self._moved for robot in pair]))
        modes = np.zeros((*self.poses.shape, len(self.covariance)))
        for place, (more, less) in enumerate(zip(found[::2], found[1::2], strict=True)):
            modes[:, :, place] = (more - less) / 2.0
        return modes

    def joints(self, poses: Array) -> Array:
        """Changes (N, n, k) of the joint coordinates at poses (N, 6) by each direction that is
        noticed.
        """
        chart = self.robot.geometry.chart
        held = chart.pose(chart.coordinates(poses))
        apart = [
            more.inverse_kinematics(held) - less.inverse_kinematics(held)
            for more, less in self._moved
        ]
        return (
            np.stack(apart, axis=2) / 2.0
            if apart
            else np.zeros((len(poses), self.robot.layout.joints, 0))
        )

    @cached_property
    def _noticed(self) -> tuple[Array, int]:
        """The factor, and how many of its directions are noticed."""
        geometry = self.robot.geometry
        root = factor(self.covariance)
        chart = geometry.chart
        nominal = self.robot.functions_of
        poses = chart.pose(chart.coordinates(self.poses))
        off = geometry.deviations_from(nominal)
        by_numbers = Closure(nominal).derivatives(poses, self.robot.inverse_kinematics(poses), off)[
            0
        ]
        return noticed_directions(root, self.whitener[:, list(chart.freedoms)] @ by_numbers @ root)

    @cached_property
    def _moved(self) -> list[tuple[Robot, Robot]]:
        """The robot with its geometry off by plus and by minus each direction that is noticed."""
        directions, count = self._noticed
        return [(self.robot.moved(one), self.robot.moved(-one)) for one in directions.T[:count]]


def store_geometry_covariance(record: xr.Dataset, robot: Robot, covariance: Array) -> None:
    """Keep with a record how well the geometry of its robot is known."""
    names = list(robot.geometry.number_names)
    record[COVARIANCE] = xr.DataArray(
        covariance,
        dims=("geometric_number", "geometric_number_2"),
        attrs={
            "units": "m2, m rad and rad2",
            "long_name": "covariance of the true geometric numbers about the known",
        },
    )
    record.coords.update({"geometric_number": names, "geometric_number_2": names})


def read_geometry_covariance(record: xr.Dataset, robot: Robot) -> Array | None:
    """Covariance (g, g) of the geometric numbers of a record's robot; None where it states none.

    Raises RecordError: of other numbers, not finite, or no covariance.
    """
    if COVARIANCE not in record:
        return None
    covariance = np.asarray(record[COVARIANCE].values, dtype=float)
    names = (
        tuple(map(str, record["geometric_number"].values))
        if "geometric_number" in record.coords
        else ()
    )
    if names != robot.geometry.number_names or covariance.shape != (len(names),) * 2:
        raise RecordError(
            f"{COVARIANCE} has shape {covariance.shape} and is not of the "
            f"{len(robot.geometry.number_names)} geometric "
            f"numbers of {robot.name}, in their order"
        )
    if fault := covariance_fault(covariance):
        raise RecordError(f"{COVARIANCE} {fault}")
    return covariance
