"""Settings of a closed-loop run: servo, timing, sensor, controller and reference."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from dynamics.checks import check_choice, check_type, floats, real, whole
from dynamics.closed_loop.drives import PID, Drives
from dynamics.closed_loop.joints import FrictionLaw, JointElasticity
from dynamics.errors import SimulationError
from dynamics.kinematics.platform import Chart

MAX_DELAY_FRAMES = 60  # largest latency of a command, frames
MAX_STEPS_PER_FRAME = 10_000  # largest number of integration steps in a frame

Hold = Literal["zero", "linear"]

# (frame index, time s, true pose (6,)) -> measured pose (6,), or None if it is lost
PoseSensor = Callable[[int, float, np.ndarray], np.ndarray | None]

# (frame index, time s, measured pose (6,), desired pose (6,), desired pose rate (6,)) -> command
# (n,): joint coordinates, rad or m, or torques, N m or N, if the drives take torques
Controller = Callable[[int, float, np.ndarray, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class RateSensor:
    """Pose sensor whose measurement depends on the pose rate.

    Parameters
    ----------
    measure : callable
        Function (frame, time s, true pose (6,), true pose rate (6,)) -> measured pose (6,), or None
        if the measurement is lost.

    Examples
    --------
    >>> sensor = closed_loop.RateSensor(lambda frame, time, pose, rate: pose + 0.01 * rate)
    """

    measure: Callable[[int, float, np.ndarray, np.ndarray], np.ndarray | None]


@dataclass(frozen=True)
class IdealSensor:
    """Pose sensor that measures the true pose, with given noise.

    Parameters
    ----------
    lost : ndarray of bool, shape (frames,), optional
        Frames at which nothing is measured.
    noise : ndarray, shape (frames, 6), optional
        Values that are added to the poses, m and rad.

    Examples
    --------
    >>> import numpy as np
    >>> from dynamics.closed_loop import IdealSensor
    >>> sensor = IdealSensor(lost=np.array([False, True, False]))
    """

    lost: np.ndarray | None = None
    noise: np.ndarray | None = None


IDEAL = IdealSensor()
"""Sensor that measures every true pose without noise."""

Sensor = IdealSensor | PoseSensor | RateSensor


def ideal_poses(
    sensor: IdealSensor, chart: Chart, coordinates: np.ndarray, frames: int | slice = slice(None)
) -> np.ndarray:
    """Poses (..., 6) that an ideal sensor measures at frames, from noisy coordinates (..., m).

    Noise in directions in which the platform cannot move is not among the coordinates.
    """
    poses = chart.pose(coordinates)
    return poses if sensor.noise is None else poses + chart.forbidden(poses + sensor.noise[frames])


@dataclass(frozen=True)
class EveryFrame:
    """Controller that is called at every frame, even if the measurement is lost.

    Parameters
    ----------
    command : callable
        Function (frame, time s, measured pose (6,) or None) -> command (n,), as from a Controller.

    Examples
    --------
    >>> hold = closed_loop.EveryFrame(lambda frame, time, measured: np.zeros(6))
    """

    command: Callable[[int, float, np.ndarray | None], np.ndarray]


@dataclass(frozen=True)
class ServoGains:
    """Gains of the visual servo of eq. 30.

    Parameters
    ----------
    kp, kd, ki : float
        Gains of the error (no unit), of its rate (s) and of its integral (1/s), each >= 0.

    Raises
    ------
    SimulationError
        If a gain is negative or not finite.

    Examples
    --------
    >>> closed_loop.ServoGains(kp=0.3, kd=0.001, ki=2.4)
    ServoGains(kp=0.3, kd=0.001, ki=2.4)
    """

    kp: float
    kd: float
    ki: float

    def __post_init__(self) -> None:
        for name in ("kp", "kd", "ki"):
            real(f"servo gain {name}", getattr(self, name), SimulationError, least=0)

    def demand(self, error: np.ndarray, rate_error: np.ndarray, integral: np.ndarray) -> np.ndarray:
        """Demand (m,) of the servo, eq. 30: the command before the Jacobian maps it to the joints.

        The arguments are the error (m,) of the coordinates, desired minus measured, its rate and
        its integral. The compiled loop has the same law in `visual_servo_kernels.serve`.
        """
        return self.kp * error + self.kd * rate_error + self.ki * integral


@dataclass(frozen=True)
class FrameTiming:
    """Timing of the frames and of the joint commands.

    The joint PID uses a rate of the command, U_dot: the difference of the acting command and the
    one issued before it, divided by the frame period, even if the command jumps.

    Parameters
    ----------
    frame_rate_hz : float
        Frame rate, Hz.
    latency_s : float
        Time from the exposure of a frame to the arrival of its command, s.
    hold : {"zero", "linear"}
        With "zero" the command jumps to its new value. With "linear" it ramps to this value over
        one frame period.

    Raises
    ------
    SimulationError
        If the rate is not > 0, if the latency is negative or more than 60 frames, or if the hold is
        unknown.

    Examples
    --------
    >>> closed_loop.FrameTiming(29.0, latency_s=0.03).hold
    'zero'
    """

    frame_rate_hz: float
    latency_s: float = 0.0
    hold: Hold = "zero"

    def __post_init__(self) -> None:
        real("frame rate", self.frame_rate_hz, SimulationError, above=0, unit=" Hz")
        real("latency", self.latency_s, SimulationError, unit=" s")
        self.check_latency("latency", self.latency_s)
        check_choice("hold", self.hold, get_args(Hold), SimulationError)

    def check_latency(self, name: str, latency_s: float) -> None:
        """Raise SimulationError for a latency that is negative or too long."""
        if not 0 <= latency_s * self.frame_rate_hz <= MAX_DELAY_FRAMES:
            limit = f"{MAX_DELAY_FRAMES} frames ({MAX_DELAY_FRAMES / self.frame_rate_hz:.3g} s)"
            raise SimulationError(f"{name} is {latency_s} s, must be >= 0 and at most {limit}")


@dataclass(frozen=True)
class LoopSettings:
    """Settings of the loop around a robot.

    Parameters
    ----------
    servo : ServoGains
        Gains of the visual servo.
    timing : FrameTiming
        Frame rate, latency and hold.
    friction : FrictionLaw
        Law of joint friction.
    steps_per_frame : int
        Number of Runge-Kutta steps per frame.
    elasticity : JointElasticity, optional
        Springs of the joints. The default is rigid joints.
    drives : Drives
        Law of the drives, and limits of torques and commands.

    Raises
    ------
    SimulationError
        If an argument has a wrong type, or if the number of steps is out of range.

    Examples
    --------
    >>> servo = closed_loop.ServoGains(kp=0.3, kd=0.001, ki=2.4)
    >>> closed_loop.LoopSettings(servo, closed_loop.FrameTiming(60.0)).steps_per_frame
    4
    """

    servo: ServoGains
    timing: FrameTiming
    friction: FrictionLaw = field(default_factory=FrictionLaw)
    steps_per_frame: int = 4
    elasticity: JointElasticity | None = None
    drives: Drives = PID

    def __post_init__(self) -> None:
        kinds = {
            "servo": ServoGains,
            "timing": FrameTiming,
            "friction": FrictionLaw,
            "drives": Drives,
        }
        for name, kind in kinds.items():
            check_type(name, getattr(self, name), kind, SimulationError)
        if self.elasticity is not None:
            check_type("elasticity", self.elasticity, JointElasticity, SimulationError)
        steps = whole(
            "steps_per_frame",
            self.steps_per_frame,
            SimulationError,
            least=1,
            most=MAX_STEPS_PER_FRAME,
        )
        object.__setattr__(self, "steps_per_frame", steps)


@dataclass(frozen=True, eq=False)
class Reference:
    """Desired motion at the times of the frames. The arrays are copied and frozen.

    Parameters
    ----------
    poses, rates : array_like, shape (frames, 6)
        Poses, m and rad, and pose rates, m/s and rad/s, of two frames or more.

    Raises
    ------
    SimulationError
        If the arrays have wrong shapes, or entries that are not finite.

    Examples
    --------
    >>> closed_loop.Reference(np.tile(robot.home_pose, (3, 1)), np.zeros((3, 6)))
    Reference(3 frames)
    """

    poses: np.ndarray
    rates: np.ndarray

    def __post_init__(self) -> None:
        for name in ("poses", "rates"):
            array = floats(
                f"reference {name}", getattr(self, name), ("N", 6), error=SimulationError
            )
            if len(array) < 2:
                raise SimulationError(
                    f"reference {name} must have at least 2 frames, got {len(array)}"
                )
            frozen = np.array(array, order="C")
            frozen.setflags(write=False)
            object.__setattr__(self, name, frozen)
        if self.poses.shape != self.rates.shape:
            raise SimulationError(
                f"reference poses {self.poses.shape} and rates {self.rates.shape} differ in shape"
            )

    def __repr__(self) -> str:
        return f"Reference({len(self.poses)} frames)"
