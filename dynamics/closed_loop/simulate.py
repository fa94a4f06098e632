"""Closed-loop runs, with one function for each source of the joint commands.

The source is the visual servo in `simulate_servo`, a log in `simulate_commands`, and a control law
in `simulate_controller`. `differentiate_servo` and `differentiate_commands` also return
derivatives, and accept only an ideal sensor.
"""

from __future__ import annotations

import numpy as np

from dynamics.checks import check_type, flag
from dynamics.closed_loop.loop_settings import (
    IDEAL,
    Controller,
    EveryFrame,
    IdealSensor,
    LoopSettings,
    Reference,
    Sensor,
)
from dynamics.closed_loop.problem import (
    LoopProblem,
    commands_problem,
    controller_problem,
    servo_problem,
    with_derivatives,
)
from dynamics.closed_loop.run import ClosedLoopRun
from dynamics.closed_loop.start_state import StartState
from dynamics.errors import SimulationError
from dynamics.parameters import RigidGroups
from dynamics.robot import Robot


def simulate_servo(
    robot: Robot,
    parameters: np.ndarray,
    reference: Reference,
    settings: LoopSettings,
    sensor: Sensor = IDEAL,
    *,
    servo_robot: Robot | None = None,
    start: StartState | None = None,
    feedforward: np.ndarray | None = None,
    latencies: np.ndarray | None = None,
    compiled: bool = True,
) -> ClosedLoopRun:
    """Run the closed loop of the visual servo, whose drives must take joint commands.

    Parameters
    ----------
    robot : Robot
        Robot that moves.
    parameters : ndarray, shape (p,)
        Dynamic parameters of the robot, then the gains lp, li, ld of its drives.
    reference : Reference
        Desired motion, one row per frame.
    settings : LoopSettings
        Servo, timing, friction law, integration and drives.
    sensor : IdealSensor, PoseSensor or RateSensor
        Source of the measured poses.
    servo_robot : Robot, optional
        Robot whose kinematics the servo uses. The default is `robot`.
    start : StartState, optional
        State at the first frame. The default is rest at the first reference pose.
    feedforward : ndarray, shape (frames, n), optional
        Joint commands, rad or m, to which the servo adds its own commands. The default start
        assumes that the first row alone holds the robot at rest.
    latencies : ndarray, shape (frames,), optional
        Latency of each frame's command, s. The default is `settings.timing.latency_s`.
    compiled : bool
        False runs the same code in plain Python, thousands of times slower.

    Returns
    -------
    ClosedLoopRun
        Record of the run, with one row per frame.

    Raises
    ------
    LoopFailure
        If the run ends early, for example because the robot leaves its reach or because the sensor
        raises a DynamicsError.
    UnreachablePoseError, SingularPoseError
        If a pose of the reference or of the start is out of reach, or if the start is singular.
    ParameterError, SimulationError
        If another argument is not valid.

    Examples
    --------
    >>> import numpy as np
    >>> from dynamics import closed_loop, load_robot
    >>> from dynamics.closed_loop import FrameTiming, LoopSettings, Reference, ServoGains
    >>> robot = load_robot("rss6")
    >>> still = Reference(np.tile(robot.home_pose, (3, 1)), np.zeros((3, 6)))
    >>> settings = LoopSettings(ServoGains(kp=0.3, kd=0.001, ki=2.4), FrameTiming(60.0))
    >>> parameters = robot.parameter_sets["truth"].vector
    >>> closed_loop.simulate_servo(robot, parameters, still, settings)
    ClosedLoopRun(3 frames to 0.03333 s, 0 lost, 0 events)
    """
    problem = servo_problem(
        robot, parameters, reference, settings, sensor, servo_robot, start, feedforward, latencies
    )
    return _run(problem, compiled)


