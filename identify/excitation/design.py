"""Design of a run's trajectories: the exciting one, and unseen random ones."""

from collections.abc import Callable

import numpy as np

from dynamics import Robot
from dynamics.kinematics.chart import Chart
from identify.arrays import Array, agreed
from identify.errors import TrajectoryError
from identify.excitation.constraints import MotionConstraints, check_periods
from identify.excitation.criteria import criterion_of, log_observability, observability_index
from identify.excitation.motion import SAMPLES_PER_HARMONIC, unknowns
from identify.excitation.search import SEARCHES, SearchProblem
from identify.loop_parameters import of_actuators
from identify.progress import Advance, Progress, SilentProgress
from identify.random_streams import EXCITATION, SEARCH, UNSEEN, child
from identify.scenario import Excitation, Scenario
from identify.trajectory import FourierTrajectory, TrajectorySet, check_travel, random_trajectory

ATTEMPTS = 50
"""Average number of random trajectories that are tried for each admissible one."""

Check = Callable[[FourierTrajectory, Array], object]
"""Function that raises TrajectoryError for a trajectory that breaks a limit at times (N,) [s]."""


def drawn_trajectory(
    rng: np.random.Generator, chart: Chart, settings: Excitation
) -> FourierTrajectory:
    """Draw a random trajectory that fills the box of a scenario's excitation about home.

    Other limits are not considered.
    """
    box = (settings.position_amplitude_m, settings.orientation_amplitude_rad)
    return random_trajectory(rng, chart, settings.fundamental_hz, settings.harmonics, *box)


def admissible_trajectories(
    robot: Robot,
    settings: Excitation,
    duration_s: float,
    count: int,
    seed: np.random.SeedSequence,
    check: Check = lambda trajectory, times: None,
) -> list[FourierTrajectory]:
    """Draw random trajectories that keep the travel, avoid singularities and pass `check`.

    The travel is that of the robot less the scenario's margin.

    Raises TrajectoryError, with the last reason, if too few of them do.
    """
    rng = np.random.default_rng(seed)
    # Denser than a search samples, as limits can be broken between its instants.
    rate_hz = 4 * SAMPLES_PER_HARMONIC * settings.harmonics * settings.fundamental_hz
    t = np.arange(round(duration_s * rate_hz) + 1) / rate_hz
    accepted: list[FourierTrajectory] = []
    margin = of_actuators(robot, settings, "travel_margin")
    reason = TrajectoryError("none tried")
    for _ in range(ATTEMPTS * count):
        candidate = drawn_trajectory(rng, robot.geometry.chart, settings)
        try:
            check_travel(robot, candidate, t, margin, **settings.singularity_limits)
            check(candidate, t)
        except TrajectoryError as error:
            reason = error
            continue
        accepted.append(candidate)
        if len(accepted) == count:
            return accepted
    raise TrajectoryError(
        f"only {len(accepted)} of {ATTEMPTS * count} random trajectories of "
        f"±{settings.position_amplitude_m:g} m and "
        f"±{settings.orientation_amplitude_rad:g} rad stay inside the travel and the other "
        f"limits, {count} are needed; the last: {reason}"
    )


RANDOM_TOLERANCE = 1e-3
"""Share by which random trajectories may exceed a limit.

They fill the box only as closely as they were sampled for it.
"""


def design_trajectories(
    robot: Robot, scenario: Scenario, seed: int, progress: Progress | None = None
) -> TrajectorySet:
    """Design the exciting trajectory and the validation trajectories of a scenario.

    Each kind has its own stream of the seed.

    Raises ScenarioError if there is no such criterion. Raises TrajectoryError if no random
    trajectory of this amplitude keeps the limits, if a search needs a whole number of periods and
    has none, or if a search finds nothing.
    """
    progress = progress or SilentProgress()
    settings = scenario.excitation
    check = motion_check(robot, scenario)
    with progress.stage("excitation", settings.candidates) as advance:
        candidates = random_candidates(robot, scenario, settings.candidates, seed, check)
        problem = search_problem(robot, scenario, candidates, advance)
    found = SEARCHES[settings.method](problem, child(seed, SEARCH), progress)
    index = log_observability(robot, problem.unknowns, settings.duration_s, problem.candidates[0])
    indices = [
        observability_index(index, problem.unknowns.of(trajectory)) for trajectory in candidates
    ]
    return TrajectorySet(
        seed=seed,
        excitation=found.trajectory(problem),
        validation=_unseen(robot, scenario, seed, check),
        observability_index=observability_index(index, found.z),
        first_index=indices[0],
        median_index=float(np.median(indices)),
    )


def unseen_trajectories(
    robot: Robot, scenario: Scenario, seed: int
) -> tuple[FourierTrajectory, ...]:
    """Return the validation trajectories of a scenario without a search.

    They are the same as those of `design_trajectories`.
    """
    return _unseen(robot, scenario, seed, motion_check(robot, scenario))


def motion_check(robot: Robot, scenario: Scenario) -> Check:
    """Return the check of all limits of the motion of a scenario."""
    constraints = MotionConstraints(robot, scenario)
    return lambda trajectory, times: constraints.check(trajectory, times, RANDOM_TOLERANCE)


def random_candidates(
    robot: Robot, scenario: Scenario, count: int, seed: int, check: Check
) -> list[FourierTrajectory]:
    """Draw the random trajectories from which a search starts or chooses."""
    settings = scenario.excitation
    return admissible_trajectories(
        robot, settings, settings.duration_s, count, child(seed, EXCITATION), check
    )


def search_problem(
    robot: Robot,
    scenario: Scenario,
    candidates: list[FourierTrajectory],
    advance: Advance = lambda n=1: None,
) -> SearchProblem:
    """Set up the search of a scenario with admissible random trajectories.

    Raises ScenarioError if there is no such criterion. Raises TrajectoryError if the method needs a
    whole number of periods and the run has none.
    """
    settings = scenario.excitation
    if settings.method != "random":
        check_periods(scenario)
    free = unknowns(robot.geometry.chart, settings)
    pool = [free.of(trajectory) for trajectory in candidates]
    criterion = criterion_of(robot, scenario, free, agreed(pool[0]))
    values = []
    for z in pool:
        values.append(-float(criterion.value(z)))
        advance()
    # A stable order keeps the result the same where values are equal.
    best_first = [pool[k] for k in np.argsort(values, kind="stable")]
    return SearchProblem(settings, free, MotionConstraints(robot, scenario), criterion, best_first)


def _unseen(
    robot: Robot, scenario: Scenario, seed: int, check: Check
) -> tuple[FourierTrajectory, ...]:
    count = scenario.validation.count
    duration_s = scenario.validation.duration_s
    return tuple(
        admissible_trajectories(
            robot, scenario.excitation, duration_s, count, child(seed, UNSEEN), check
        )
    )
