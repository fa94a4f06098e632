"""Closed-loop runs, one or many: what is asked is checked and prepared, run compiled or plain, and handed back."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache
from typing import TypeVar, cast

import numpy as np

from dynamics.checks import Shape, check_type, flag, floats, mask, shown, whole
from dynamics.closed_loop.problem import (
    Controller,
    EveryFrame,
    FrameTiming,
    LoopProblem,
    LoopSettings,
    PoseSensor,
    RateSensor,
    Reference,
    ServoGains,
    StartState,
    check_start_pose,
    checked_loop_parameters,
    equilibrium,
)
from dynamics.closed_loop.run import ClosedLoopRun, LoopFailure
from dynamics.errors import SimulationError
from dynamics.parameters import RigidGroups
from dynamics.robot import Robot

Item = TypeVar("Item", Reference, StartState)


def simulate(
    robot: Robot,
    parameters: np.ndarray,
    reference: Reference,
    settings: LoopSettings,
    sensor: PoseSensor | RateSensor | None = None,
    *,
    start: StartState | None = None,
    sensitivities: bool = False,
    start_sensitivities: bool = False,
    commands: np.ndarray | None = None,
    feedforward: np.ndarray | None = None,
    lost: np.ndarray | None = None,
    noise: np.ndarray | None = None,
    latencies: np.ndarray | None = None,
    servo_robot: Robot | None = None,
    controller: Controller | EveryFrame | None = None,
    groups: RigidGroups | None = None,
    compiled: bool = True,
) -> ClosedLoopRun:
    """Run the closed loop for all parameters of a robot: the dynamic ones, then lp, li, ld.

    sensor: None for the ideal one. start: None for the equilibrium at the first reference pose, which moves with the
    parameters. sensitivities: also derivatives of the poses and of the last frame's state with respect to all
    parameters; start_sensitivities: those and the ones with respect to the start (ideal sensor only).
    commands (frames, n): drive the joints with these instead of the servo's; what is measured is then recorded and
    steers nothing.
    feedforward (frames, n), rad or m: joint commands to which the servo adds its own, so that it corrects only;
    before the run they were where the joints are.
    latencies (frames,), s: of each frame's command, instead of the settings' for all; see `command_schedule`.
    servo_robot: the robot whose kinematics the servo knows, where that is another (no sensitivities then).
    controller: takes the place of the servo: (frame, time s, measured pose (6,), desired pose (6,), desired rate (6,))
    -> joint command (n,), rad or m, at every frame that is measured; or an `EveryFrame`.
    Where the settings' drives take torques, commands, those of a controller and those of the start are torques.
    lost (frames,) bool: frames at which the ideal sensor measures nothing, so that a model loses what its plant lost.
    noise (frames, 6), m and rad: added to the poses that the ideal sensor measures elsewhere.
    groups: combinations through which alone the inertial parameters act, where they are known: sensitivities are then
    those by their pivots and all other parameters, in less time; `groups.of_all` says what follows for all. A start
    must not be given then.
    compiled: False runs the same lines in plain Python, thousands of times slower.
    Raises LoopFailure when the robot leaves the reachable set (an unstable loop, or actuators at their limit), or where
    sensor or controller raise a DynamicsError; and before the run UnreachablePoseError where reference or start leave
    it, ParameterError, SimulationError, SingularPoseError.
    """
    problem = _checked(
        robot,
        parameters,
        reference,
        settings,
        sensor,
        start=start,
        sensitivities=sensitivities,
        start_sensitivities=start_sensitivities,
        commands=commands,
        feedforward=feedforward,
        lost=lost,
        noise=noise,
        latencies=latencies,
        servo_robot=servo_robot,
        controller=controller,
        groups=groups,
    )
    compiled = flag("compiled", compiled, SimulationError)
    from dynamics.closed_loop.execution import run  # imports numba, which takes its time

    return run(problem, compiled)


def simulate_repeats(
    robot: Robot,
    parameters: np.ndarray,
    reference: Reference,
    settings: LoopSettings,
    noises: np.ndarray,
    *,
    commands: np.ndarray | None = None,
    lost: np.ndarray | None = None,
    latencies: np.ndarray | None = None,
    compiled: bool = True,
) -> list[ClosedLoopRun | LoopFailure]:
    """`simulate` with each noise of noises (N, frames, 6), m and rad, in the poses that the ideal sensor measures.

    All runs are those of `simulate` up to rounding, and take about half its time: the equation of motion is computed
    for eight of them at once. A run that leaves the reachable set gives its LoopFailure; raises what else `simulate`
    raises.
    """
    problem = _checked(robot, parameters, reference, settings, commands=commands, lost=lost, latencies=latencies)
    noises = floats("noises", noises, ("N", problem.frames, 6), error=SimulationError)
    compiled = flag("compiled", compiled, SimulationError)
    from dynamics.closed_loop.execution import run_repeats

    return run_repeats(problem, noises, compiled)


def simulate_batch(
    robot: Robot,
    parameters: np.ndarray,
    references: Reference | Sequence[Reference],
    settings: LoopSettings,
    *,
    starts: StartState | Sequence[StartState] | None = None,
    sensitivities: bool = False,
    start_sensitivities: bool = False,
    workers: int | None = None,
) -> list[ClosedLoopRun]:
    """Run the closed loop with the ideal sensor for N parameter vectors (N, p), references, starts, or them in pairs.

    A single vector (p,), reference or start serves all runs. Results are those of `simulate`, in order, and do not
    depend on `workers` (default: one a core). Raises what `simulate` raises, for the first run that fails.
    """
    threads = _cores() if workers is None else whole("workers", workers, SimulationError, least=1)
    check_type("robot", robot, Robot, SimulationError)
    width = len(robot.layout.names)
    shapes: tuple[Shape, Shape] = (width,), ("N", width)
    vectors = np.atleast_2d(floats("loop parameters", parameters, *shapes, error=SimulationError, finite=False))
    given = _listed("references", references, Reference)
    begins: Sequence[StartState | None] = [None] if starts is None else _listed("starts", starts, StartState)
    lengths = (len(vectors), len(given), len(begins))
    count = max(lengths)
    if not set(lengths) <= {1, count}:
        of_starts = "" if starts is None else f" and {len(begins)} start states"
        raise SimulationError(f"{len(vectors)} parameter vectors and {len(given)} references{of_starts} do not pair up")

    def one(index: int) -> ClosedLoopRun:
        return simulate(
            robot,
            vectors[index % len(vectors)],
            given[index % len(given)],
            settings,
            start=begins[index % len(begins)],
            sensitivities=sensitivities,
            start_sensitivities=start_sensitivities,
        )

    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(one, range(count)))


def prepare(robot: Robot) -> None:
    """Compile what a robot's runs need, one or many, if that has not been done: its functions and the loop (some
    seconds)."""
    check_type("robot", robot, Robot, SimulationError)
    reference = Reference(np.tile(robot.home_pose, (2, 1)), np.zeros((2, 6)))
    settings = LoopSettings(ServoGains(0.0, 0.0, 0.0), FrameTiming(60.0))
    given = robot, next(iter(robot.parameter_sets.values())).vector, reference, settings
    simulate(*given)
    simulate_repeats(*given, np.zeros((1, 2, 6)))


def _checked(
    robot: Robot,
    parameters: np.ndarray,
    reference: Reference,
    settings: LoopSettings,
    sensor: PoseSensor | RateSensor | None = None,
    *,
    start: StartState | None = None,
    sensitivities: bool = False,
    start_sensitivities: bool = False,
    commands: np.ndarray | None = None,
    feedforward: np.ndarray | None = None,
    lost: np.ndarray | None = None,
    noise: np.ndarray | None = None,
    latencies: np.ndarray | None = None,
    servo_robot: Robot | None = None,
    controller: Controller | EveryFrame | None = None,
    groups: RigidGroups | None = None,
) -> LoopProblem:
    """What `simulate` was asked, checked; it raises what that raises before the run."""
    check_type("robot", robot, Robot, SimulationError)
    check_type("reference", reference, Reference, SimulationError)
    check_type("settings", settings, LoopSettings, SimulationError)
    if servo_robot is not None:
        check_type("servo_robot", servo_robot, Robot, SimulationError)
    if groups is not None:
        check_type("groups", groups, RigidGroups, SimulationError)
    if sensor is not None and not callable(sensor) and not isinstance(sensor, RateSensor):
        raise SimulationError(f"sensor must be a function of frame, time and pose, or None, got {shown(sensor)}")
    if controller is not None and not callable(controller) and not isinstance(controller, EveryFrame):
        raise SimulationError(f"controller must be a function, or None for the servo, got {shown(controller)}")
    start_sensitivities = flag("start_sensitivities", start_sensitivities, SimulationError)
    sensitivities = flag("sensitivities", sensitivities, SimulationError) or start_sensitivities
    _check_reach(robot, reference)
    frames, parameters = len(reference.poses), checked_loop_parameters(robot, parameters, settings.drives.law)
    feedforward = _checked_rows("feedforward", feedforward, (frames, robot.layout.joints))
    started = start is not None
    if start is None:
        known, at = (parameters.tobytes(), reference.poses[0].tobytes()), (servo_robot, feedforward is not None)
        start = _at_rest(robot, *known, settings, *at)
    else:
        check_type("start", start, StartState, SimulationError)
        start.check_sizes(robot)
        check_start_pose(robot, parameters, start.pose)
        _check_latencies(settings.timing, "start latencies: that of command", start.latencies)
    if latencies is not None:
        latencies = floats("latencies", latencies, (frames,), error=SimulationError)
        _check_latencies(settings.timing, "latency of frame", latencies)
    problem = LoopProblem(
        robot,
        parameters,
        reference,
        settings,
        start,
        sensor,
        sensitivities,
        start_sensitivities,
        commands=_checked_rows("commands", commands, (frames, robot.layout.joints)),
        feedforward=feedforward,
        lost=None if lost is None else mask("lost", lost, frames, SimulationError),
        noise=_checked_rows("noise", noise, (frames, 6)),
        latencies=latencies,
        servo_robot=servo_robot or robot,
        controller=controller,
        groups=groups,
    )
    _check_together(problem, servo_robot, started)
    _check_elasticity(problem)
    return problem


@lru_cache(maxsize=16)
def _at_rest(
    robot: Robot, parameters: bytes, pose: bytes, settings: LoopSettings, servo_robot: Robot | None, fed_forward: bool
) -> StartState:
    """The state of rest at a pose (6,), for all parameters; found once for the runs of one model, and frozen."""
    values, elasticity = np.frombuffer(parameters), settings.elasticity
    servo, drives = settings.servo, settings.drives
    start = equilibrium(robot, values, np.frombuffer(pose), servo, servo_robot, elasticity, fed_forward, drives)
    start = _driven(robot, values, settings, start)
    for part in vars(start).values():
        if part is not None:
            part.setflags(write=False)
    return start


def _driven(robot: Robot, parameters: np.ndarray, settings: LoopSettings, rest: StartState) -> StartState:
    """The state of rest of drives that take torques: the command is what holds the robot."""
    if not settings.drives.torques:
        return rest
    return replace(rest, commands=robot.static_torque(rest.pose, parameters[robot.layout.dynamic])[None])


def _cores() -> int:
    """Cores that this process may use; where only Linux can say so, all of the machine."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _listed(name: str, given: Item | Sequence[Item], kind: type[Item]) -> list[Item]:
    if isinstance(given, kind):
        return [given]
    check_type(name, given, Sequence, SimulationError)
    items = list(cast(Sequence[Item], given))
    for index, item in enumerate(items):
        check_type(f"{name}[{index}]", item, kind, SimulationError)
    return items


