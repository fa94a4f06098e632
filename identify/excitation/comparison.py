"""The three methods side by side: same criterion, same seed, same random candidates."""

import time
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from dynamics import Robot
from dynamics.closed_loop import prepare
from identify.errors import TrajectoryError
from identify.excitation.constraints import Worst
from identify.excitation.criterion_information import knowledge, log_information
from identify.excitation.design import motion_check, prepare_search
from identify.excitation.evolutionary_search import FEWEST_MEMBERS
from identify.excitation.motion import sample_times
from identify.excitation.observability import log_observability, observability_index
from identify.excitation.random_trajectories import admissible_trajectories
from identify.progress import Progress
from identify.random_streams import EXCITATION, SEARCH, child
from identify.scenario import Scenario
from identify.trajectory import FourierTrajectory

METHODS = ("random", "evolutionary", "gradient")

COMPARISON_REFINEMENT = 10
"""How much finer the margins are reported than constraints are seen by a search."""


@dataclass(frozen=True)
class Entry:
    """What one method found: trajectory, value of the criterion that it maximised, the index of eq. 39, D of the
    simulated loop (None where it is unstable at the starting guess), seconds of the search, counts of the criterion and
    of its gradient, iterations, why it stopped, and where it comes nearest to each limit."""

    method: str
    trajectory: FourierTrajectory
    value: float
    observability: float
    information: float | None
    seconds: float
    evaluations: int
    gradients: int
    iterations: int
    reason: str
    worst: tuple[Worst, ...]

    def figures(self) -> dict[str, Any]:
        """All figures, for a file."""
        figures = asdict(self)
        figures["trajectory"] = asdict(self.trajectory)
        return figures


@dataclass(frozen=True)
class Comparison:
    """The entries of all methods; the seconds that making candidates and functions took once for all of them."""

    criterion: str
    seed: int
    candidates: int
    preparation_seconds: float
    entries: tuple[Entry, ...]


def compare_methods(robot: Robot, scenario: Scenario, seed: int, progress: Progress) -> Comparison:
    """Search with every method. Raises what `design_trajectories` raises."""
    settings = scenario.excitation
    count = max(settings.candidates, FEWEST_MEMBERS)
    with progress.stage("compile the robot", 2) as advance:
        _ = robot.functions
        advance()
        prepare(robot)
        advance()
    began = time.perf_counter()
    scenario = scenario.with_overrides({"excitation.method": "gradient", "excitation.candidates": count})
    check = motion_check(robot, scenario)
    with progress.stage("random candidates", 1) as advance:
        drawn = child(seed, EXCITATION)
        candidates = admissible_trajectories(robot, settings, settings.duration_s, count, drawn, check)
        search = prepare_search(robot, scenario, candidates)
        index = log_observability(robot, search.problem.unknowns, settings.duration_s, search.candidates[0])
        advance()
    known, prepared = knowledge(robot, scenario), time.perf_counter() - began
    times = sample_times(settings.fundamental_hz, settings.harmonics, COMPARISON_REFINEMENT)
    entries = []
    for method in METHODS:
        began = time.perf_counter()
        found = search.run(method, child(seed, SEARCH), progress)
        seconds, trajectory = time.perf_counter() - began, found.trajectory(search.problem)
        try:
            information = float(np.exp(log_information(robot, scenario, known, trajectory)))
        except TrajectoryError:
            information = None
        entries.append(
            Entry(
                method,
                trajectory,
                float(np.exp(found.log_value)),
                observability_index(index, found.z),
                information,
                seconds,
                found.evaluations,
                found.gradients,
                found.iterations,
                found.reason,
                tuple(search.problem.constraints.worst(trajectory, times)),
            )
        )
    return Comparison(settings.criterion, seed, count, prepared, tuple(entries))
