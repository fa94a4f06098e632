"""One run of a robot that follows a motion under a law with a model, by the sensor or by what
stands for it.
"""

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
"""Share of the noise's covariance that is stated of exact poses: with none an observer has nothing
to divide by.
"""


@dataclass(frozen=True)
class Followed:
    """A run: its loop, what was desired of it (N, 6), and what the observer expected of each frame
    before it saw it: the coordinates (N, m) and their covariances (N, m, m), None without."""

    run: ClosedLoopRun
    desired: Array
    expected: tuple[Array, Array] | None
    torque_limit: float | None

    @property
    def errors(self) -> Array:
        """True less desired poses (N, 6), m and rad."""
        return self.run.pose - self.desired

    @property
    def saturated(self) -> int:
        """Frames at which an actuator gave all that it has."""
        return saturated_frames(self.run.torque, self.torque_limit)

    def normalised_squared_error(self, robot: Robot) -> float | None:
        """Mean e^T P^-1 e / m of what the observer expected of the robot's true coordinates; None
        without observer.
        """
        if self.expected is None:
            return None
        errors = robot.coordinates(self.run.pose) - self.expected[0]
        weighted = np.linalg.solve(self.expected[1], errors[..., None])[..., 0]
        return float(np.mean(np.sum(errors * weighted, axis=1)) / errors.shape[1])


def by_drawing(
    covariance: Array, lost: NDArray[np.bool_], rng: np.random.Generator, exact: bool = False
) -> Seen:
    """By poses drawn about the true ones with a covariance (6, 6), none at lost frames (N,); or by
    the true ones, which are told to be nearly exact: an observer that takes them for noisy makes
    less of them than it can."""
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
    """Follow a motion under a law that knows a model; latencies: where they are not the scenario's.

    Raises what `prepared` does, and LoopFailure: a loop that is lost.
    """
    in_loop = prepared(plant, law, known, motion, seen, latencies.known)
    times = plant.scenario.timing.frame_times(motion.duration_s)
    reference = Reference(motion.motion.pose(times), motion.motion.pose_rate(times))
    run = plant.run(reference, RateSensor(seen.measure), latencies.true, law=in_loop)
    expected = None
    if in_loop.expected:
        means = np.array([estimate.coordinates for estimate in in_loop.expected])
        expected = means, np.array([estimate.covariance for estimate in in_loop.expected])
    return Followed(run, reference.poses, expected, in_loop.drives.torque_limit)
