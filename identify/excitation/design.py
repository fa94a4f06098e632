"""Design of a run's trajectories: the exciting trajectory, and random validation trajectories."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dynamics import Robot
from dynamics.kinematics.platform import Chart
from identify.arrays import Array, agreed
from identify.errors import TrajectoryError
from identify.excitation.constraints import MotionConstraints, check_periods
from identify.excitation.criteria import Criterion, log_observability, observability_index
from identify.excitation.search import SEARCHES, SearchProblem
from identify.excitation.trajectory_unknowns import SAMPLES_PER_HARMONIC, Unknowns, unknowns
from identify.loop_parameters import of_actuators
from identify.progress import Advance, Progress, SilentProgress
from identify.random_streams import EXCITATION, SEARCH, UNSEEN, child
from identify.scenario import Excitation
from identify.scenario.sections import Validation
from identify.trajectory import FourierTrajectory, TrajectorySet, check_travel, random_trajectory

ATTEMPTS = 50  # largest number of random trajectories per admissible trajectory, on average
# Function that raises TrajectoryError if a trajectory violates a limit at times (N,) [s].
Check = Callable[[FourierTrajectory, Array], object]


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
    """Draw random trajectories that pass `check`, within the travel and without singularities.

    The travel is the robot's travel limit minus the scenario's margin. Raises TrajectoryError, with
    the reason why the last one was refused, if too few trajectories are admissible.
    """
    rng = np.random.default_rng(seed)
    # The samples are denser than in a search, because limits can be violated between them.
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
        f"limits, but {count} are needed; the last one does not: {reason}"
    )


# Fraction by which random trajectories may exceed a limit. They are scaled to the box at sampled
# times, and can exceed it slightly between these times.
RANDOM_TOLERANCE = 1e-3


@dataclass(frozen=True)
class DesignTask:
    """Task of choosing trajectories for a robot.

    robot       Robot that shall follow the trajectories.
    settings    Form of the trajectories, and the search method of the exciting trajectory.
    validation  Number and length of the validation trajectories.
    limits      Limits of the motion.
    criterion   Function (unknowns, typical) that returns the criterion of the search, see
                `identify.excitation.criteria`.
    """

    robot: Robot
    settings: Excitation
    validation: Validation
    limits: MotionConstraints
    criterion: Callable[[Unknowns, Array], Criterion]

    def check(self, trajectory: FourierTrajectory, times: Array) -> None:
        """Raise TrajectoryError if a random trajectory violates a limit at times (N,) [s]."""
        self.limits.check(trajectory, times, RANDOM_TOLERANCE)

    def candidates(self, count: int, seed: int) -> list[FourierTrajectory]:
        """Draw the random candidates of a search. Raises TrajectoryError if there are too few."""
        settings = self.settings
        return admissible_trajectories(
            self.robot, settings, settings.duration_s, count, child(seed, EXCITATION), self.check
        )

    def search_problem(
        self, candidates: list[FourierTrajectory], advance: Advance = lambda n=1: None
    ) -> SearchProblem:
        """Set up the search with admissible random trajectories.

        Raises ScenarioError if the criterion is not valid. Raises TrajectoryError if the method
        needs a whole number of periods but the duration of the run is not one.
        """
        if self.settings.method != "random":
            check_periods(self.settings)
        free = unknowns(self.robot.geometry.chart, self.settings)
        pool = [free.of(trajectory) for trajectory in candidates]
        criterion = self.criterion(free, agreed(pool[0]))
        values = []
        for z in pool:
            values.append(-float(criterion.value(z)))
            advance()
        # With a stable sort, the order of equal values is the same on all machines.
        best_first = [pool[k] for k in np.argsort(values, kind="stable")]
        return SearchProblem(self.settings, free, self.limits, criterion, best_first)


def design_trajectories(
    design: DesignTask, seed: int, progress: Progress | None = None
) -> TrajectorySet:
    """Design the exciting trajectory and the validation trajectories.

    Excitation and validation have separate random streams.

    Raises ScenarioError if the criterion is not valid. Raises TrajectoryError if too few random
    trajectories of this amplitude are within the limits, if a search needs a whole number of
    periods but the duration of the run is not one, or if a search finds nothing.
    """
    progress = progress or SilentProgress()
    settings = design.settings
    with progress.stage("excitation", settings.candidates) as advance:
        candidates = design.candidates(settings.candidates, seed)
        problem = design.search_problem(candidates, advance)
    found = SEARCHES[settings.method](problem, child(seed, SEARCH), progress)
    index = log_observability(
        design.robot, problem.unknowns, settings.duration_s, problem.candidates[0]
    )
    indices = [
        observability_index(index, problem.unknowns.of(trajectory)) for trajectory in candidates
    ]
    return TrajectorySet(
        seed=seed,
        excitation=found.trajectory(problem),
        validation=validation_trajectories(design, seed),
        observability_index=observability_index(index, found.z),
        first_index=indices[0],
        median_index=float(np.median(indices)),
    )


def validation_trajectories(design: DesignTask, seed: int) -> tuple[FourierTrajectory, ...]:
    """Return the validation trajectories. They are random, without a search."""
    duration_s, count = design.validation.duration_s, design.validation.count
    stream = child(seed, UNSEEN)
    return tuple(
        admissible_trajectories(
            design.robot, design.settings, duration_s, count, stream, design.check
        )
    )
