"""Many closed-loop runs at once: repeats with different noise, and batches on all cores."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar, cast

import numpy as np

from dynamics.checks import Shape, check_type, flag, floats, whole
from dynamics.closed_loop.loop_settings import (
    FrameTiming,
    IdealSensor,
    LoopSettings,
    Reference,
    ServoGains,
)
from dynamics.closed_loop.problem import LoopProblem, commands_problem, servo_problem
from dynamics.closed_loop.run import ClosedLoopRun, LoopFailure
from dynamics.closed_loop.simulate import differentiate_servo, simulate_servo
from dynamics.closed_loop.start_state import StartState
from dynamics.errors import SimulationError
from dynamics.robot import Robot

Item = TypeVar("Item", Reference, StartState)


def repeat_servo(
    robot: Robot,
    parameters: np.ndarray,
    reference: Reference,
    settings: LoopSettings,
    noises: np.ndarray,
    *,
    lost: np.ndarray | None = None,
    start: StartState | None = None,
    feedforward: np.ndarray | None = None,
    latencies: np.ndarray | None = None,
    compiled: bool = True,
) -> list[ClosedLoopRun | LoopFailure]:
    """Run the servo's loop once for each noise of the ideal sensor.

    The results are equal to those of `simulate_servo` up to rounding. They take about half the time
    of separate runs, because the equation of motion is computed for eight runs at once.

    Parameters
    ----------
    robot, parameters, reference, settings, start, feedforward, latencies, compiled
        As for `simulate_servo`.
    noises : ndarray, shape (N, frames, 6)
        Noise of each run, m and rad, which is added to the measured poses.
    lost : ndarray of bool, shape (frames,), optional
        Frames at which nothing is measured.

    Returns
    -------
    list of ClosedLoopRun or LoopFailure
        One entry per noise, which is a LoopFailure for a run that ended early.

    Raises
    ------
    UnreachablePoseError, SingularPoseError, ParameterError, SimulationError
        As for `simulate_servo`.

    Examples
    --------
    With robot, parameters, still and settings of the example of `simulate_servo`:

    >>> noises = 1e-5 * np.random.default_rng(0).standard_normal((5, 3, 6))
    >>> len(closed_loop.repeat_servo(robot, parameters, still, settings, noises))
    5
    """
    problem = servo_problem(
        *(robot, parameters, reference, settings, IdealSensor(lost)),
        servo_robot=None,
        start=start,
        feedforward=feedforward,
        latencies=latencies,
    )
    return _repeat(problem, noises, compiled)


def repeat_commands(
    robot: Robot,
    parameters: np.ndarray,
    reference: Reference,
    settings: LoopSettings,
    commands: np.ndarray,
    noises: np.ndarray,
    *,
    latencies: np.ndarray | None = None,
    compiled: bool = True,
) -> list[ClosedLoopRun | LoopFailure]:
    """Run the robot under given commands once for each noise of the ideal sensor.

    The noise affects only the measured poses: all runs have the same motion.

    Parameters
    ----------
    robot, parameters, reference, settings, commands, latencies, compiled
        As for `simulate_commands`.
    noises : ndarray, shape (N, frames, 6)
        Noise of each run, m and rad, which is added to the measured poses.

    Returns
    -------
    list of ClosedLoopRun or LoopFailure
        The same as from `repeat_servo`.

    Raises
    ------
    UnreachablePoseError, SingularPoseError, ParameterError, SimulationError
        As for `simulate_commands`.

    Examples
    --------
    With robot, parameters, still and settings of the example of `simulate_servo`:

    >>> given = robot, parameters, still, settings, np.zeros((3, 6))
    >>> len(closed_loop.repeat_commands(*given, np.zeros((5, 3, 6))))
    5
    """
    problem = commands_problem(
        *(robot, parameters, reference, settings, commands, IdealSensor()),
        start=None,
        latencies=latencies,
        times=None,
    )
    return _repeat(problem, noises, compiled)


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
    """Run the servo's loop for many parameter vectors, references or starts, on all cores.

    Parameters
    ----------
    robot : Robot
        Robot that moves.
    parameters : ndarray, shape (p,) or (N, p)
        Parameters of all runs, or of each run, as for `closed_loop.simulate_servo`.
    references : Reference or sequence of Reference
        Desired motion of all runs, or of each run.
    settings : LoopSettings
        Settings of all runs.
    starts : StartState or sequence of StartState, optional
        State at the first frame, of all runs or of each run. The default is rest.
    sensitivities : bool
        True returns derivatives with respect to the parameters, as
        `closed_loop.differentiate_servo` does.
    start_sensitivities : bool
        True returns derivatives with respect to the parameters and the start state.
    workers : int, optional
        Number of threads, which has no effect on results. The default is one per core.

    Returns
    -------
    list of ClosedLoopRun
        The runs in order.

    Raises
    ------
    LoopFailure
        For the first run, in order, that ends early.
    UnreachablePoseError, SingularPoseError, ParameterError, SimulationError
        As for `closed_loop.simulate_servo`.

    Examples
    --------
    With robot, parameters, still and settings of the example of `simulate_servo`:

    >>> import dynamics
    >>> both = parameters * [[1.0], [1.01]]
    >>> len(dynamics.simulate_batch(robot, both, still, settings))
    2
    """
    threads = _cores() if workers is None else whole("workers", workers, SimulationError, least=1)
    check_type("robot", robot, Robot, SimulationError)
    width = len(robot.layout.names)
    shapes: tuple[Shape, Shape] = (width,), ("N", width)
    checked = floats("loop parameters", parameters, *shapes, error=SimulationError, finite=False)
    vectors = np.atleast_2d(checked)
    motions = _listed("references", references, Reference)
    start_states: Sequence[StartState | None] = [None]
    if starts is not None:
        start_states = _listed("starts", starts, StartState)
    by_start = flag("start_sensitivities", start_sensitivities, SimulationError)
    differentiated = flag("sensitivities", sensitivities, SimulationError) or by_start
    lengths = (len(vectors), len(motions), len(start_states))
    count = max(lengths)
    if not set(lengths) <= {1, count}:
        of_starts = "" if starts is None else f" and {len(start_states)} start states"
        raise SimulationError(
            f"got {len(vectors)} parameter vectors and {len(motions)} references{of_starts}; each "
            "number must be 1 or the number of runs"
        )

    def run(index: int) -> ClosedLoopRun:
        vector = vectors[index % len(vectors)]
        reference = motions[index % len(motions)]
        start = start_states[index % len(start_states)]
        if differentiated:
            return differentiate_servo(
                robot, vector, reference, settings, start=start, by_start=by_start
            )
        return simulate_servo(robot, vector, reference, settings, start=start)

    # the compiled loop releases Python's global lock, so that threads can use all cores
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(run, range(count)))


def prepare(robot: Robot) -> None:
    """Compile the functions and kernels that runs of a robot need, unless they are in the cache.

    Parameters
    ----------
    robot : Robot
        Robot that will be simulated.

    Raises
    ------
    SimulationError
        If `robot` is not a Robot.

    Examples
    --------
    >>> from dynamics import closed_loop, load_robot
    >>> closed_loop.prepare(load_robot("rss6"))
    """
    check_type("robot", robot, Robot, SimulationError)
    reference = Reference(np.tile(robot.home_pose, (2, 1)), np.zeros((2, 6)))
    settings = LoopSettings(ServoGains(0.0, 0.0, 0.0), FrameTiming(60.0))
    parameters = next(iter(robot.parameter_sets.values())).vector
    # the first call compiles the functions for single runs, the second those for several at once
    simulate_servo(robot, parameters, reference, settings)
    repeat_servo(robot, parameters, reference, settings, np.zeros((1, 2, 6)))


def _repeat(
    problem: LoopProblem, noises: np.ndarray, compiled: object
) -> list[ClosedLoopRun | LoopFailure]:
    """Do a run of a problem for each noise. Raises SimulationError for noises of a wrong shape."""
    shape: Shape = ("N", problem.frames, 6)
    noises = floats("noises", noises, shape, error=SimulationError)
    use_kernels = flag("compiled", compiled, SimulationError)
    # imported here, because the import of Numba takes time
    from dynamics.closed_loop.execution import run_repeats

    return run_repeats(problem, noises, use_kernels)


def _cores() -> int:
    """Number of cores that this process may use, or of all cores if that is unknown."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _listed(name: str, given: Item | Sequence[Item], kind: type[Item]) -> list[Item]:
    """List of the items, or of a single item. Raises SimulationError for items of another kind."""
    if isinstance(given, kind):
        return [given]
    check_type(name, given, Sequence, SimulationError)
    items = list(cast(Sequence[Item], given))
    for index, item in enumerate(items):
        check_type(f"{name}[{index}]", item, kind, SimulationError)
    return items
