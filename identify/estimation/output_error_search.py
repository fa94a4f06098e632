"""Searches for the optimum of the output error, one after the other.

The linear warm start comes first. The command-driven output error, which has few local minima, is
minimised next. The closed-loop output error is minimised last, because stick-slip gives it narrow
local minima. Both searches end by the criteria of eq. 35. If poses have errors in common, a search
that ignores them precedes the others, because far from the optimum these errors would explain the
relevant residuals. It is left out if the motion is far from linear in the errors. If the model is
unstable with both the warm start and the initial guess, multiple shooting finds a stable model.
"""

from dataclasses import dataclass, replace

import numpy as np

from dynamics import DynamicsError
from identify.arrays import Array
from identify.errors import EstimationError
from identify.estimation.bounded_least_squares import Solution
from identify.estimation.common_error_estimates import errors_in_models
from identify.estimation.growing_window import over_growing_window
from identify.estimation.multiple_shooting import MultipleShooting, measured_states, segments
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.estimation.search_in_coordinates import minimise_in_coordinates
from identify.estimation.simultaneous_search import with_likely_errors
from identify.estimation.warm_start import linear_warm_start
from identify.model.loop_model import LoopModel
from identify.progress import Advance, Progress
from identify.record.stored_common_errors import FRICTION, kind_of

LINEARISATIONS = 6  # largest number of linearisations in the common errors
# Number of linearisations after which steps of the common errors are halved to end alternation.
FULL_STEPS = 2
# Change of the most likely common errors, in standard deviations, up to which they have converged.
SETTLED = 0.02
MISSED = 1.2  # mean squared residual above which a search may have gone wrong

# The same as SETTLED for records that begin in motion, whose common errors have wide priors. The
# standard deviations are those of `LoopModel.in_deciding_stds`, for known parameters. For unknown
# parameters the errors are far less certain, so that this change is small.
NEAR = 1.0

# Relative change of the cost at which multiple shooting ends. Finer searches follow it.
CLOSE_ENOUGH = 1e-2


@dataclass(frozen=True)
class Search:
    """Problem, and the solution of the search for its optimum.

    The models of the problem contain the common errors that are most likely at the optimum.
    """

    problem: OutputErrorProblem
    solution: Solution

    @property
    def missed(self) -> bool:
        """True if the cost is so far above that of noise that the search may have gone wrong."""
        frames = sum(int(run.ok.sum()) for run in self.problem.runs)
        return self.solution.costs[-1] > MISSED * 6 * frames

    def linearised(self) -> OutputErrorProblem:
        """Return the problem with the modes of the common errors at the optimum.

        Raises LoopFailure if the model is unstable there.
        """
        return self.problem.with_common_errors(self.solution.parameters)


def output_error_searches(
    problem: OutputErrorProblem, warm: Array, closed_loop: bool, progress: Progress
) -> dict[str, Search]:
    """Search from the warm start (p,), and return the searches by name.

    The names are multiple_shooting, noise_alone, command_driven and closed_loop, in this order.
    Searches that are not needed are left out. closed_loop: True if the final search uses the closed
    loop, False if it uses the logged commands. If the command-driven result misses the record, its
    search can be repeated from the closed-loop result. Raises EstimationError if no stable model is
    found.
    """
    found = {}
    driven = problem.driven_by_commands()
    start = runnable_start(driven, warm)
    if start is None:
        found["multiple_shooting"] = Search(driven, shoot(driven, warm, progress))
        start = found["multiple_shooting"].solution.parameters
    has_common = any(run.common.all_names for run in problem.runs)
    allowed = (1 + closed_loop + has_common) * problem.stop.max_iterations
    with progress.stage("identify", allowed) as advance:
        starts = [start, problem.guess.values] if has_common else [start]
        if has_common and not any(_bends_far(run) for run in driven.runs):
            found["noise_alone"] = Search(driven, search(driven, start, advance))
            starts = [found["noise_alone"].solution.parameters, start, problem.guess.values]
        found["command_driven"] = searched = search_with_common_errors(driven, starts, advance)
        if closed_loop:
            # The closed-loop search begins with the common errors of the command-driven search.
            problem = problem.having(
                errors_in_models(searched.problem, searched.solution.parameters)
            )
            start = _closed_loop_start(problem, searched.solution.parameters)
            found["closed_loop"] = final = search_with_common_errors(problem, [start], advance)
            ended = final.solution.parameters
            cost = searched.solution.costs[-1]
            if searched.missed and any(_bends_far(run) for run in driven.runs):
                driven = driven.having(errors_in_models(final.problem, ended))
                if np.isfinite(driven.cost(ended)):
                    found["command_driven"] = search_with_common_errors(driven, [ended], advance)
            elif searched.missed and searched.problem.cost(ended) < cost:
                found["command_driven"] = search_with_common_errors(driven, [ended], advance)
    return found