def simulate_commands(
    robot: Robot,
    parameters: np.ndarray,
    reference: Reference,
    settings: LoopSettings,
    commands: np.ndarray,
    sensor: Sensor = IDEAL,
    *,
    start: StartState | None = None,
    latencies: np.ndarray | None = None,
    times: np.ndarray | None = None,
    compiled: bool = True,
) -> ClosedLoopRun:
    """Run the robot under given commands. Measured poses are recorded but have no effect.

    Parameters
    ----------
    robot, parameters, reference, settings, sensor, start, latencies, compiled
        As for `simulate_servo`. The reference determines the number of frames and the pose at rest.
    commands : ndarray, shape (frames, n)
        Command of each frame: rad or m, or N m or N if the drives take torques. With `times`, a row
        of NaN issues no command. If the first row is NaN, `start` is required.
    times : ndarray, shape (frames,), optional
        Increasing times of the frames, s. The default is equal periods from zero on, at the frame
        rate. In any case, the command rate in the drives is the change of the command divided by
        this period.

    Returns
    -------
    ClosedLoopRun
        Record of the run, with one row per frame.

    Raises
    ------
    LoopFailure, UnreachablePoseError, SingularPoseError, ParameterError, SimulationError
        As for `simulate_servo`.

    Examples
    --------
    With robot, parameters, still and settings of the example of `simulate_servo`:

    >>> closed_loop.simulate_commands(robot, parameters, still, settings, np.zeros((3, 6)))
    ClosedLoopRun(3 frames to 0.03333 s, 0 lost, 0 events)
    """
    problem = commands_problem(
        robot, parameters, reference, settings, commands, sensor, start, latencies, times
    )
    return _run(problem, compiled)


def simulate_controller(
    robot: Robot,
    parameters: np.ndarray,
    reference: Reference,
    settings: LoopSettings,
    controller: Controller | EveryFrame,
    sensor: Sensor = IDEAL,
    *,
    start: StartState | None = None,
    latencies: np.ndarray | None = None,
    compiled: bool = True,
) -> ClosedLoopRun:
    """Run the closed loop of a control law.

    Parameters
    ----------
    robot, parameters, reference, settings, sensor, start, latencies, compiled
        As for `simulate_servo`.
    controller : Controller or EveryFrame
        Function (frame, time s, measured pose (6,), desired pose (6,), desired rate (6,)) ->
        command (n,), called at every frame that is measured. An `EveryFrame` is called at lost
        frames, too. Commands are in rad or m, or in N m or N if the drives take torques.

    Returns
    -------
    ClosedLoopRun
        Record of the run, with one row per frame.

    Raises
    ------
    LoopFailure
        As for `simulate_servo`, and if the controller raises a DynamicsError.
    UnreachablePoseError, SingularPoseError, ParameterError, SimulationError
        As for `simulate_servo`.

    Examples
    --------
    With robot, parameters, still and settings of the example of `simulate_servo`:

    >>> def follow(frame, time, measured, desired, desired_rate):
    ...     return robot.inverse_kinematics(desired)
    >>> closed_loop.simulate_controller(robot, parameters, still, settings, follow)
    ClosedLoopRun(3 frames to 0.03333 s, 0 lost, 0 events)
    """
    problem = controller_problem(
        robot, parameters, reference, settings, controller, sensor, start, latencies
    )
    return _run(problem, compiled)


