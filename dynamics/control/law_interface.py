"""Interface of the control laws: the assignment of a law, and its result for a run.

These laws control the platform. The laws of the joints' drives, including the PID of the paper, are
in `dynamics.closed_loop.drives`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from dynamics.closed_loop.drives import Drives
from dynamics.closed_loop.loop_settings import Controller, EveryFrame, LoopSettings
from dynamics.control.inverse_dynamics import Model, Motion
from dynamics.control.observer import Estimate, Observer


@dataclass(frozen=True)
class Feedback:
    """Desired feedback of a law. Bandwidth and damping are for laws that command torques.

    Parameters
    ----------
    bandwidth : float
        Bandwidth, rad/s.
    damping : float
        Damping ratio.
    observer : bool
        True if an observer predicts the pose. The law feedforward uses it, too.

    Examples
    --------
    >>> from dynamics.control import Feedback
    >>> Feedback(bandwidth=20.0)
    Feedback(bandwidth=20.0, damping=1.0, observer=True)
    """

    bandwidth: float
    damping: float = 1.0
    observer: bool = True


@dataclass(frozen=True)
class Assignment:
    """Assignment of a law: to make a robot follow a motion for a number of frames.

    Parameters
    ----------
    model : Model
        Robot as the law knows it.
    motion : Motion
        Desired motion.
    frames : int
        Number of frames.
    settings : LoopSettings
        Settings of the loop. The law decides whether the drives take torques.
    feedback : Feedback
        Desired bandwidth and damping.
    holding : ndarray, shape (n,)
        Torque at rest at the start, as reported by drives that take torques, N m or N.
    latencies : ndarray, shape (frames,)
        Latency of each frame's command, s. A law is only allowed to use the latencies of the
        present frame and of earlier frames.
    noise : callable
        Function frame -> covariance (6, 6) of the noise of the measured pose.
    common : ndarray, shape (6, 6)
        Covariance of the error that all measured poses have in common.

    Examples
    --------
    >>> from dynamics.control import Assignment, Feedback, Model
    >>> parameters = robot.parameter_sets["truth"].vector
    >>> servo = closed_loop.ServoGains(kp=0.3, kd=0.001, ki=2.4)
    >>> task = Assignment(
    ...     model=Model(robot, parameters, closed_loop.FrictionLaw()),
    ...     motion=None,  # an object with the methods of `Motion`
    ...     frames=3,
    ...     settings=closed_loop.LoopSettings(servo, closed_loop.FrameTiming(50.0)),
    ...     feedback=Feedback(bandwidth=20.0),
    ...     holding=np.zeros(6),
    ...     latencies=np.zeros(3),
    ...     noise=lambda frame: 1e-10 * np.eye(6),
    ... )
    >>> task.period
    0.02
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
        """Pose, pose rate and pose acceleration (6,) at a time, s."""
        times = np.array([time])
        motion = self.motion
        return motion.pose(times)[0], motion.pose_rate(times)[0], motion.pose_acceleration(times)[0]

    def watched(self, drives: Drives) -> Observer:
        """Observer of the run. `drives` may differ from those of the settings."""
        holding = (
            self.holding if drives.torques else self.model.held(self.desired(0.0)[0], drives)[0]
        )
        settings = replace(self.settings, drives=drives)
        pose = self.desired(0.0)[0]
        return Observer(
            self.model, settings, pose, holding, self.latencies, self.noise, self.common
        )


@dataclass(frozen=True)
class LawInLoop:
    """Result of a law: a feedforward for the servo, a controller, or neither for the servo alone.

    Parameters
    ----------
    feedforward : ndarray, shape (frames, n), optional
        Joint commands, to which the servo adds its own commands.
    controller : Controller or EveryFrame, optional
        Controller that replaces the servo.
    drives : Drives
        Drives of the run. The law decides whether they take torques.
    expected : list of Estimate
        Estimates of the law's observer, one for each frame, filled during the run.
    by_servo : bool
        True for a controller that uses the gains of the servo.

    Examples
    --------
    >>> from dynamics.control import LawInLoop
    >>> LawInLoop(feedforward=np.zeros((3, 6))).controller is None
    True
    """

    feedforward: np.ndarray | None = None
    controller: Controller | EveryFrame | None = None
    drives: Drives = field(default_factory=Drives)
    expected: list[Estimate] = field(default_factory=list)
    by_servo: bool = False


Law = Callable[[Assignment], LawInLoop]


def pid(assignment: Assignment) -> LawInLoop:
    """Law `pid`: the visual servo of the paper around the drives, without a model."""
    return LawInLoop(drives=assignment.settings.drives)