@lru_cache(maxsize=64)
def _check_reach(robot: Robot, reference: Reference) -> None:
    """Raise UnreachablePoseError, naming frame and leg, for a pose out of a robot's reach; asked once for both."""
    robot.check_reach(reference.poses, "reference pose", "frame")


def _check_latencies(timing: FrameTiming, name: str, latencies: np.ndarray | None) -> None:
    """Raise SimulationError for a latency that no run can have."""
    for number, latency in enumerate([] if latencies is None else latencies.tolist()):
        timing.check_latency(f"{name} {number}", latency)


def _checked_rows(name: str, rows: object, shape: tuple[int, int]) -> np.ndarray | None:
    """Rows of a shape as C doubles; None stays None. Raises SimulationError."""
    return None if rows is None else np.ascontiguousarray(floats(name, rows, shape, error=SimulationError))


def _check_together(problem: LoopProblem, servo_robot: Robot | None, started: bool) -> None:
    """Raise SimulationError for options of a run that exclude each other; servo_robot as the caller gave it, started:
    whether a start was given."""
    sensed, controlled, derived = problem.sensor is not None, problem.controller is not None, problem.sensitivities
    driven = problem.settings.drives.torques
    if problem.servo_robot.geometry.chart != problem.robot.geometry.chart:
        raise SimulationError(f"servo_robot {problem.servo_robot.name} has other coordinates than {problem.robot.name}")
    refusals = {
        "sensitivities need the ideal sensor: pass sensor=None": sensed and derived,
        "lost is for the ideal sensor: a sensor returns None at the frames that it loses": sensed
        and problem.lost is not None,
        "noise is for the ideal sensor: a sensor that is given adds its own": sensed and problem.noise is not None,
        "sensitivities need a servo that knows the robot: pass servo_robot=None": derived and servo_robot is not None,
        "sensitivities are those of rigid joints: pass settings with elasticity=None": derived
        and problem.settings.elasticity is not None,
        "sensitivities are those of the servo: pass controller=None": controlled and derived,
        "feedforward is for the servo: pass commands=None and controller=None": problem.feedforward is not None
        and (controlled or problem.commands is not None),
        "drives that take torques need a controller or commands: the servo commands joints": driven
        and not controlled
        and problem.commands is None,
        "groups are for runs that begin at rest: pass start=None": problem.groups is not None and started,
        "commands take the place of any controller: pass controller=None": controlled and problem.commands is not None,
    }
    for words, excluded in refusals.items():
        if excluded:
            raise SimulationError(words)


def _check_elasticity(problem: LoopProblem) -> None:
    """Raise SimulationError where elastic joints have no start of their motors, or steps too long to follow them."""
    elasticity, start, settings = problem.settings.elasticity, problem.start, problem.settings
    if elasticity is None:
        return
    if start.motor_angle is None or start.motor_rate is None:
        raise SimulationError("a start with elastic joints needs motor_angle and motor_rate")
    steps = elasticity.steps_needed(problem.robot, problem.parameters, start.pose, problem.period, settings.friction)
    if settings.steps_per_frame < steps:
        raise SimulationError(
            f"steps_per_frame is {settings.steps_per_frame}, must be >= {steps} to follow joints with "
            f"a stiffness of {elasticity.stiffness:g} N m/rad"
        )
