"""What comes out of a closed-loop run: its record, or where and why it ended early."""

from dataclasses import dataclass

import numpy as np

from dynamics.checks import whole
from dynamics.closed_loop.problem import MAX_DELAY_FRAMES, StartState
from dynamics.errors import SimulationError


@dataclass(frozen=True)
class ClosedLoopRun:
    """A run, one row a frame, of a robot with n joints, m coordinates and p parameters (rss6: 6, 6, 67): time (s), true
    pose and pose rate (6,), actuator torque (N m or N) and command (rad or m) (n,), measured pose, whether the
    measurement was good; joint PID integral (n,) and servo integral (m,) as the frame begins; derivatives of the poses
    by the parameters (frames, 6, p) and by the s = 3 m + n entries of the start (frames, 6, s; see StartState), and of
    those of the last frame's state by both, end_sensitivity (s, p) and end_start_sensitivity (s, s), each or None;
    angle and rate of the motors of elastic joints, and the rates of the joints' errors that drives filter, or None;
    number of stick-slip events; the start."""

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
    end_sensitivity: np.ndarray | None
    end_start_sensitivity: np.ndarray | None
    motor_angle: np.ndarray | None
    motor_rate: np.ndarray | None
    filtered_rate: np.ndarray | None
    events: int
    start: StartState

    def __repr__(self) -> str:
        lost = len(self.time) - int(self.measured_ok.sum())
        return f"ClosedLoopRun({len(self.time)} frames to {self.time[-1]:.4g} s, {lost} lost, {self.events} events)"

    def state_at(self, frame: int) -> StartState:
        """The state at a frame: a run that starts from it repeats the rest of this one, where latencies differ with
        those of the commands before beside it.

        Raises SimulationError for a frame that the run does not have, or that follows a lost measurement.
        """
        frame = whole("frame", frame, SimulationError, least=0, most=len(self.time) - 1)
        if frame == 0:
            return self.start
        if not self.measured_ok[frame - 1]:
            raise SimulationError(f"frame {frame} follows a lost measurement: the servo's last one is older")
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
    """A run that ended early: `frame` says where, `saturated` at how many frames before an actuator gave all."""

    def __init__(self, message: str, frame: int, saturated: int = 0) -> None:
        super().__init__(message)
        self.frame, self.saturated = frame, saturated


def saturated_frames(torque: np.ndarray, limit: float | None) -> int:
    """Frames at which an actuator gave all that it has, of torques (frames, n), with a limit, N m or N, or none."""
    return 0 if limit is None else int((np.abs(torque) >= limit * (1 - 1e-12)).any(axis=1).sum())