def search_with_common_errors(
    problem: OutputErrorProblem, starts: list[Array], advance: Advance
) -> Search:
    """Minimise a problem with its common errors, from the best of several starts (p,).

    The model is linearised in the common errors about their most likely values. The search is
    repeated until these values converge, at most LINEARISATIONS times.
    """
    first, begin = problem, start = _with_common_errors(problem, starts)
    in_motion = any(run.begins_in_motion for run in problem.runs)
    bent = any(_bends_far(run) for run in problem.runs)
    if bent:
        problem, start = with_likely_errors(problem, start)
    solution = search(problem, start, advance)
    if bent and Search(problem, solution).missed:
        # Far from the right errors, the parameters can have gone to a wrong minimum.
        try:
            other, start = over_growing_window(first, begin) if in_motion else _warm_again(problem)
            again = search(other, start, lambda n=1: None)
        except DynamicsError:
            other, again = problem, solution  # no stable model there, so the first result stays
        if again.costs[-1] < solution.costs[-1]:
            problem = other
            solution = again
    settled = NEAR if in_motion else SETTLED
    for turn in range(LINEARISATIONS if problem.bends else 0):
        errors = errors_in_models(problem, solution.parameters)
        if problem.has(errors, settled):
            break
        if turn >= FULL_STEPS:
            before = [run.errors_had for run in problem.runs]
            errors = [(one + other) / 2.0 for one, other in zip(errors, before, strict=True)]
        moved = problem.having(errors).with_common_errors(solution.parameters)
        # The progress bar expects only one search.
        again = search(moved, solution.parameters, lambda n=1: None)
        if Search(moved, again).missed and not Search(problem, solution).missed:
            break  # the linear estimate of errors that the record hardly shows went too far
        problem = moved
        counted = solution.evaluations + again.evaluations
        solution = replace(again, costs=solution.costs + again.costs[1:], evaluations=counted)
    return Search(problem, solution)


def _warm_again(problem: OutputErrorProblem) -> tuple[OutputErrorProblem, Array]:
    """Return the problem with its most likely common errors, from a new linear warm start."""
    return with_likely_errors(problem, problem.bounds.nearest(linear_warm_start(problem)))


def _bends_far(run: LoopModel) -> bool:
    """Return whether a run has common errors in which its motion is far from linear.

    These are errors of a start in motion and, under the logged commands, of constants of friction.
    With wrong values of these errors, a search would find parameters far from the optimum.
    """
    rubs = any(kind_of(name) == FRICTION for name in run.common.loop_std)
    return run.begins_in_motion or (run.driven and rubs)


def search(
    problem: OutputErrorProblem,
    start: Array,
    advance: Advance,
    shooting: MultipleShooting | None = None,
) -> Solution:
    """Minimise one output-error problem from parameters (p,), within its bounds.

    shooting: multiple-shooting form of the problem, which is minimised instead if it is given. At
    the end, `advance` has been called for all iterations that the problem allows.
    """
    bounds = problem.bounds
    coordinates = bounds.coordinates(start)
    found = minimise_in_coordinates(
        shooting or problem,
        bounds,
        coordinates,
        bounds.spread(coordinates, problem.guess.std),
        problem.stop,
        lambda i, cost: advance(),
        ahead=shooting is None,  # the states of shooting must follow only accepted steps
    )
    advance(problem.stop.max_iterations - found.iterations)
    return replace(found, parameters=bounds.parameters(found.parameters))


