"""The interface of the laws: what one is asked, and what it answers for a run of the closed loop."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from dynamics.closed_loop.drives import Drives
from dynamics.closed_loop.problem import Controller, EveryFrame, LoopSettings
from dynamics.control.inverse_dynamics import Model, Motion
from dynamics.control.observer import Estimate, Observer


@dataclass(frozen=True)
class Feedback:
    """What is asked of the loop of a law that sets torques: bandwidth, rad/s, and damping, 1; whether an observer
    predicts the pose."""

    bandwidth: float
    damping: float = 1.0
    observer: bool = True


@dataclass(frozen=True)
class Assignment:
    """What a law is asked: to make a robot follow a motion for some frames.

    model: the robot as the law knows it; settings: of the loop, its drives left to the law; holding (n,): the torque at
    rest at the start, as drives that take torques report it; latencies (frames,), s: when the command of each frame
    acts, of which a law may use those of frames that have come; noise(frame): covariance (6, 6) of the measured pose;
    common (6, 6): that of what all measured poses have in common.
    """

    model: Model
    motion: Motion
    frames: int
    settings: LoopSettings
    feedback: Feedback
    holding: np.ndarray
    latencies: np.ndarray
    noise: Callable[[int], np.ndarray]
    common: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))

    @property
    def period(self) -> float:
        """Time between two frames, s."""
        return 1 / self.settings.timing.frame_rate_hz

    def desired(self, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pose, rate and acceleration (6,) at a time, s."""
        at, motion = np.array([time]), self.motion
        return motion.pose(at)[0], motion.pose_rate(at)[0], motion.pose_acceleration(at)[0]

    def watched(self, drives: Drives) -> Observer:
        """An observer of the run."""
        holding = self.holding if drives.torques else self.model.held(self.desired(0.0)[0], drives)[0]
        settings = replace(self.settings, drives=drives)
        pose = self.desired(0.0)[0]
        return Observer(self.model, settings, pose, holding, self.latencies, self.noise, self.common)


@dataclass(frozen=True)
class LawInLoop:
    """What a law gives `closed_loop.simulate`, and what its observer, if any, expected of each frame; of the drives it
    decides whether they take torques. by_servo: whether a controller corrects by the gains of the servo."""

    feedforward: np.ndarray | None = None
    controller: Controller | EveryFrame | None = None
    drives: Drives = field(default_factory=Drives)
    expected: list[Estimate] = field(default_factory=list)
    by_servo: bool = False


Law = Callable[[Assignment], LawInLoop]
