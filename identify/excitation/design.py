"""The trajectories of a run: the exciting one by the scenario's method and criterion, and unseen random ones.

Methods: the best of `candidates` random trajectories; differential evolution that begins with them; IPOPT from the
best few of them. Criteria: the observability index (eq. 39), or the D-criterion in the linearised loop, by which the
searches go; what IPOPT found from several starts is then ranked by the D-criterion of the simulated loop.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dynamics import Robot
from identify.arrays import Array
from identify.errors import TrajectoryError
from identify.excitation.constraints import MotionConstraints, check_periods
from identify.excitation.gradient_search import climb
from identify.excitation.information import Knowledge, knowledge, log_information, log_linear_information
from identify.excitation.motion import SAMPLES_PER_HARMONIC, unknowns
from identify.excitation.observability import SMOOTHING_RAD_S, log_observability, observability_index
from identify.excitation.search import FEWEST_MEMBERS, SearchProblem, SearchResult, evolve
from identify.progress import Progress, SilentProgress
from identify.random_streams import EXCITATION, SEARCH, UNSEEN, child
from identify.scenario import Excitation, Scenario
from identify.trajectory import FourierTrajectory, TrajectorySet, check_travel, random_trajectory

# Random trajectories that a robot can be given: inside its travel and the other limits.


ATTEMPTS = 50
"""Random trajectories tried, on the average, for each one that has to be admissible."""

Check = Callable[[FourierTrajectory, Array], object]
"""Raises TrajectoryError for a trajectory that is not admissible at some instants (N,) [s]."""


def admissible_trajectories(
    robot: Robot,
    settings: Excitation,
    duration_s: float,
    count: int,
    seed: np.random.SeedSequence,
    check: Check = lambda trajectory, times: None,
) -> list[FourierTrajectory]:
    """Random trajectories that stay inside the travel less the margin and pass `check`.

    Raises TrajectoryError, with the last reason, when too few of them do.
    """
    rng = np.random.default_rng(seed)
    rate_hz = 4 * SAMPLES_PER_HARMONIC * settings.harmonics * settings.fundamental_hz
    t = np.arange(round(duration_s * rate_hz) + 1) / rate_hz
    accepted: list[FourierTrajectory] = []
    reason = TrajectoryError("none tried")
    for _ in range(ATTEMPTS * count):
        candidate = random_trajectory(
            rng,
            robot.home_pose,
            settings.fundamental_hz,
            settings.harmonics,
            settings.position_amplitude_m,
            settings.orientation_amplitude_rad,
        )
        try:
            check_travel(robot, candidate, t, settings.travel_margin_rad)
            check(candidate, t)
        except TrajectoryError as error:
            reason = error
            continue
        accepted.append(candidate)
        if len(accepted) == count:
            return accepted
    raise TrajectoryError(
        f"only {len(accepted)} of {ATTEMPTS * count} random trajectories of ±{settings.position_amplitude_m:g} m and "
        f"±{settings.orientation_amplitude_rad:g} rad stay inside the travel and the other limits, {count} are needed; "
        f"the last: {reason}"
    )


STARTS = 3
"""Random trajectories from which IPOPT climbs."""

RANDOM_TOLERANCE = 1e-3
"""Share by which random trajectories may go over a limit: they fill the box as closely as they were sampled for it."""


def design_trajectories(robot: Robot, scenario: Scenario, seed: int, progress: Progress | None = None) -> TrajectorySet:
    """Exciting trajectory and validation trajectories of a scenario, each kind from its own stream of the seed.

    Raises:
        TrajectoryError: no random trajectory of this amplitude keeps the limits; no whole number of periods where a
            search needs it; a search that finds nothing.
    """
    progress = progress or SilentProgress()
    settings = scenario.excitation
    check = motion_check(robot, scenario)
    if (settings.method, settings.criterion) == ("random", "observability"):
        excitation, indices = _best_random(robot, scenario, seed, check, progress)
    else:
        excitation, indices = _searched(robot, scenario, seed, check, progress)
    unseen = _unseen(robot, scenario, seed, check)
    return TrajectorySet(
        seed=seed,
        excitation=excitation,
        validation=unseen,
        observability_index=float(indices[0]),
        first_index=float(indices[1]),
        median_index=float(np.median(indices[1:])),
    )


def unseen_trajectories(robot: Robot, scenario: Scenario, seed: int) -> tuple[FourierTrajectory, ...]:
    """The validation trajectories of a scenario alone, the same as `design_trajectories` gives, without its search."""
    return _unseen(robot, scenario, seed, motion_check(robot, scenario))


def motion_check(robot: Robot, scenario: Scenario) -> Check:
    """What refuses a trajectory that breaks a limit beside the travel."""
    constraints = MotionConstraints(robot, scenario)
    return lambda trajectory, times: constraints.check(trajectory, times, RANDOM_TOLERANCE)


@dataclass(frozen=True)
class Search:
    """A scenario's search: the problem, its random candidates (z) in the order of their value, best first, and what is
    known before the run (None where the criterion does not ask)."""

    robot: Robot
    scenario: Scenario
    problem: SearchProblem
    candidates: list[Array]
    known: Knowledge | None

    def run(self, method: str, seed: np.random.SeedSequence, progress: Progress) -> SearchResult:
        """What one method finds."""
        if method == "random":
            best = self.candidates[0]
            count = len(self.candidates)
            return SearchResult(best, float(self.problem.value(best)), count, 0, 0, f"best of {count}")
        if method == "evolutionary":
            generations = self.scenario.excitation.generations
            with progress.stage("evolutionary search", generations) as advance:
                return evolve(self.problem, self.candidates, generations, np.random.default_rng(seed), advance)
        starts = self.candidates[:STARTS]
        with progress.stage("gradient search", len(starts)) as advance:
            return self._best(climb(self.problem, starts, advance))

    def _best(self, results: list[SearchResult]) -> SearchResult:
        if self.known is None:
            return results[0]
        trajectories = [result.trajectory(self.problem) for result in results]
        true = [log_information(self.robot, self.scenario, self.known, t) for t in trajectories]
        return results[int(np.argmax(true))]


def prepare_search(robot: Robot, scenario: Scenario, candidates: list[FourierTrajectory]) -> Search:
    """The search of a scenario among and from admissible random trajectories."""
    if scenario.excitation.method == "evolutionary" and len(candidates) < FEWEST_MEMBERS:
        raise TrajectoryError(
            f"excitation.candidates = {len(candidates)}: the evolutionary method needs at least {FEWEST_MEMBERS}"
        )
    if scenario.excitation.method != "random":
        check_periods(scenario)
    free = unknowns(robot.home_pose, scenario.excitation)
    pool = [free.of(trajectory) for trajectory in candidates]
    if scenario.excitation.criterion == "observability":
        known = None
        duration_s = scenario.excitation.duration_s
        value, smooth = (log_observability(robot, free, duration_s, pool[0], v) for v in (None, SMOOTHING_RAD_S))
    else:
        known = knowledge(robot, scenario)
        value, smooth = (log_linear_information(robot, free, scenario, known, v) for v in (None, SMOOTHING_RAD_S))
    problem = SearchProblem(free, MotionConstraints(robot, scenario), value, smooth)
    order = np.argsort([-float(value(z)) for z in pool], kind="stable")
    return Search(robot, scenario, problem, [pool[k] for k in order], known)


def _unseen(robot: Robot, scenario: Scenario, seed: int, check: Check) -> tuple[FourierTrajectory, ...]:
    count, duration_s = scenario.validation.count, scenario.validation.duration_s
    return tuple(admissible_trajectories(robot, scenario.excitation, duration_s, count, child(seed, UNSEEN), check))


def _candidates(robot: Robot, scenario: Scenario, seed: int, check: Check) -> list[FourierTrajectory]:
    settings = scenario.excitation
    drawn = child(seed, EXCITATION)
    return admissible_trajectories(robot, settings, settings.duration_s, settings.candidates, drawn, check)


def _best_random(
    robot: Robot, scenario: Scenario, seed: int, check: Check, progress: Progress
) -> tuple[FourierTrajectory, Array]:
    """The best candidate, and the indices (eq. 39) of it and of all."""
    settings = scenario.excitation
    with progress.stage("excitation", settings.candidates) as advance:
        candidates = _candidates(robot, scenario, seed, check)
        free = unknowns(robot.home_pose, settings)
        pool = [free.of(trajectory) for trajectory in candidates]
        index = log_observability(robot, free, settings.duration_s, pool[0])
        indices = []
        for z in pool:
            indices.append(observability_index(index, z))
            advance()
    best = int(np.argmax(indices))
    return candidates[best], np.array([indices[best], *indices])


def _searched(
    robot: Robot, scenario: Scenario, seed: int, check: Check, progress: Progress
) -> tuple[FourierTrajectory, Array]:
    """What the scenario's method finds, and the indices (eq. 39) of it and of all candidates."""
    settings = scenario.excitation
    candidates = _candidates(robot, scenario, seed, check)
    search = prepare_search(robot, scenario, candidates)
    found = search.run(settings.method, child(seed, SEARCH), progress)
    index = log_observability(robot, search.problem.unknowns, settings.duration_s, search.candidates[0])
    pool = [search.problem.unknowns.of(trajectory) for trajectory in candidates]
    return found.trajectory(search.problem), np.array([observability_index(index, z) for z in (found.z, *pool)])
