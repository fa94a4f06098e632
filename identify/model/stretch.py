"""Stretch of a record that begins in motion, and the state in which it begins.

The first poses of a stretch determine its pose and pose rate at the start, by a polynomial in time.
The integrals of the drives follow from the torque that holds the robot there, and from the
difference between commands and joints there. Each of these numbers has an error with a wide prior,
because the whole stretch determines the number much better.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dynamics import Robot
from dynamics.closed_loop import LoopSettings, StartState, equilibrium
from dynamics.closed_loop.drives import JointLaw
from identify.arrays import Array
from identify.record.stored_common_errors import START

FIRST_S = 0.2  # time, s, from the start of a stretch, in which the poses determine the start
FEWEST = 6  # smallest number of poses that determine the start, if a stretch has so many
DEGREE = 3  # degree of the polynomial through the first poses
WIDE = 20.0  # ratio of the prior standard deviations of a start to those of the polynomial


@dataclass(frozen=True)
class Stretch:
    """Part of a run, and the state in which it begins.

    robot                    Robot as the estimator knows it.
    number                   Number of the stretch in its record, from 1.
    rows                     Rows of the poses of the stretch.
    coordinates, rates (m,)  Coordinates of the platform at the start, and their rates.
    integral (n,)            Integrals of the drives minus those at rest at the same coordinates,
                             rad s or m s.
    std (2 m + n,)           Standard deviations of coordinates, rates and integrals.
    """

    robot: Robot
    number: int
    rows: slice
    coordinates: Array
    rates: Array
    integral: Array
    std: Array

    @cached_property
    def error_names(self) -> tuple[str, ...]:
        """Names of the errors of the start, in the order of the standard deviations."""
        chart = self.robot.geometry.chart
        kind = START if self.number == 1 else f"{START}{self.number}"
        axes = list(zip(chart.coordinate_names, chart.units, strict=True))
        joints = range(1, self.robot.layout.joints + 1)
        return (
            *(f"{kind}.{name}_{unit}" for name, unit in axes),
            *(f"{kind}.rate_{name}_{unit}/s" for name, unit in axes),
            *(f"{kind}.integral_{joint}_{self.robot.layout.joint_unit} s" for joint in joints),
        )

    @property
    def stds(self) -> dict[str, float]:
        """Standard deviations of the errors of the start by name, without those that are zero."""
        pairs = zip(self.error_names, self.std.tolist(), strict=True)
        return {name: std for name, std in pairs if std}

    def start_state(
        self,
        robot: Robot,
        parameters: Array,
        settings: LoopSettings,
        errors: Mapping[str, float],
        commands: Array,
        since: Array,
    ) -> StartState:
        """Return the state in which a model begins the stretch.

        robot, parameters, settings     Robot that moves, its parameters (p,) with the load, and the
                                        settings of the loop.
        errors                          Errors of the start by name, in their units. Others are
                                        zero.
        commands, since (k, n) and (k,)
                                        Commands that began to act before the start, and the times
                                        at which they began, relative to the start, s.
        """
        chart = robot.geometry.chart
        offsets = np.array([errors.get(name, 0.0) for name in self.error_names])
        count = len(self.coordinates)
        offset, rate, integral = np.split(offsets, [count, 2 * count])
        pose = chart.pose(self.coordinates + offset)
        # The integrals have errors of their own, which do not depend on that of the pose.
        held = chart.pose(self.coordinates)
        rest = equilibrium(robot, parameters, held, settings.servo, drives=settings.drives)
        # A run assumes that the commands before its start were issued one period apart.
        period = 1.0 / settings.timing.frame_rate_hz
        issued = np.arange(-len(commands), 0) * period
        return StartState(
            pose=pose,
            pose_rate=chart.lifted(self.rates + rate),
            joint_integral=rest.joint_integral + self.integral + integral,
            servo_integral=np.zeros(count),
            commands=commands,
            last_measured=pose,
            joint_integral_sensitivity=rest.joint_integral_sensitivity,
            latencies=np.maximum(since - issued, 0.0),
        )


def begun_stretch(
    robot: Robot,
    number: int,
    rows: slice,
    times: Array,
    measured: Array,
    covariance: Array,
    commands: Array,
    law: JointLaw,
) -> Stretch:
    """Return a stretch with the start that its poses and commands suggest.

    robot, number, rows             As for `Stretch`.
    times, measured (k,) and (k, 6)
                                    Times and poses of the stretch, without lost ones, two or
                                    more.
    covariance (6, 6)               Covariance of a pose.
    commands (k, n)                 Commands that act at these times.
    law                             Law of the drives with the gains of the initial guess.
    """
    chart = robot.geometry.chart
    since = times - times[0]
    count = max(int(np.searchsorted(since, FIRST_S)), min(FEWEST, len(since)))
    powers = np.vander(since[:count], min(DEGREE, count - 1) + 1, increasing=True)
    inverse = np.linalg.pinv(powers)
    fit = inverse @ chart.coordinates(measured[:count])
    free = chart.basis.T @ covariance @ chart.basis
    noise = np.sqrt(np.diag(free))
    norms = np.linalg.norm(inverse, axis=1)
    joints = robot.inverse_kinematics(chart.pose(chart.coordinates(measured)))
    error = commands - joints
    # A law without an integral has no error of an integral.
    with np.errstate(divide="ignore"):
        per_torque = np.where(law.li > 0, 1.0 / law.li, 0.0)
    lag = law.lp * np.sqrt(np.mean(error**2, axis=0))
    return Stretch(
        robot=robot,
        number=number,
        rows=rows,
        coordinates=fit[0],
        rates=fit[1],
        integral=-law.lp * per_torque * error[0],
        std=np.concatenate(
            [WIDE * norms[0] * noise, WIDE * norms[1] * noise, WIDE * per_torque * lag]
        ),
    )