def shoot(problem: OutputErrorProblem, warm: Array, progress: Progress) -> Solution:
    """Find parameters for a stable command-driven model by multiple shooting.

    The search starts from the warm start or the initial guess. Raises EstimationError if the
    segments cannot be simulated, or if the resulting model is unstable over the whole records.
    """
    loose = replace(problem, stop=replace(problem.stop, cost_tolerance=CLOSE_ENOUGH))
    chains = [segments(run.on_grid()) for run in problem.runs]
    for start in _candidates(problem, warm):
        states = [measured_states(chain, start, problem.low_pass) for chain in chains]
        shooting = MultipleShooting(problem, chains, states)
        if not np.isfinite(shooting.cost(start)):
            continue
        with progress.stage("multiple shooting", loose.stop.max_iterations) as advance:
            solution = search(loose, start, advance, shooting)
        if np.isfinite(problem.cost(solution.parameters)):
            return solution
    raise EstimationError(
        "the model is unstable with the warm start and with the initial guess, and multiple "
        f"shooting from them finds no stable model: {_why(problem, warm)}"
    )


def runnable_start(problem: OutputErrorProblem, warm: Array) -> Array | None:
    """Return the better of warm start and initial guess (p,), within the bounds.

    None is returned if the model is unstable with both.
    """
    first, second = _candidates(problem, warm)
    ahead = _reuses_sensitivities(problem)
    costs = [(problem.cost(first, ahead=ahead), first), (problem.cost(second), second)]
    cost, start = min(costs, key=lambda entry: entry[0])
    return start if np.isfinite(cost) else None


def _reuses_sensitivities(problem: OutputErrorProblem) -> bool:
    """Return whether a search can reuse the sensitivities of a run at the start of the search.

    This is impossible if `physical` changes the coordinates, or if errors of bodies change the run.
    """
    return not problem.physical and not any(run.common.body_std for run in problem.runs)


def _closed_loop_start(problem: OutputErrorProblem, driven: Array) -> Array:
    """Return the better of the command-driven solution (p,) and the guess, in the closed loop."""
    start = runnable_start(problem, driven)
    if start is None:
        raise EstimationError(
            "the closed loop is unstable with the result of the command-driven search and with "
            f"the initial guess: {_why(problem, driven)}"
        )
    return start


def _with_common_errors(
    problem: OutputErrorProblem, starts: list[Array]
) -> tuple[OutputErrorProblem, Array]:
    """Return the problem with its common errors, and the best of several starts (p,).

    The modes of the errors are evaluated at the best start. Raises EstimationError if the model is
    unstable with all starts.
    """
    if len(starts) == 1 and not any(run.common.all_names for run in problem.runs):
        return problem, problem.bounds.nearest(starts[0])
    first, *others = map(problem.bounds.nearest, starts)
    # The search most likely begins at the first start, so sensitivities are computed there.
    cost = problem.cost(first, ahead=_reuses_sensitivities(problem))
    stable = [first] if np.isfinite(cost) else []
    stable += [start for start in others if np.isfinite(problem.cost(start))]
    if not stable:
        raise EstimationError(
            f"the model is unstable with every start of the search: {_why(problem, first)}"
        )
    whitened = problem.with_common_errors(stable[0])
    best = min(stable, key=whitened.cost)
    return (whitened if best is stable[0] else problem.with_common_errors(best)), best


def _candidates(problem: OutputErrorProblem, warm: Array) -> list[Array]:
    return [problem.bounds.nearest(start) for start in (warm, problem.guess.values)]


def _why(problem: OutputErrorProblem, parameters: Array) -> str:
    try:
        for run in problem.runs:
            run.simulate(parameters)
    except DynamicsError as error:
        return str(error)
    return "the cost is not finite"
