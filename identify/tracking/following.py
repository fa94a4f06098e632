"""Runs of a robot that follows a motion under a law with a model."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynamics import Robot
from dynamics.closed_loop import ClosedLoopRun, RateSensor, Reference
from dynamics.closed_loop.run import saturated_frames
from identify.arrays import Array, normalised_square
from identify.experiment.law_in_loop import KnownModel, LoopSensor, NamedMotion, prepared
from identify.experiment.plant import Plant
from identify.experiment.run import Latencies

USUAL = Latencies()

# Factor of the stated covariance for exact poses. It is not zero, because an observer needs a
# positive definite covariance.
NEARLY_EXACT = 1e-3


@dataclass(frozen=True)
class TrackingRun:
    """Run of a robot that follows a motion.

    ``desired`` (N, 6) are the desired poses. ``expected`` are the coordinates (N, m) and
    covariances (N, m, m) that the observer predicted for each frame before its measurement, or None
    without an observer. ``torque_limit`` is the limit of each actuator, N m or N, or None.
    """

    run: ClosedLoopRun
    desired: Array
    expected: tuple[Array, Array] | None
    torque_limit: float | None

    @property
    def errors(self) -> Array:
        """True minus desired poses (N, 6) [m, rad]."""
        return self.run.pose - self.desired

    @property
    def saturated(self) -> int:
        """Number of frames at which an actuator was at its torque limit."""
        return saturated_frames(self.run.torque, self.torque_limit)

    def normalised_squared_error(self, robot: Robot) -> float | None:
        """Return the normalised squared error of the observer's predictions, or None without one.

        The error is the mean over frames of e^T P^-1 e / m, with the errors e of the m predicted
        coordinates and their predicted covariance P.
        """
        if self.expected is None:
            return None
        poses, covariances = self.expected
        return normalised_square(robot.coordinates(self.run.pose) - poses, covariances)


def by_drawing(
    covariance: Array, lost: NDArray[np.bool_], rng: np.random.Generator, exact: bool = False
) -> LoopSensor:
    """Return a substitute for a sensor, which draws the measured poses at random.

    The poses scatter about the true poses with a covariance (6, 6). Lost frames (N,) have no pose.
    With ``exact`` all frames have their true poses, also lost ones, and the stated covariance is
    nearly zero, so that an observer trusts the poses.
    """
    # All frames are drawn at once, so that a lost frame does not shift the noise of later ones.
    factor = np.linalg.cholesky(covariance)
    drawn = rng.standard_normal((len(lost), 6)) @ factor.T

    def measure(frame: int, t: float, pose: Array, rate: Array) -> Array | None:
        if exact:
            return pose
        return None if lost[frame] else np.asarray(pose + drawn[frame])

    stated = NEARLY_EXACT * covariance if exact else covariance
    return LoopSensor(measure, lambda frame: stated)


def follow(
    plant: Plant,
    law: str,
    known: KnownModel,
    motion: NamedMotion,
    seen: LoopSensor,
    latencies: Latencies = USUAL,
) -> TrackingRun:
    """Follow a motion under a law that uses a model.

    ``seen`` measures the poses, and ``latencies`` replace those of the scenario. Raises the errors
    of `prepared`, and LoopFailure if the loop is unstable.
    """
    in_loop = prepared(plant, law, known, motion, seen, latencies.known)
    times = plant.runs.timing.frame_times(motion.duration_s)
    reference = Reference(motion.motion.pose(times), motion.motion.pose_rate(times))
    run = plant.run(reference, RateSensor(seen.measure), latencies.true, law=in_loop)
    expected = None
    if in_loop.expected:
        means = np.array([estimate.coordinates for estimate in in_loop.expected])
        covariances = np.array([estimate.covariance for estimate in in_loop.expected])
        expected = means, covariances
    return TrackingRun(run, reference.poses, expected, in_loop.drives.torque_limit)
