"""What goes into a closed-loop run and what comes out: settings, reference, start state, result."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from dynamics.errors import SimulationError
from dynamics.friction import FrictionLaw
from dynamics.parameters import PARAMETER_NAMES
from dynamics.robot import Robot

PARAMETER_COUNT = len(PARAMETER_NAMES) + 3
MAX_DELAY_FRAMES = 60
LEFT_REACH = "the robot left the reachable set (the loop is unstable)"
MEASURED_OUT_OF_REACH = "the measured pose is out of reach, so that the servo has no command"
SINGULAR_MASS = "the mass matrix is not positive definite: masses or inertias are zero or overflow"

# (frame index, time s, true pose (6,)) -> measured pose (6,), or None when the measurement is lost.
PoseSensor = Callable[[int, float, np.ndarray], np.ndarray | None]


@dataclass(frozen=True)
class ServoGains:
    """Visual servo gains of eq. 30: kp (1), kd (s), ki (1/s)."""

    kp: float
    kd: float
    ki: float

    def __post_init__(self) -> None:
        for name in ("kp", "kd", "ki"):
            if not 0 <= getattr(self, name) < np.inf:
                raise SimulationError(f"servo gain {name} is {getattr(self, name)}, must be finite and >= 0")


@dataclass(frozen=True)
class FrameTiming:
    """Frame rate (Hz), latency from exposure to command (s), and the hold of the joint command between frames.

    hold "zero": the command jumps to its new value; "linear": it ramps there over one frame. In both the joint PID
    takes the difference of the last two commands over the frame period for U_dot.
    """

    frame_rate_hz: float
    latency_s: float = 0.0
    hold: Literal["zero", "linear"] = "zero"

    def __post_init__(self) -> None:
        if not 0 < self.frame_rate_hz < np.inf:
            raise SimulationError(f"frame rate is {self.frame_rate_hz} Hz, must be finite and > 0")
        if not 0 <= self.latency_s * self.frame_rate_hz <= MAX_DELAY_FRAMES:
            raise SimulationError(
                f"latency is {self.latency_s} s, must be >= 0 and at most {MAX_DELAY_FRAMES} frames "
                f"({MAX_DELAY_FRAMES / self.frame_rate_hz:.3g} s)"
            )
        if self.hold not in ("zero", "linear"):
            raise SimulationError(f"unknown hold `{self.hold}`; valid: zero, linear")


@dataclass(frozen=True)
class LoopSettings:
    """What the loop is made of besides the robot: servo, timing, friction law, Runge-Kutta steps per frame."""

    servo: ServoGains
    timing: FrameTiming
    friction: FrictionLaw = field(default_factory=FrictionLaw)
    steps_per_frame: int = 4

    def __post_init__(self) -> None:
        if self.steps_per_frame < 1 or self.steps_per_frame != int(self.steps_per_frame):
            raise SimulationError(f"steps_per_frame is {self.steps_per_frame}, must be a whole number >= 1")


@dataclass(frozen=True)
class Reference:
    """Desired motion at the frame times: poses (frames, 6) and pose rates (frames, 6)."""

    poses: np.ndarray
    rates: np.ndarray

    def __post_init__(self) -> None:
        for name in ("poses", "rates"):
            array = np.ascontiguousarray(getattr(self, name), dtype=float)
            if array.ndim != 2 or array.shape[1] != 6 or len(array) < 2 or not np.isfinite(array).all():
                raise SimulationError(f"reference {name} must be finite with shape (frames >= 2, 6), got {array.shape}")
            object.__setattr__(self, name, array)
        if self.poses.shape != self.rates.shape:
            raise SimulationError(f"reference poses {self.poses.shape} and rates {self.rates.shape} differ in shape")


@dataclass(frozen=True)
class StartState:
    """Equilibrium at the first reference pose: command = crank angles (6,), joint PID integral (6,) with its
    derivative with respect to the 67 parameters (6, 67), and servo integral (6,)."""

    command: np.ndarray
    joint_integral: np.ndarray
    joint_integral_sensitivity: np.ndarray
    servo_integral: np.ndarray


@dataclass(frozen=True)
class LoopProblem:
    """One run to be done, checked: what `closed_loop.simulate` was given, and the state it starts from."""

    robot: Robot
    parameters: np.ndarray
    reference: Reference
    settings: LoopSettings
    start: StartState
    sensor: PoseSensor | None
    sensitivities: bool
    commands: np.ndarray | None
    lost: np.ndarray | None

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.reference.poses)

    @property
    def period(self) -> float:
        """Time between two frames, s."""
        return 1.0 / self.settings.timing.frame_rate_hz


@dataclass(frozen=True)
class ClosedLoopRun:
    """A run, one row a frame: time (s), true pose and pose rate, actuator torque (N m), command (rad), measured pose,
    whether the measurement was good; pose_sensitivity (frames, 6, 67) or None; number of stick-slip events."""

    time: np.ndarray
    pose: np.ndarray
    pose_rate: np.ndarray
    torque: np.ndarray
    command: np.ndarray
    measured: np.ndarray
    measured_ok: np.ndarray
    pose_sensitivity: np.ndarray | None
    events: int


def checked_measurement(measured: ArrayLike | None, frame: int) -> np.ndarray | None:
    """What a pose sensor returned, as (6,) floats or None. Raises SimulationError for anything else."""
    if measured is None:
        return None
    array = np.asarray(measured, dtype=float)
    if array.shape != (6,) or not np.isfinite(array).all():
        raise SimulationError(
            f"the pose sensor returned {np.array2string(array, precision=6)} at frame {frame}, "
            "must be 6 finite numbers, or None for a lost measurement"
        )
    return array


class LoopFailure(SimulationError):
    """A run that ended early; `frame` says where."""

    def __init__(self, message: str, frame: int) -> None:
        super().__init__(message)
        self.frame = frame


def failure(reason: str, frame: int, problem: LoopProblem, pose: np.ndarray, measured: np.ndarray) -> LoopFailure:
    """The error of a run that ended early, the same on both paths; true and measured poses (frames, 6) up to there."""
    when = f"frame {frame} (t = {frame * problem.period:.3f} s)"
    evidence = ""
    if reason == MEASURED_OUT_OF_REACH:
        evidence = f"; there {_nearest_leg(problem.robot, measured[frame])}"
    if reason == LEFT_REACH:
        evidence = f"; at the start of the frame {_nearest_leg(problem.robot, pose[frame])}"
    return LoopFailure(f"closed loop stopped at {when}: {reason}{evidence}", frame)


def _nearest_leg(robot: Robot, pose: np.ndarray) -> str:
    margin = np.nan_to_num(robot.reach_margin(pose), nan=-np.inf)
    leg = int(np.argmin(margin))
    return f"leg {leg + 1} has the least reach margin, {margin[leg]:.3g}, must be > 0"
