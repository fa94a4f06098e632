"""Binding of the compiled closed loop (C files, see `closed_loop.h`) by ctypes."""

import ctypes
from ctypes import CFUNCTYPE, POINTER, Structure, byref, c_byte, c_double, c_int, c_void_p, cast
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from dynamics.closed_loop.command_schedule import CommandSchedule, command_schedule
from dynamics.closed_loop.problem import (
    LEFT_REACH,
    MEASURED_OUT_OF_REACH,
    SINGULAR_MASS,
    LoopProblem,
    PoseSensor,
    RateSensor,
    measurement,
)
from dynamics.closed_loop.run import RECORDS, ClosedLoopRun, empty_run, failure
from dynamics.compilation import load_library, open_library
from dynamics.errors import SimulationError
from dynamics.legs.rss_geometry import Rss6Geometry
from dynamics.parameters import split_parameters
from dynamics.rigid_body.equation_of_motion import motion_functions

FAILURES = {
    1: LEFT_REACH,
    2: "more stick-slip events than a frame can hold",
    4: "out of memory",
    5: MEASURED_OUT_OF_REACH,
    6: SINGULAR_MASS,
}
SENSOR_FAILED = 3
SOURCES = (
    "closed_loop.h",
    "linear_algebra.c",
    "joint_friction.c",
    "elastic_joints.c",
    "joint_modes.c",
    "step_sensitivity.c",
    "stick_slip.c",
    "visual_servo.c",
    "closed_loop.c",
)
LAWS = ("coulomb_viscous", "smoothed", "stribeck")
_TIMES_AND_FRICTION = ("frame_period", "smoothing_velocity", "static_level", "stribeck_velocity")
# What the sensor callback returns. An error that escapes it makes ctypes return 0.
SENSOR_RAISED, MEASURED, LOST = 0, 1, 2
_SENSITIVITIES = ("pose_sensitivity", "start_sensitivity", "end_sensitivity", "end_start_sensitivity")
_MOTORS = ("motor_angle", "motor_rate")

_DoublePointer = POINTER(c_double)
_Measure = CFUNCTYPE(c_int, c_int, _DoublePointer, _DoublePointer, _DoublePointer)


class _Problem(Structure):
    _fields_ = [
        *[(name, c_int) for name in ("frames", "law", "sensitivities", "start_sensitivities", "commands_before")],
        *[(name, c_double) for name in _TIMES_AND_FRICTION],
        ("rigid", c_double * 52),
        ("coulomb", c_double * 6),
        ("viscous", c_double * 6),
        *[(name, c_double) for name in ("lp", "li", "ld", "kp", "kd", "ki")],
        *[(name, c_double) for name in ("stiffness", "damping", "motor_inertia")],
        *[(name, c_double * 6) for name in ("motor", "motor_rate")],
        *[(name, c_double * 6) for name in ("pose", "rate", "integral", "servo_integral", "last_measured")],
        *[(name, _DoublePointer) for name in ("start_commands", "integral_sensitivity")],
        *[(name, _DoublePointer) for name in ("reference", "reference_rate", "logged_commands")],
        ("lost", POINTER(c_byte)),
        ("noise", _DoublePointer),
        *[(name, POINTER(c_int)) for name in ("first_span", "span_command", "span_steps")],
        *[(name, _DoublePointer) for name in ("span_ramp", "span_duration")],
        *[(name, c_void_p) for name in ("servo_motion", "servo_motion_work")],
    ]


class _Trajectory(Structure):
    _fields_ = [
        *[(name, _DoublePointer) for name in RECORDS],
        ("measured_ok", POINTER(c_byte)),
        *[(name, _DoublePointer) for name in _SENSITIVITIES],
        *[(name, _DoublePointer) for name in _MOTORS],
        ("events", c_int),
        ("failed_frame", c_int),
        ("last_pose", c_double * 6),
    ]


@cache
def _library_at(path: Path) -> ctypes.CDLL:
    opened = open_library(path)
    opened.closed_loop_run.argtypes = [POINTER(_Problem), _Measure, POINTER(_Trajectory)]
    opened.closed_loop_run.restype = c_int
    return opened


def library(geometry: Rss6Geometry) -> ctypes.CDLL | None:
    """The compiled loop of a robot, compiled on first use; None without a C compiler."""
    path = load_library("closed_loop", geometry, motion_functions, SOURCES)
    return _library_at(path) if path else None


