"""Results of a closed-loop run: its record, or the frame and the reason of an early end."""

from dataclasses import dataclass

import numpy as np

from dynamics.checks import whole
from dynamics.closed_loop.loop_settings import MAX_DELAY_FRAMES
from dynamics.closed_loop.start_state import StartState
from dynamics.errors import SimulationError


@dataclass(frozen=True)
class ClosedLoopRun:
    """Record of a run, one row per frame.

    The robot has n joints, m coordinates and p parameters (rss6: 6, 6, 67). With `groups`, p counts
    only the parameters for which `differentiate_servo` computes derivatives. The start state has
    s = 3 m + n entries, in the order of `StartState`. Fields that were not requested, or that the
    robot does not have, are None. Poses are in m and rad, joints in rad or m.

    Attributes
    ----------
    time : ndarray, shape (frames,)
        Time, s.
    pose, pose_rate : ndarray, shape (frames, 6)
        True pose and its time derivative.
    torque : ndarray, shape (frames, n)
        Actuator torque or force, N m or N. A command that arrives at the frame already acts.
    command : ndarray, shape (frames, n)
        Issued command, rad or m. If the drives take torques, it is a torque, N m or N.
    measured : ndarray, shape (frames, 6)
        Measured pose, NaN if the measurement was lost.
    measured_ok : ndarray of bool, shape (frames,)
        False if the measurement was lost.
    joint_integral : ndarray, shape (frames, n)
        Integral of the error of each drive, rad s or m s, at the beginning of the frame.
    servo_integral : ndarray, shape (frames, m)
        Integral of the servo's error, m s or rad s, at the beginning of the frame.
    pose_sensitivity : ndarray, shape (frames, 6, p)
        Derivatives of the poses with respect to the parameters.
    start_sensitivity : ndarray, shape (frames, 6, s)
        Derivatives of the poses with respect to the start state.
    command_sensitivity : ndarray, shape (frames, 6, k)
        Derivatives of the poses along k directions of the commands.
    end_sensitivity, end_start_sensitivity : ndarray, shapes (s, p) and (s, s)
        Derivatives of the state at the last frame with respect to parameters, and to start state.
    motor_angle, motor_rate : ndarray, shape (frames, n)
        Coordinate of the motors of elastic joints, and its rate.
    filtered_rate : ndarray, shape (frames, n)
        Filtered rate of the error of each drive, rad/s or m/s.
    events : int
        Number of stick-slip events, at which a joint comes to rest or breaks away.
    start : StartState
        State at the first frame.

    Examples
    --------
    >>> still = closed_loop.Reference(np.tile(robot.home_pose, (3, 1)), np.zeros((3, 6)))
    >>> servo = closed_loop.ServoGains(kp=0.3, kd=0.001, ki=2.4)
    >>> settings = closed_loop.LoopSettings(servo, closed_loop.FrameTiming(60.0))
    >>> parameters = robot.parameter_sets["truth"].vector
    >>> run = closed_loop.simulate_servo(robot, parameters, still, settings)
    >>> run.pose.shape
    (3, 6)
    >>> run.state_at(2).joint_integral.shape
    (6,)
    """

    time: np.ndarray
    pose: np.ndarray
    pose_rate: np.ndarray
    torque: np.ndarray
    command: np.ndarray
    measured: np.ndarray
    measured_ok: np.ndarray
    joint_integral: np.ndarray
    servo_integral: np.ndarray
    pose_sensitivity: np.ndarray | None
    start_sensitivity: np.ndarray | None
    command_sensitivity: np.ndarray | None
    end_sensitivity: np.ndarray | None
    end_start_sensitivity: np.ndarray | None
    motor_angle: np.ndarray | None
    motor_rate: np.ndarray | None
    filtered_rate: np.ndarray | None
    events: int
    start: StartState

    def __repr__(self) -> str:
        lost = len(self.time) - int(self.measured_ok.sum())
        return (
            f"ClosedLoopRun({len(self.time)} frames to {self.time[-1]:.4g} s, {lost} lost, "
            f"{self.events} events)"
        )

    def state_at(self, frame: int) -> StartState:
        """State at a frame, from which a new run repeats the remaining frames of this run.

        After frame 0, the state has neither derivatives nor latencies of its commands. Set
        `latencies` if they differ from the one of `FrameTiming`. Raises SimulationError if the run
        does not have the frame, or if the measurement of the previous frame was lost.
        """
        frame = whole("frame", frame, SimulationError, least=0, most=len(self.time) - 1)
        if frame == 0:
            return self.start
        if not self.measured_ok[frame - 1]:
            raise SimulationError(
                f"frame {frame} follows a lost measurement: no run can start there, because the "
                "last measured pose is more than one frame old"
            )
        # older commands have arrived, because no latency exceeds this number of frames
        commands = np.vstack([self.start.commands, self.command[:frame]])[-MAX_DELAY_FRAMES - 2 :]
        return StartState(
            self.pose[frame],
            self.pose_rate[frame],
            self.joint_integral[frame],
            self.servo_integral[frame],
            commands,
            self.measured[frame - 1],
            motor_angle=None if self.motor_angle is None else self.motor_angle[frame],
            motor_rate=None if self.motor_rate is None else self.motor_rate[frame],
            filtered_rate=None if self.filtered_rate is None else self.filtered_rate[frame],
        )


class LoopFailure(SimulationError):
    """Error that ends a run early, at the frame `frame`.

    `saturated` is the number of frames before this one in which an actuator was at its limit.
    """

    def __init__(self, message: str, frame: int, saturated: int = 0) -> None:
        super().__init__(message)
        self.frame = frame
        self.saturated = saturated


def saturated_frames(torque: np.ndarray, limit: float | None) -> int:
    """Number of frames in which a torque (frames, n) is at the limit, N m or N.

    A limit of None means that there is none, and the number is 0.
    """
    # the kernels limit torques only to within rounding errors
    return 0 if limit is None else int((np.abs(torque) >= limit * (1 - 1e-12)).any(axis=1).sum())
