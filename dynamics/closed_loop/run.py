"""What comes out of a closed-loop run: its record, or where and why it ended early."""

from dataclasses import dataclass

import numpy as np

from dynamics.checks import whole
from dynamics.closed_loop.problem import (
    LEFT_REACH,
    MAX_DELAY_FRAMES,
    MEASURED_OUT_OF_REACH,
    PARAMETER_COUNT,
    START_COUNT,
    LoopProblem,
    StartState,
)
from dynamics.errors import SimulationError
from dynamics.robot import Robot

RECORDS = ("pose", "pose_rate", "torque", "command", "measured", "joint_integral", "servo_integral")
"""What a run keeps of every frame, (frames, 6) each."""


@dataclass(frozen=True)
class ClosedLoopRun:
    """A run, one row a frame: time (s), true pose and pose rate, actuator torque (N m), command (rad), measured pose,
    whether the measurement was good; joint PID integral (rad s) and servo integral (m s, rad s) as the frame begins;
    derivatives of the poses by the parameters (frames, 6, 67) and by the start (frames, 6, 24; see StartState), and of
    the 24 entries of the last frame's state by both, end_sensitivity (24, 67) and end_start_sensitivity (24, 24), each
    or None; angle (rad) and rate of the motors of elastic joints, or None; number of stick-slip events; the start."""

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
    events: int
    start: StartState

    def __repr__(self) -> str:
        lost = len(self.time) - int(self.measured_ok.sum())
        return f"ClosedLoopRun({len(self.time)} frames to {self.time[-1]:.4g} s, {lost} lost, {self.events} events)"

    def state_at(self, frame: int) -> StartState:
        """The state at a frame: a run that starts from it repeats the rest of this one, if its latency is constant.

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
        )


def empty_run(problem: LoopProblem) -> ClosedLoopRun:
    """What a run is written into: zeros, and None for the derivatives that it is not asked for."""
    frames = problem.frames
    rows = dict(zip(RECORDS, np.zeros((len(RECORDS), frames, 6)), strict=True))
    by_parameters, by_start = problem.sensitivities, problem.start_sensitivities
    return ClosedLoopRun(
        time=np.arange(frames) * problem.period,
        **rows,
        measured_ok=np.zeros(frames, dtype=bool),
        pose_sensitivity=np.zeros((frames, 6, PARAMETER_COUNT)) if by_parameters else None,
        start_sensitivity=np.zeros((frames, 6, START_COUNT)) if by_start else None,
        end_sensitivity=np.zeros((START_COUNT, PARAMETER_COUNT)) if by_parameters else None,
        end_start_sensitivity=np.zeros((START_COUNT, START_COUNT)) if by_start else None,
        motor_angle=np.zeros((frames, 6)) if problem.settings.elasticity else None,
        motor_rate=np.zeros((frames, 6)) if problem.settings.elasticity else None,
        events=0,
        start=problem.start,
    )


class LoopFailure(SimulationError):
    """A run that ended early; `frame` says where."""

    def __init__(self, message: str, frame: int) -> None:
        super().__init__(message)
        self.frame = frame


def failure(reason: str, frame: int, problem: LoopProblem, pose: np.ndarray, measured: np.ndarray) -> LoopFailure:
    """The error of a run that ended early, the same on both paths; pose (6,) where it stopped, measured (frames, 6)."""
    when = f"frame {frame} (t = {frame * problem.period:.3f} s)"
    evidence = ""
    if reason == MEASURED_OUT_OF_REACH:
        evidence = f"; there {_nearest_leg(problem.robot, measured[frame])}"
    if reason == LEFT_REACH:
        evidence = f": {_nearest_leg(problem.robot, pose)}"
    return LoopFailure(f"closed loop stopped at {when}: {reason}{evidence}", frame)


def _nearest_leg(robot: Robot, pose: np.ndarray) -> str:
    margin = robot.reach_margin(pose)
    leg = int(np.argmin(margin))
    return f"leg {leg + 1} has the least reach margin, {margin[leg]:.3g}, must be > 0"
