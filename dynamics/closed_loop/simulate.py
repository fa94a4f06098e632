"""One closed-loop run: what is asked is checked and prepared, run compiled or plain, and handed back."""

import numpy as np

from dynamics.checks import check_type, flag
from dynamics.closed_loop import compiled_loop as compiled_closed_loop
from dynamics.closed_loop import plain_loop as plain_closed_loop
from dynamics.closed_loop.preparation import (
    check_elasticity,
    check_kinds,
    check_start_pose,
    check_together,
    checked_loop_parameters,
    checked_lost,
    checked_rows,
    equilibrium,
)
from dynamics.closed_loop.problem import (
    Controller,
    LoopProblem,
    LoopSettings,
    PoseSensor,
    RateSensor,
    Reference,
    StartState,
    checked_latencies,
)
from dynamics.closed_loop.run import ClosedLoopRun
from dynamics.errors import SimulationError
from dynamics.robot import Robot


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
    lost: np.ndarray | None = None,
    noise: np.ndarray | None = None,
    latencies: np.ndarray | None = None,
    servo_robot: Robot | None = None,
    controller: Controller | None = None,
    compiled: bool | None = None,
) -> ClosedLoopRun:
    """Run the closed loop for parameters (67,): the 64 dynamic ones, then lp, li, ld.

    sensor: None for the ideal one. start: None for the equilibrium at the first reference pose, which moves with the
    parameters. sensitivities: also derivatives of the poses and of the last frame's state with respect to all
    parameters; start_sensitivities: those and the ones with respect to the start (ideal sensor only).
    commands (frames, 6): drive the joints with these instead of the servo's; what is measured is then recorded and
    steers nothing.
    latencies (frames,), s: of each frame's command, instead of the settings' for all; see `command_schedule`.
    servo_robot: the robot whose kinematics the servo knows, where that is another (no sensitivities then).
    controller: takes the place of the servo: (frame, time s, measured pose (6,), desired pose (6,), desired rate (6,))
    -> joint command (6,), rad, at every frame that is measured; the run takes the plain path.
    lost (frames,) bool: frames at which the ideal sensor measures nothing, so that a model loses what its plant lost.
    noise (frames, 6), m and rad: added to the poses that the ideal sensor measures elsewhere.
    compiled: None takes the compiled path when a C compiler is at hand; False forces the plain path.
    Raises LoopFailure when the robot leaves the reachable set (an unstable loop); and before the run
    UnreachablePoseError where reference or start do, ParameterError, SimulationError, SingularPoseError.
    """
    check_kinds(robot, reference, settings, sensor, servo_robot, controller)
    start_sensitivities = flag("start_sensitivities", start_sensitivities, SimulationError)
    sensitivities = flag("sensitivities", sensitivities, SimulationError) or start_sensitivities
    compiled = None if compiled is None else flag("compiled", compiled, SimulationError)
    reference.check_reach(robot)
    frames, parameters = len(reference.poses), checked_loop_parameters(parameters)
    problem = LoopProblem(
        robot,
        parameters,
        reference,
        settings,
        _start(robot, parameters, reference, settings, start, servo_robot),
        sensor,
        sensitivities,
        start_sensitivities,
        commands=checked_rows("commands", commands, frames),
        lost=checked_lost(lost, frames),
        noise=checked_rows("noise", noise, frames),
        latencies=None if latencies is None else checked_latencies(latencies, frames, settings.timing),
        servo_robot=servo_robot or robot,
        controller=controller,
    )
    check_together(problem, servo_robot, compiled)
    check_elasticity(problem)
    return _run(problem, compiled)


def _start(
    robot: Robot,
    parameters: np.ndarray,
    reference: Reference,
    settings: LoopSettings,
    start: StartState | None,
    servo_robot: Robot | None,
) -> StartState:
    """The start that was given, checked, or rest at the first reference pose."""
    if start is None:
        return equilibrium(robot, parameters, reference.poses[0], settings.servo, servo_robot, settings.elasticity)
    check_type("start", start, StartState, SimulationError)
    check_start_pose(robot, parameters, start.pose)
    return start


def _run(problem: LoopProblem, compiled: bool | None) -> ClosedLoopRun:
    """Take the compiled path or the plain one; a user's controller is called on the plain one."""
    wanted = compiled is not False and problem.controller is None
    library = compiled_closed_loop.library(problem.robot.geometry) if wanted else None
    if library is not None:
        return compiled_closed_loop.run(library, problem)
    if compiled:
        raise SimulationError("compiled=True, but no C compiler was found")
    return plain_closed_loop.run(problem.robot, problem)


def prepare(robot: Robot) -> bool:
    """Compile the loop of a robot if that has not been done; False where no C compiler is at hand."""
    check_type("robot", robot, Robot, SimulationError)
    return compiled_closed_loop.library(robot.geometry) is not None
