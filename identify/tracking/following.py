"""Runs of a robot that follows a motion under a law with a model."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynamics import Robot
from dynamics.closed_loop import ClosedLoopRun, RateSensor, Reference
from dynamics.closed_loop.run import saturated_frames
from identify.arrays import Array
from identify.experiment.law_in_loop import KnownModel, NamedMotion, Seen, prepared
from identify.experiment.plant import Plant
from identify.experiment.run import Latencies

USUAL = Latencies()

NEARLY_EXACT = 1e-3
"""Share of the noise's covariance that is stated for exact poses.

An observer cannot divide by a covariance of zero.
"""


@dataclass(frozen=True)
class Followed:
    """Run of a robot that follows a motion.

    ``desired`` (N, 6) are the desired poses. ``expected`` are the coordinates (N, m) and
    covariances (N, m, m) that the observer predicted of each frame before it was measured, or None
    without an observer.
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
        """Return the normalised squared error of the observer's predictions.

        It is the mean of e^T P^-1 e / m, where e are the errors against the robot's true
        coordinates and P is their predicted covariance. None without an observer.
        """
        if self.expected is None:
            return None
        errors = robot.coordinates(self.run.pose) - self.expected[0]
        weighted = np.linalg.solve(self.expected[1], errors[..., None])[..., 0]
        return float(np.mean(np.sum(errors * weighted, axis=1)) / errors.shape[1])


def by_drawing(
    covariance: Array, lost: NDArray[np.bool_], rng: np.random.Generator, exact: bool = False
) -> Seen:
    """Return a measurement by drawn poses, instead of a sensor.

    The poses are drawn about the true ones with a covariance (6, 6), and there is none at lost
    frames (N,). With ``exact`` they are the true ones, and are stated as nearly exact: an observer
    that takes them as noisy would make less of them than it can.
    """
    # All frames are drawn at once, so that a lost frame does not shift the noise of later ones.
    factor = np.linalg.cholesky(covariance)
    drawn = rng.standard_normal((len(lost), 6)) @ factor.T

    def measure(frame: int, t: float, pose: Array, rate: Array) -> Array | None:
        if exact:
            return pose
        return None if lost[frame] else np.asarray(pose + drawn[frame])

    stated = NEARLY_EXACT * covariance if exact else covariance
    return Seen(measure, lambda frame: stated)


def follow(
    plant: Plant,
    law: str,
    known: KnownModel,
    motion: NamedMotion,
    seen: Seen,
    latencies: Latencies = USUAL,
) -> Followed:
    """Follow a motion under a law that knows a model.

    ``latencies`` replace those of the scenario. Raises what `prepared` does, and LoopFailure if the
    loop is lost.
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
    return Followed(run, reference.poses, expected, in_loop.drives.torque_limit)
