"""Searches for the most exciting trajectory: random candidates, differential evolution, and IPOPT.

All searches maximise a criterion within the constraints of the motion, and begin with the same
random candidates. To add a search, write a function of type `Search` and add it to `SEARCHES`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from scipy.optimize import differential_evolution

from identify.arrays import Array, agreed
from identify.errors import TrajectoryError
from identify.excitation.constraints import MotionConstraints, WorstCase
from identify.excitation.criteria import Criterion
from identify.excitation.trajectory_unknowns import (
    SAMPLES_PER_HARMONIC,
    Unknowns,
    motion,
    sample_times,
)
from identify.progress import Progress
from identify.runtime import interruptible, one_thread, raise_interrupt
from identify.scenario import Excitation
from identify.trajectory import FourierTrajectory

# Factor by which constraints are sampled more finely in the final check than during a search.
CHECK_REFINEMENT = 8
# Fraction of every limit that remains unused. The highest harmonic can rise by this fraction
# between the instants of the check.
CLEARANCE = (np.pi / (SAMPLES_PER_HARMONIC * CHECK_REFINEMENT)) ** 2 / 2


@dataclass(frozen=True)
class SearchProblem:
    """Maximisation of a criterion of the unknowns z under constraints.

    ``candidates`` are the z of random trajectories, best first.
    """

    settings: Excitation
    unknowns: Unknowns
    constraints: MotionConstraints
    criterion: Criterion
    candidates: list[Array]

    def value(self, z: Array) -> float:
        """Return the logarithm of the criterion."""
        return float(self.criterion.value(z))

    @property
    def times(self) -> Array:
        """Instants (N,) [s] at which a search evaluates the constraints."""
        return sample_times(self.unknowns.fundamental_hz, self.unknowns.harmonics)

    @property
    def check_times(self) -> Array:
        """Instants (N,) [s] at which the result of a search is checked."""
        return sample_times(self.unknowns.fundamental_hz, self.unknowns.harmonics, CHECK_REFINEMENT)

    def worst(self, z: Array) -> list[WorstCase]:
        """Return, for each limit, the instant of the check at which z comes nearest to it."""
        return self.constraints.worst(self.unknowns.trajectory(z), self.check_times)

    def is_admissible(self, z: Array) -> bool:
        """Return whether z is within all limits, with the clearance."""
        return all(w.share <= 1 - CLEARANCE for w in self.worst(z))

    def shrunk_inside(self, z: Array) -> Array:
        """Return the largest admissible multiple of z with a factor of at most one.

        A smaller factor shrinks the motion towards the home pose, which is admissible. The factor
        is found by bisection to 1e-6. Raises TrajectoryError if a thousandth of z is not
        admissible. The message names the constraint.
        """
        if self.is_admissible(z):
            return z
        inside = 0.0
        outside = 1.0
        while outside - inside > 1e-6:
            middle = (inside + outside) / 2
            if self.is_admissible(middle * z):
                inside = middle
            else:
                outside = middle
            if outside < 1e-3:
                worst = max(self.worst(middle * z), key=WorstCase.excess)
                raise TrajectoryError(f"the start is not admissible, even close to home: {worst}")
        return inside * z


@dataclass(frozen=True)
class SearchResult:
    """Result of a search.

    z                       Unknowns of the trajectory.
    log_value               Logarithm of the criterion.
    evaluations, gradients  Number of evaluations of the criterion and of its gradient.
    iterations              Number of iterations or generations.
    reason                  Reason why the search stopped.
    """

    z: Array
    log_value: float
    evaluations: int
    gradients: int
    iterations: int
    reason: str

    def trajectory(self, problem: SearchProblem) -> FourierTrajectory:
        """Return the trajectory that was found."""
        return problem.unknowns.trajectory(self.z)


Search = Callable[[SearchProblem, np.random.SeedSequence, Progress], SearchResult]


def best_of(
    problem: SearchProblem, seed: np.random.SeedSequence, progress: Progress
) -> SearchResult:
    """Return the best random trajectory."""
    best = problem.candidates[0]
    count = len(problem.candidates)
    return SearchResult(best, problem.value(best), count, 0, 0, f"best of {count}")


# Relative spread of the population's values at which evolution stops, as in the paper.
STALLED = 1e-10
# Smallest size of the population, because differential evolution combines several members.
FEWEST_MEMBERS = 5
MOST_MEMBERS = 32  # largest size of the population. Larger populations converge too slowly.
# Fraction of the unknowns that a trial takes from its mutant. It is the best of several values that
# were tried with MOST_MEMBERS.
RECOMBINATION = 0.9
# Least cost of a member that violates a limit. It is larger than any value of a criterion.
NOT_ADMISSIBLE = 1e6


def evolve(
    problem: SearchProblem, seed: np.random.SeedSequence, progress: Progress
) -> SearchResult:
    """Search by differential evolution from the best candidates.

    Each coordinate of a member is scaled so that it fills the box, as in a random trajectory. The
    amplitude is thus not an unknown. An admissible member is always better than a member that is
    not admissible. Of two members that are not admissible, the member with the smaller violation
    is better.

    Raises TrajectoryError if there are too few candidates.
    """
    generations = problem.settings.generations
    candidates = problem.candidates
    if len(candidates) < FEWEST_MEMBERS:
        raise TrajectoryError(
            f"excitation.candidates = {len(candidates)}: the evolutionary method needs at least "
            f"{FEWEST_MEMBERS}"
        )
    population = _ScaledPopulation(problem)
    with progress.stage("evolutionary search", generations) as advance:
        found = differential_evolution(
            population.cost,
            bounds=[(-1.0, 1.0)] * problem.unknowns.size,
            init=np.array([population.member(z) for z in candidates[:MOST_MEMBERS]]),
            maxiter=generations,
            tol=STALLED,
            # SciPy's polish needs gradients, but this cost has a jump at every limit.
            polish=False,
            recombination=RECOMBINATION,
            rng=np.random.default_rng(seed),
            callback=lambda intermediate_result: advance(),
        )
    z = problem.shrunk_inside(population.fill(found.x))
    reason = "population converged" if found.success else f"{found.nit} generations"
    return SearchResult(z, problem.value(z), found.nfev, 0, found.nit, reason)


class _ScaledPopulation:
    """Cost of the members of a population, each scaled to fill the box."""

    def __init__(self, problem: SearchProblem) -> None:
        self._problem = problem
        self._offset, self._rate, _ = problem.unknowns.basis(problem.times)
        self._shares = problem.constraints.shares.map(len(problem.times))

    def member(self, z: Array) -> Array:
        """Return the member for a z, with entries between -1 and 1."""
        matrix = z.reshape(self._problem.unknowns.coordinates, -1)
        return np.asarray((matrix / np.abs(matrix).max(axis=1, keepdims=True)).ravel())

    def fill(self, member: Array) -> Array:
        """Return the z of a member. Each coordinate is scaled to fill the box."""
        matrix = member.reshape(self._problem.unknowns.coordinates, -1)
        largest = np.abs(matrix @ self._offset.T).max(axis=1)
        return np.asarray((matrix / np.where(largest > 0, largest, 1.0)[:, None]).ravel())

    def cost(self, member: Array) -> float:
        """Return minus the logarithm of the criterion, or a large cost if a limit is violated."""
        z = self.fill(member)
        unknowns = self._problem.unknowns
        matrix = z.reshape(unknowns.coordinates, -1)
        lifted = unknowns.chart.lifted
        poses = unknowns.home[:, None] + lifted(
            unknowns.box[:, None] * (matrix @ self._offset.T), axis=0
        )
        rates = lifted(unknowns.box[:, None] * (matrix @ self._rate.T), axis=0)
        # The first rows are the box. All members fill it exactly.
        shares = np.array(self._shares(poses, rates))[unknowns.coordinates :]
        worst = float(np.abs(shares).max())
        # The cost grows with the violation, and is largest out of reach (NaN).
        if not worst <= 1:
            return NOT_ADMISSIBLE * (2 if np.isnan(worst) else 2 - 1 / worst)
        value = self._problem.value(z)
        return -value if np.isfinite(value) else NOT_ADMISSIBLE


MOST_ITERATIONS = 150  # largest number of iterations of IPOPT

# Relative tolerance of IPOPT. A more accurate optimum does not excite noticeably more.
TOLERANCE = 1e-4
INTERIOR = 0.98  # factor that moves a start inside the limits, which an interior-point method needs
FAR = 0.5  # used share of a limit up to which the limit is ignored at first
ALWAYS = "box"  # limit that is always included, because a criterion is unbounded without it
STARTS = 3  # number of candidates from which IPOPT starts


@interruptible()
def climb(problem: SearchProblem, seed: np.random.SeedSequence, progress: Progress) -> SearchResult:
    """Return the best result of IPOPT from the best candidates.

    Criterion and constraints have exact derivatives. The Hessian is approximated from gradients
    (limited memory). A criterion with 48 unknowns then converges in a few tens of iterations, while
    an exact Hessian of a regressor would take longer. There are several starts because the
    criterion has many local optima.

    Limits far from a start are ignored at first. If the result violates such limits, they are
    added, and IPOPT continues. If a trajectory exceeds a limit between the instants of the
    constraints, it is shrunk towards home until it is admissible at the finer instants of the
    check.

    Starts and problem are rounded to numbers on which all processors agree, and IPOPT's linear
    algebra is the same on all processors. The result is therefore the same, too.

    Raises TrajectoryError if a start is not admissible even close to home, or, with IPOPT's
    reasons, if IPOPT finds nothing from any start.
    """
    starts = problem.candidates[:STARTS]
    found = []
    reasons = []
    with progress.stage("gradient search", len(starts)) as advance:
        for start in starts:
            result = _climb_from(problem, INTERIOR * problem.shrunk_inside(agreed(start)))
            reasons.append(result.reason)
            if np.isfinite(result.log_value):
                found.append(result)
            advance()
    if not found:
        raise TrajectoryError(
            f"IPOPT found no trajectory from any of {len(starts)} starts: {', '.join(reasons)}"
        )
    # IPOPT maximises an approximation of some criteria, so the judge ranks the results.
    judge = problem.criterion.judge
    return max(found, key=lambda one: judge(one.trajectory(problem)) if judge else one.log_value)


def _climb_from(problem: SearchProblem, z: Array) -> SearchResult:
    """Return the result of IPOPT from one start. Its value is -inf if IPOPT failed."""
    included = {ALWAYS} | _used(problem, z, FAR)
    values = gradients = iterations = 0
    while True:
        solver = _solver(problem, included)
        answer, stats = _solve(solver, z)
        values += int(stats["n_call_nlp_f"])
        gradients += int(stats["n_call_nlp_grad_f"])
        iterations += int(stats["iter_count"])
        reason = str(stats["return_status"])
        found = np.array(answer["x"]).ravel()
        if not np.isfinite(found).all() or not np.isfinite(float(answer["f"])):
            return SearchResult(z, -np.inf, values, gradients, iterations, reason)
        broken = _used(problem, found, 1.0) - included
        admissible = problem.shrunk_inside(found)
        if not broken:
            return SearchResult(
                admissible, problem.value(admissible), values, gradients, iterations, reason
            )
        # Continue from a point inside all limits, and include the violated limits.
        included = included | broken
        z = INTERIOR * admissible


@one_thread
def _solve(solver: ca.Function, z: Array) -> tuple[dict[str, ca.DM], dict[str, Any]]:
    """Return the solution of IPOPT from z, and its statistics."""
    done = solver(x0=z, lbg=-1.0, ubg=1.0)
    raise_interrupt()  # IPOPT treats Ctrl-C as a failed evaluation
    return done, solver.stats()


def _used(problem: SearchProblem, z: Array, share: float) -> set[str]:
    """Return the names of limits whose used share is larger than `share`, or is NaN."""
    return {worst.name for worst in problem.worst(z) if not worst.share <= share}


def _solver(problem: SearchProblem, included: set[str]) -> ca.Function:
    """Return an IPOPT solver with the used shares of the limits `included` between -1 and 1."""
    z = ca.MX.sym("z", problem.unknowns.size)
    poses, rates, _ = motion(problem.unknowns, z, problem.times)
    shares = problem.constraints.shares_of(included).map(len(problem.times))(poses, rates)
    options: dict[str, Any] = {
        "print_time": False,
        "ipopt": {
            "print_level": 0,
            # "sb" suppresses the banner.
            "sb": "yes",
            "hessian_approximation": "limited-memory",
            "max_iter": MOST_ITERATIONS,
            "tol": TOLERANCE,
            "acceptable_tol": 10 * TOLERANCE,
            "acceptable_iter": 5,
        },
    }
    nlp: dict[str, Any] = {"x": z, "f": -problem.criterion.smooth(z), "g": ca.vec(shares)}
    return ca.nlpsol("excitation", "ipopt", nlp, options)


# Methods of a scenario, see `excitation.method`.
SEARCHES: dict[str, Search] = {"random": best_of, "evolutionary": evolve, "gradient": climb}
