"""Choice of the drives' law, by the evidence of a record for each law that is known.

Each law is a model of its own: a warm start, then the search for the optimum of the output error
under the logged commands, whose residuals are white. The evidence is the probability of the record
with all parameters integrated out, over what was known of them before. About the optimum the cost
is a parabola, so that by Laplace's method

    ln p(record | law) = -(cost + ln det W - ln det P) / 2 + the same for all,

with W the information of poses and prior at the optimum, and P that of the prior. A law has less
evidence if the record excludes much of what its gains could have been. Before the record all laws
are equally probable. Where the best of them misses the record by more than noise explains, all
costs are divided by its misfit, so that a record that no law explains rules none out.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dynamics import DynamicsError
from dynamics.closed_loop.drives import DriveName
from identify.arrays import Array
from identify.errors import EstimationError
from identify.estimation.output_error import OutputErrorProblem
from identify.estimation.output_error_search import Search, output_error_searches
from identify.estimation.warm_start import linear_warm_start
from identify.progress import Progress, SilentProgress
from identify.scenario import Model
from identify.scenario.plant_sections import AUTO

SURE = 0.95
"""Probability from which on a record tells the law."""

FIRST = 4
"""Number of iterations for every law at first.

Laws that fit the record are near their optimum by then, while others may search for long.
"""

HOPELESS = 10.0
"""Factor of the best cost above which a law is not searched any further."""


@dataclass(frozen=True)
class DriveChoice:
    """Law of the drives, and how probable each law is.

    A law that the scenario names has the probability 1. in_loop: False if the drives took torques,
    so that no law acted as the record was made.
    """

    law: DriveName
    probabilities: Mapping[str, float]
    in_loop: bool = True

    @property
    def asked(self) -> bool:
        """True if the record was asked for the law."""
        return len(self.probabilities) > 1

    @property
    def sure(self) -> bool:
        """True if the record tells the law."""
        return self.probabilities[self.law] >= SURE

    def warnings(self) -> tuple[str, ...]:
        """Return a warning if the record cannot tell the law, or says nothing of it."""
        if not self.in_loop:
            return (
                "the drives took torques: the law by which they follow joint commands is not in "
                "this record, and its gains are those of the starting values",
            )
        if self.sure:
            return ()
        said = ", ".join(
            f"{name} {value:.0%}" for name, value in self.probabilities.items() if value >= 0.01
        )
        return (
            f"the record cannot tell the law of the drives ({said}): the gains are those of "
            f"{self.law}; move the robot faster or longer, or state the law in model.drive",
        )


def choose_drive(
    problem_of: Callable[[DriveName], OutputErrorProblem],
    model: Model,
    progress: Progress,
    in_loop: bool = True,
) -> DriveChoice:
    """Return the law that a model names or, if it leaves that open, the most probable one.

    problem_of: function that returns the output-error problem under a law. in_loop: False if no law
    acted in the record. Raises EstimationError if no law gives a model that runs.
    """
    law = model.drive_law
    if not in_loop:
        return DriveChoice(law, {law: 1.0}, in_loop)
    if model.drive != AUTO:
        return DriveChoice(law, {law: 1.0})
    laws = model.drives_considered
    first = {}
    failed = []
    with progress.stage("laws of the drives", 2 * len(laws)) as advance:
        for law in laws:
            try:
                problem = problem_of(law)
                early = replace(problem, stop=replace(problem.stop, max_iterations=FIRST))
                first[law] = _searched(early, linear_warm_start(problem))
            # a law under which no model runs is out, and the others decide
            except (EstimationError, DynamicsError) as error:
                failed.append(f"{law}: {error}")
            advance()
        if not first:
            raise EstimationError(
                f"no law of the drives gives a model that runs: {'; '.join(failed)}"
            )
        limit = HOPELESS * min(one.solution.costs[-1] for one in first.values())
        found = {
            law: evidence(_searched(problem_of(law), one.solution.parameters))
            for law, one in first.items()
            if one.solution.costs[-1] <= limit
        }
        # laws that were left out count as searched
        advance(len(laws))
    return DriveChoice(*_weighed(found, laws))


def _searched(problem: OutputErrorProblem, start: Array) -> Search:
    """Search for the optimum under the logged commands.

    Raises EstimationError if no model runs.
    """
    found = output_error_searches(problem, start, closed_loop=False, progress=SilentProgress())
    return found["command_driven"]


@dataclass(frozen=True)
class Evidence:
    """Evidence of a record for a law.

    cost: at the optimum. misfit: that of the poses alone, over the number of their components.
    narrowed: ln det W - ln det P.
    """

    cost: float
    misfit: float
    narrowed: float


def evidence(found: Search) -> Evidence:
    """Return the evidence for the law of a finished search. Raises LoopFailure."""
    parameters = found.solution.parameters
    judged = found.linearised()
    cost, factor, _ = judged.linearise(parameters)
    known, _ = judged.known(parameters)
    poses = 6 * sum(int(np.count_nonzero(run.ok)) for run in judged.runs)
    of_prior = np.linalg.slogdet(judged.known_information())[1]
    narrowed = 2 * np.log(np.abs(np.diag(factor))).sum() - of_prior
    return Evidence(cost, (cost - float(known @ known)) / poses, float(narrowed))


def _weighed(
    found: Mapping[DriveName, Evidence], laws: Sequence[DriveName]
) -> tuple[DriveName, dict[str, float]]:
    """Return the most probable law, and the probability of each.

    A law that gives no model has the probability zero.
    """
    misfit = max(1.0, min(one.misfit for one in found.values()))
    logarithms = {law: -(one.cost / misfit + one.narrowed) / 2 for law, one in found.items()}
    best = max(logarithms, key=lambda law: logarithms[law])
    # relative to the best one, as the evidence itself is too small for a floating-point number
    weights = {
        law: float(np.exp(logarithms[law] - logarithms[best])) if law in found else 0.0
        for law in laws
    }
    return best, {law: weight / sum(weights.values()) for law, weight in weights.items()}
