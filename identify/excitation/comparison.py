"""Comparison of the excitation methods with the same criterion, seed and random candidates."""

import time
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.figure import Figure

from dynamics import Robot
from dynamics.closed_loop import prepare
from identify.errors import TrajectoryError
from identify.excitation.constraints import WorstCase
from identify.excitation.criteria import log_observability, observability_index
from identify.excitation.design import DesignTask
from identify.excitation.information import Knowledge, log_information
from identify.excitation.search import FEWEST_MEMBERS, SEARCHES
from identify.excitation.trajectory_unknowns import sample_times
from identify.loop_parameters import of_actuators
from identify.progress import Progress
from identify.random_streams import SEARCH, child
from identify.scenario import Excitation
from identify.trajectory import FourierTrajectory

# Factor by which limits are sampled more finely here than during a search.
COMPARISON_REFINEMENT = 10


@dataclass(frozen=True)
class Entry:
    """Result of one method.

    method                          Name of the method.
    trajectory                      Trajectory that was found.
    value                           Value of the criterion that the method maximised.
    observability                   Observability index (eq. 39).
    information                     D of the simulated loop, or None if the loop is unstable at the
                                    initial guess.
    seconds                         Duration of the search.
    evaluations, gradients, iterations
                                    Numbers of evaluations of the criterion and of its gradient, and
                                    of iterations.
    reason                          Reason why the search stopped.
    worst                           Instants at which the trajectory comes nearest to each limit.
    """

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
    worst: tuple[WorstCase, ...]


@dataclass(frozen=True)
class Comparison:
    """Results of all methods, and the time that their common candidates took, in s."""

    criterion: str
    seed: int
    candidates: int
    preparation_seconds: float
    entries: tuple[Entry, ...]


def compare_methods(
    design: DesignTask, known: Knowledge, seed: int, progress: Progress
) -> Comparison:
    """Run the search of every method, and compute the information of each result.

    Raises the errors of `design_trajectories`.
    """
    robot = design.robot
    # The evolutionary method needs a population, and the gradient method needs whole periods.
    count = max(design.settings.candidates, FEWEST_MEMBERS)
    settings = design.settings.model_copy(update={"method": "gradient", "candidates": count})
    design = replace(design, settings=settings)
    # Compilation comes first, so that the times of the methods do not contain it.
    with progress.stage("compile the robot", 1) as advance:
        prepare(robot)
        advance()
    began = time.perf_counter()
    with progress.stage("random candidates", 1) as advance:
        candidates = design.candidates(count, seed)
        problem = design.search_problem(candidates)
        index = log_observability(
            robot, problem.unknowns, settings.duration_s, problem.candidates[0]
        )
        advance()
    prepared = time.perf_counter() - began
    times = sample_times(settings.fundamental_hz, settings.harmonics, COMPARISON_REFINEMENT)
    entries = []
    for method, search in SEARCHES.items():
        began = time.perf_counter()
        result = search(problem, child(seed, SEARCH), progress)
        seconds = time.perf_counter() - began
        trajectory = result.trajectory(problem)
        try:
            information = float(np.exp(log_information(robot, known, trajectory)))
        except TrajectoryError:
            information = None
        entry = Entry(
            method=method,
            trajectory=trajectory,
            value=float(np.exp(result.log_value)),
            observability=observability_index(index, result.z),
            information=information,
            seconds=seconds,
            evaluations=result.evaluations,
            gradients=result.gradients,
            iterations=result.iterations,
            reason=result.reason,
            worst=tuple(problem.constraints.worst(trajectory, times)),
        )
        entries.append(entry)
    return Comparison(settings.criterion, seed, count, prepared, tuple(entries))


COMPONENTS = ("x", "y", "z", "α", "β", "γ")
POINTS = 1000  # number of instants that are drawn


def comparison_figure(robot: Robot, settings: Excitation, comparison: Comparison) -> Figure:
    """Draw position, orientation and joints over one period, one column per method.

    Limits are dashed.
    """
    figure = Figure(figsize=(5 * len(comparison.entries), 9), layout="constrained")
    panels = figure.subplots(3, len(comparison.entries), sharex=True, sharey="row", squeeze=False)
    time = np.linspace(0.0, 1.0 / settings.fundamental_hz, POINTS)
    travel = robot.travel_limit - of_actuators(robot, settings, "travel_margin")
    boxes = (1e3 * settings.position_amplitude_m, 1e3 * settings.orientation_amplitude_rad)
    for column, entry in enumerate(comparison.entries):
        poses = entry.trajectory.pose(time)
        offset = 1e3 * (poses - robot.home_pose)
        angles = robot.inverse_kinematics(poses)
        rows = [
            (offset[:, :3], COMPONENTS[:3], boxes[0]),
            (offset[:, 3:], COMPONENTS[3:], boxes[1]),
            (angles, robot.joint_names, travel),
        ]
        for axes, (values, names, limit) in zip(panels[:, column], rows, strict=True):
            for name, line in zip(names, values.T, strict=True):
                axes.plot(time, line, label=name, linewidth=1.0)
            for sign in (-1, 1):
                axes.axhline(sign * limit, color="black", linestyle="--", linewidth=0.8)
            axes.grid(alpha=0.3)
        panels[0, column].set_title(
            f"{entry.method}: index {entry.observability:.3f}, {entry.seconds:.1f} s"
        )
        panels[2, column].set_xlabel("time [s]")
    for axes, label in zip(
        panels[:, 0],
        (
            "position from home [mm]",
            "orientation from home [mrad]",
            f"joint [{robot.layout.joint_unit}]",
        ),
        strict=True,
    ):
        axes.set_ylabel(label)
        axes.legend(loc="upper right", fontsize="small", ncols=2)
    figure.suptitle(
        f"Exciting trajectories, criterion {comparison.criterion}, seed {comparison.seed}; "
        "dashed: limits"
    )
    return figure