def run(compiled: ctypes.CDLL, problem: LoopProblem) -> ClosedLoopRun:
    """Do one run with the compiled loop; see `closed_loop.simulate`."""
    result = empty_run(problem)
    struct = _struct(problem, command_schedule(problem))
    trajectory = _Trajectory(
        **{name: _pointer(getattr(result, name)) for name in (*RECORDS, *_SENSITIVITIES, *_MOTORS)},
        measured_ok=result.measured_ok.ctypes.data_as(POINTER(c_byte)),
    )
    callback, raised = _callback(problem.sensor, problem.period)
    status = compiled.closed_loop_run(byref(struct), callback, byref(trajectory))
    if status == SENSOR_FAILED:
        raise raised[0] if raised else SimulationError("the pose sensor failed without an error")
    if status:
        last_pose = np.array(trajectory.last_pose)
        raise failure(FAILURES[status], trajectory.failed_frame, problem, last_pose, result.measured)
    return replace(result, events=trajectory.events)


def _struct(problem: LoopProblem, schedule: CommandSchedule) -> _Problem:
    """The C struct. It borrows the arrays' memory: problem and cached schedule keep them alive during the call."""
    servo, friction = problem.settings.servo, problem.settings.friction
    start, lost = problem.start, problem.lost
    struct = _Problem(
        frames=problem.frames,
        law=LAWS.index(friction.name),
        sensitivities=problem.sensitivities,
        start_sensitivities=problem.start_sensitivities,
        commands_before=len(start.commands),
        frame_period=problem.period,
        smoothing_velocity=friction.smoothing_velocity or 0.0,
        static_level=friction.static_level,
        stribeck_velocity=friction.stribeck_velocity or 0.0,
        kp=servo.kp,
        kd=servo.kd,
        ki=servo.ki,
        start_commands=_pointer(start.commands),
        integral_sensitivity=_pointer(start.joint_integral_sensitivity),
        reference=_pointer(problem.reference.poses),
        reference_rate=_pointer(problem.reference.rates),
        logged_commands=_pointer(problem.commands),
        lost=None if lost is None else lost.ctypes.data_as(POINTER(c_byte)),
        noise=_pointer(problem.noise),
        first_span=schedule.first_span.ctypes.data_as(POINTER(c_int)),
        span_command=schedule.command.ctypes.data_as(POINTER(c_int)),
        span_steps=schedule.steps.ctypes.data_as(POINTER(c_int)),
        span_ramp=_pointer(schedule.ramp),
        span_duration=_pointer(schedule.duration),
    )
    _fill_parameters(struct, problem)
    struct.pose[:], struct.rate[:], struct.integral[:] = start.pose, start.pose_rate, start.joint_integral
    struct.servo_integral[:], struct.last_measured[:] = start.servo_integral, start.last_measured
    if problem.servo_robot.geometry != problem.robot.geometry:
        known = library(problem.servo_robot.geometry)
        assert known is not None
        struct.servo_motion = cast(known.equation_of_motion, c_void_p)
        struct.servo_motion_work = cast(known.equation_of_motion_work, c_void_p)
    return struct


def _fill_parameters(struct: _Problem, problem: LoopProblem) -> None:
    rigid, struct.coulomb[:], struct.viscous[:], joint_pid = split_parameters(problem.parameters)
    struct.lp, struct.li, struct.ld = joint_pid
    elasticity, start = problem.settings.elasticity, problem.start
    if elasticity is not None:
        rigid = elasticity.beyond_the_springs(rigid)
        struct.stiffness, struct.damping = elasticity.stiffness, elasticity.damping
        struct.motor_inertia = elasticity.motor_inertia
        struct.motor[:], struct.motor_rate[:] = start.motor_angle, start.motor_rate
    struct.rigid[:] = rigid


def _pointer(array: np.ndarray | None) -> "ctypes._Pointer[c_double] | None":
    return None if array is None else array.ctypes.data_as(_DoublePointer)


def _callback(
    sensor: PoseSensor | RateSensor | None, period: float
) -> tuple["ctypes._CFunctionType", list[BaseException]]:
    """The sensor as a C callback; what it raises is kept for the caller, since C cannot pass it on."""
    raised: list[BaseException] = []
    if sensor is None:
        return _Measure(), raised

    def measure(
        frame: int,
        pose: "ctypes._Pointer[c_double]",
        rate: "ctypes._Pointer[c_double]",
        measured: "ctypes._Pointer[c_double]",
    ) -> int:
        try:
            result = measurement(sensor, frame, frame * period, np.array(pose[:6]), np.array(rate[:6]))
            for index in range(6):
                measured[index] = np.nan if result is None else result[index]
            return MEASURED if result is not None else LOST
        except BaseException as error:  # KeyboardInterrupt must cross the C frame too
            raised.append(error)
            return SENSOR_RAISED

    return _Measure(measure), raised