def differentiate_servo(
    robot: Robot,
    parameters: np.ndarray,
    reference: Reference,
    settings: LoopSettings,
    sensor: IdealSensor = IDEAL,
    *,
    start: StartState | None = None,
    feedforward: np.ndarray | None = None,
    latencies: np.ndarray | None = None,
    by_start: bool = False,
    groups: RigidGroups | None = None,
    directions: np.ndarray | None = None,
    compiled: bool = True,
) -> ClosedLoopRun:
    """Run the servo's loop, and differentiate the poses and the state at the last frame.

    Parameters
    ----------
    robot, parameters, reference, settings, start, feedforward, latencies, compiled
        As for `simulate_servo`. The joints must be rigid.
    sensor : IdealSensor
        Ideal sensor. Derivatives include the effect of the parameters on the measured poses.
    by_start : bool
        True returns derivatives with respect to the start state, too.
    groups : RigidGroups, optional
        Groups of inertial parameters on which the motion depends. Derivatives are then computed
        only for the pivots (one parameter of each group) and for the parameters that are not
        inertial, which is faster. `groups.of_all` extends the derivatives to all parameters. A
        start with derivatives of its own must depend on these parameters only through the groups.
    directions : ndarray, shape (frames, n, k), optional
        Directions of the feedforward along which the poses are also differentiated. Their number k
        is at most `most_directions`. They cannot be combined with `by_start`.

    Returns
    -------
    ClosedLoopRun
        Record with `pose_sensitivity` and `end_sensitivity`. With `by_start`, it also has the
        sensitivities with respect to the start. With directions, it has `command_sensitivity`.

    Raises
    ------
    LoopFailure, UnreachablePoseError, SingularPoseError, ParameterError, SimulationError
        As for `simulate_servo`.

    Examples
    --------
    With robot, parameters, still and settings of the example of `simulate_servo`:

    >>> run = closed_loop.differentiate_servo(robot, parameters, still, settings)
    >>> run.pose_sensitivity.shape
    (3, 6, 67)
    """
    check_type("sensor", sensor, IdealSensor, SimulationError)
    problem = servo_problem(
        robot, parameters, reference, settings, sensor, None, start, feedforward, latencies
    )
    return _run(with_derivatives(problem, by_start, groups, directions), compiled)


def differentiate_commands(
    robot: Robot,
    parameters: np.ndarray,
    reference: Reference,
    settings: LoopSettings,
    commands: np.ndarray,
    sensor: IdealSensor = IDEAL,
    *,
    start: StartState | None = None,
    latencies: np.ndarray | None = None,
    times: np.ndarray | None = None,
    by_start: bool = False,
    groups: RigidGroups | None = None,
    directions: np.ndarray | None = None,
    start_directions: np.ndarray | None = None,
    compiled: bool = True,
) -> ClosedLoopRun:
    """Run the robot under given commands, with derivatives like those of `differentiate_servo`.

    Parameters
    ----------
    robot, parameters, reference, settings, commands, start, latencies, times, compiled
        As for `simulate_commands`.
    sensor, by_start, groups
        As for `differentiate_servo`.
    directions : ndarray, shape (frames, n, k), optional
        Directions of the commands along which the poses are also differentiated. Their number k is
        at most `most_directions`. They cannot be combined with `by_start`. With `times`, the
        direction of a row of NaN must be that of the command before.
    start_directions : ndarray, shape (n, k), optional
        Directions of the commands from before the start. All of these have the same directions. The
        default is zero.

    Returns
    -------
    ClosedLoopRun
        The same as from `differentiate_servo`.

    Raises
    ------
    LoopFailure, UnreachablePoseError, SingularPoseError, ParameterError, SimulationError
        As for `simulate_servo`.

    Examples
    --------
    With robot, parameters, still and settings of the example of `simulate_servo`:

    >>> commands = np.zeros((3, 6))
    >>> run = closed_loop.differentiate_commands(robot, parameters, still, settings, commands)
    >>> run.pose_sensitivity.shape
    (3, 6, 67)
    """
    check_type("sensor", sensor, IdealSensor, SimulationError)
    problem = commands_problem(
        robot, parameters, reference, settings, commands, sensor, start, latencies, times
    )
    return _run(with_derivatives(problem, by_start, groups, directions, start_directions), compiled)


def _run(problem: LoopProblem, compiled: object) -> ClosedLoopRun:
    """Do a run, compiled or as plain Python."""
    compiled = flag("compiled", compiled, SimulationError)
    # imported here, because the import of Numba takes time
    from dynamics.closed_loop.execution import run

    return run(problem, compiled)
