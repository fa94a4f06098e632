"""Choice of the law of the drives, by the evidence of a record for each law that is considered.

Each law is a separate model. The optimum of its output error is searched from a warm start, with
the logged commands as input, so that the residuals are white. The evidence is the probability of
the record, integrated over all parameters with their prior. Near the optimum the cost is
quadratic. By Laplace's method

    ln p(record | law) = -(cost + ln det W - ln det P) / 2 + constant,

with W the information of poses and prior at the optimum, and P the information of the prior. The
constant is the same for all laws. A law has less evidence if the record excludes most of the prior
range of its gains. All laws have the same prior probability. If even the best law misses the record
by more than noise explains, all costs are divided by its misfit, so that a record that no law
explains does not rule out any law.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dynamics import DynamicsError
from dynamics.closed_loop.drives import DriveName
from identify.arrays import Array
from identify.errors import EstimationError
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.estimation.output_error_search import Search, output_error_searches
from identify.estimation.warm_start import linear_warm_start
from identify.progress import Progress, SilentProgress
from identify.scenario import Model
from identify.scenario.plant_sections import AUTO

SURE = 0.95  # smallest probability with which a law counts as certain
# Number of iterations of the first search for every law. After these, laws that fit the record are
# near their optimum. Other laws could need many more.
FIRST = 4
# Ratio to the lowest cost above which a law gets no further search, and the probability zero.
HOPELESS = 10.0


@dataclass(frozen=True)
class DriveChoice:
    """Law of the drives, and the probability of each law.

    A law that the scenario names has the probability 1. in_loop: False for torque commands, under
    which the law of the drives did not act.
    """

    law: DriveName
    probabilities: Mapping[str, float]
    in_loop: bool = True

    @property
    def asked(self) -> bool:
        """True if the law was chosen from the record."""
        return len(self.probabilities) > 1

    @property
    def sure(self) -> bool:
        """True if the law is certain."""
        return self.probabilities[self.law] >= SURE

    def warnings(self) -> tuple[str, ...]:
        """Return a warning if the record does not determine the law."""
        if not self.in_loop:
            return (
                "the commands are torques: the law by which the drives follow joint commands did "
                "not act in this record, and its gains are those of the initial guess",
            )
        if self.sure:
            return ()
        said = ", ".join(
            f"{name} {value:.0%}" for name, value in self.probabilities.items() if value >= 0.01
        )
        return (
            f"the record does not determine the law of the drives ({said}): the gains are for the "
            f"law {self.law}; move the robot faster or longer, or state the law in model.drive",
        )


def choose_drive(
    problem_of: Callable[[DriveName], OutputErrorProblem],
    model: Model,
    progress: Progress,
    in_loop: bool = True,
) -> DriveChoice:
    """Return the law that a model names or, if it leaves the law open, the most probable law.

    problem_of: function that returns the output-error problem under a law. in_loop: False if no law
    acted in the record. The law is then the one that the model names, or else the paper's. Raises
    EstimationError if the model is unstable under all laws.
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
            # A law with an unstable model is excluded.
            except (EstimationError, DynamicsError) as error:
                failed.append(f"{law}: {error}")
            advance()
        limit = HOPELESS * min((one.solution.costs[-1] for one in first.values()), default=0.0)
        evidences = {}
        for law, one in first.items():
            if one.solution.costs[-1] > limit:
                continue
            try:
                evidences[law] = evidence(_searched(problem_of(law), one.solution.parameters))
            except (EstimationError, DynamicsError) as error:
                failed.append(f"{law}: {error}")
        if not evidences:
            raise EstimationError(
                f"the model is unstable under every law of the drives: {'; '.join(failed)}"
            )
        # Laws that were left out count as finished.
        advance(len(laws))
    return DriveChoice(*_weighed(evidences, laws))


def _searched(problem: OutputErrorProblem, start: Array) -> Search:
    """Search for the optimum under the logged commands.

    Raises EstimationError if no stable model is found.
    """
    found = output_error_searches(problem, start, closed_loop=False, progress=SilentProgress())
    return found["command_driven"]


@dataclass(frozen=True)
class Evidence:
    """Evidence of a record for a law.

    cost: cost at the optimum. misfit: cost of the poses alone, divided by the number of their
    components. narrowed: ln det W - ln det P.
    """

    cost: float
    misfit: float
    narrowed: float


def evidence(found: Search) -> Evidence:
    """Return the evidence of a finished search. Raises LoopFailure for an unstable model."""
    parameters = found.solution.parameters
    judged = found.linearised()
    cost, factor, _ = judged.linearise(parameters)
    known, _ = judged.known(parameters)
    poses = 6 * sum(int(np.count_nonzero(run.ok)) for run in judged.runs)
    of_prior = np.linalg.slogdet(judged.known_information())[1]  # ln det P
    narrowed = 2 * np.log(np.abs(np.diag(factor))).sum() - of_prior
    return Evidence(cost, (cost - float(known @ known)) / poses, float(narrowed))


def _weighed(
    found: Mapping[DriveName, Evidence], laws: Sequence[DriveName]
) -> tuple[DriveName, dict[str, float]]:
    """Return the most probable law, and the probability of each.

    A law that is not in `found`, because its model is unstable or its cost is high, gets zero.
    """
    misfit = max(1.0, min(one.misfit for one in found.values()))
    logarithms = {law: -(one.cost / misfit + one.narrowed) / 2 for law, one in found.items()}
    best = max(logarithms, key=lambda law: logarithms[law])
    # The evidence is too small for a floating-point number, so only ratios are computed.
    weights = {
        law: float(np.exp(logarithms[law] - logarithms[best])) if law in found else 0.0
        for law in laws
    }
    return best, {law: weight / sum(weights.values()) for law, weight in weights.items()}
