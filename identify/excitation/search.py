"""Searches for the trajectory that excites most: the best of random ones, differential evolution,
and IPOPT.

All maximise a criterion within the constraints of the motion, and begin with the same random
candidates. To add one, write a function of the form `Search` and name it in `SEARCHES`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from scipy.optimize import differential_evolution

from identify.arrays import Array, agreed
from identify.errors import TrajectoryError
from identify.excitation.constraints import MotionConstraints, Worst
from identify.excitation.criteria import Criterion
from identify.excitation.motion import SAMPLES_PER_HARMONIC, Unknowns, motion, sample_times
from identify.progress import Progress
from identify.runtime import honoured, one_thread, raise_noted
from identify.scenario import Excitation
from identify.trajectory import FourierTrajectory

CHECK_REFINEMENT = 8
"""How much finer constraints are checked in the end than while a search runs."""

CLEARANCE = (np.pi / (SAMPLES_PER_HARMONIC * CHECK_REFINEMENT)) ** 2 / 2
"""Share of every limit that is kept: by so much the highest harmonic can rise between the instants
of the check.
"""


@dataclass(frozen=True)
class SearchProblem:
    """Maximise a criterion of the unknowns z under constraints; candidates: z of random
    trajectories, best first.
    """

    settings: Excitation
    unknowns: Unknowns
    constraints: MotionConstraints
    criterion: Criterion
    candidates: list[Array]

    def value(self, z: Array) -> float:
        """Logarithm of the criterion."""
        return float(self.criterion.value(z))

    @property
    def times(self) -> Array:
        """Instants (N,) [s] at which a search looks at the constraints."""
        return sample_times(self.unknowns.fundamental_hz, self.unknowns.harmonics)

    @property
    def check_times(self) -> Array:
        """Instants (N,) [s] at which its result is checked."""
        return sample_times(self.unknowns.fundamental_hz, self.unknowns.harmonics, CHECK_REFINEMENT)

    def worst(self, z: Array) -> list[Worst]:
        """Where z comes nearest to each limit, at the instants of the check."""
        return self.constraints.worst(self.unknowns.trajectory(z), self.check_times)

    def is_admissible(self, z: Array) -> bool:
        """Whether z keeps all limits with the clearance."""
        return all(w.share <= 1 - CLEARANCE for w in self.worst(z))

    def drawn_in(self, z: Array) -> Array:
        """The largest share of z that is admissible: the home pose itself is, so shrinking the
        motion leads there.

        Raises TrajectoryError, naming the constraint, where not even a thousandth of it is.
        """
        if self.is_admissible(z):
            return z
        inside = 0.0
        outside = 1.0
        while outside - inside > 1e-6:
            middle = (inside + outside) / 2
            inside, outside = (
                (middle, outside) if self.is_admissible(middle * z) else (inside, middle)
            )
            if outside < 1e-3:
                worst = max(self.worst(middle * z), key=Worst.excess)
                raise TrajectoryError(f"no start is admissible, not even close to home: {worst}")
        return inside * z


@dataclass(frozen=True)
class SearchResult:
    """The z that a search found, logarithm of its criterion, evaluations of the criterion (and of
    its gradient), iterations or generations, and why the search stopped."""

    z: Array
    log_value: float
    evaluations: int
    gradients: int
    iterations: int
    reason: str

    def trajectory(self, problem: SearchProblem) -> FourierTrajectory:
        """The trajectory that was found."""
        return problem.unknowns.trajectory(self.z)


Search = Callable[[SearchProblem, np.random.SeedSequence, Progress], SearchResult]


def best_of(
    problem: SearchProblem, seed: np.random.SeedSequence, progress: Progress
) -> SearchResult:
    """The best random trajectory."""
    best = problem.candidates[0]
    count = len(problem.candidates)
    return SearchResult(best, problem.value(best), count, 0, 0, f"best of {count}")


STALLED = 1e-10
"""The paper's stop criterion: spread of the population's values, relative."""

FEWEST_MEMBERS, MOST_MEMBERS = 5, 32
"""Differential evolution combines members with others; more of them converge more slowly than they
find better.
"""

RECOMBINATION = 0.9
"""Share of the unknowns that a trial takes from its mutant; the best of what was tried, with
MOST_MEMBERS.
"""

NOT_ADMISSIBLE = 1e6
"""Added to the cost of a member that breaks a limit, beyond any value of a criterion."""


def evolve(
    problem: SearchProblem, seed: np.random.SeedSequence, progress: Progress
) -> SearchResult:
    """What the generations of differential evolution find that begin with the best of the
    candidates.

    A member of the population is scaled, a coordinate at a time, until it fills the box, as a
    random trajectory is: its size is then no unknown any more, and no limit on the amplitude has to
    be found by chance. Among two members the admissible one wins, among two that are not the one
    that breaks its limits less.

    Raises TrajectoryError where the candidates are too few.
    """
    generations = problem.settings.generations
    candidates = problem.candidates
    if len(candidates) < FEWEST_MEMBERS:
        raise TrajectoryError(
            f"excitation.candidates = {len(candidates)}: the evolutionary method needs at least "
            f"{FEWEST_MEMBERS}"
        )
    filling = _Filling(problem)
    with progress.stage("evolutionary search", generations) as advance:
        found = differential_evolution(
            filling.cost,
            bounds=[(-1.0, 1.0)] * problem.unknowns.size,
            init=np.array([filling.member(z) for z in candidates[:MOST_MEMBERS]]),
            maxiter=generations,
            tol=STALLED,
            polish=False,
            recombination=RECOMBINATION,
            rng=np.random.default_rng(seed),
            callback=lambda intermediate_result: advance(),
        )
    z = problem.drawn_in(filling.fill(found.x))
    reason = "values no longer spread" if found.success else f"{found.nit} generations"
    return SearchResult(z, problem.value(z), found.nfev, 0, found.nit, reason)


class _Filling:
    """The cost of members of the population."""

    def __init__(self, problem: SearchProblem) -> None:
        self._problem = problem
        self._offset, self._rate, _ = problem.unknowns.basis(problem.times)
        self._shares = problem.constraints.shares.map(len(problem.times))

    def member(self, z: Array) -> Array:
        """The member that z is, within -1 and 1."""
        matrix = z.reshape(self._problem.unknowns.coordinates, -1)
        return np.asarray((matrix / np.abs(matrix).max(axis=1, keepdims=True)).ravel())

    def fill(self, member: Array) -> Array:
        """z of a member: each coordinate scaled to fill the box."""
        matrix = member.reshape(self._problem.unknowns.coordinates, -1)
        largest = np.abs(matrix @ self._offset.T).max(axis=1)
        return np.asarray((matrix / np.where(largest > 0, largest, 1.0)[:, None]).ravel())

    def cost(self, member: Array) -> float:
        """Minus the logarithm of the criterion, or what is broken."""
        z = self.fill(member)
        unknowns = self._problem.unknowns
        matrix = z.reshape(unknowns.coordinates, -1)
        lifted = unknowns.chart.lifted
        poses = unknowns.home[:, None] + lifted(
            unknowns.box[:, None] * (matrix @ self._offset.T), axis=0
        )
        rates = lifted(unknowns.box[:, None] * (matrix @ self._rate.T), axis=0)
        shares = np.array(self._shares(poses, rates))[unknowns.coordinates :]
        worst = float(np.abs(shares).max())
        if not worst <= 1:
            return NOT_ADMISSIBLE * (2 if np.isnan(worst) else 2 - 1 / worst)
        value = self._problem.value(z)
        return -value if np.isfinite(value) else NOT_ADMISSIBLE


MOST_ITERATIONS = 150  # of IPOPT

TOLERANCE = 1e-4
"""IPOPT's, relative: further digits of an optimum do not excite more."""

INTERIOR = 0.98
"""A start is drawn in to this share of the limits, where the interior-point method can move."""

FAR = 0.5
"""A limit of which a start uses less than this share is left out at first."""

ALWAYS = "box"
"""The limit that always counts: without it a criterion grows without end."""


STARTS = 3
"""Candidates from which IPOPT climbs."""


@honoured()
def climb(problem: SearchProblem, seed: np.random.SeedSequence, progress: Progress) -> SearchResult:
    """The best of what IPOPT finds from the best candidates, with exact derivatives of criterion
    and constraints.

    The Hessian is approximated from gradients (limited memory): a criterion with 48 unknowns
    converges with it in some tens of iterations, and an exact Hessian of a regressor costs more
    than it saves. Several starts, because the criterion has many local optima. Limits that a start
    is far from are left out at first; those that the result breaks are put in, and IPOPT climbs on.
    What goes over a limit between the instants of the constraints is drawn in towards home until it
    is admissible at the finer instants of the check.

    Starts and problem are rounded to what all processors agree on, and IPOPT's own linear algebra
    is the same on all. So are its steps and the trajectory at which it ends.

    Raises TrajectoryError where no start is admissible, or IPOPT finds nothing from any of them,
    with its reasons.
    """
    starts = problem.candidates[:STARTS]
    found = []
    reasons = []
    with progress.stage("gradient search", len(starts)) as advance:
        for start in starts:
            result = _climb_from(problem, INTERIOR * problem.drawn_in(agreed(start)))
            reasons.append(result.reason)
            if np.isfinite(result.log_value):
                found.append(result)
            advance()
    if not found:
        raise TrajectoryError(
            f"IPOPT found no trajectory from any of {len(starts)} starts: {', '.join(reasons)}"
        )
    judge = problem.criterion.judge
    return max(found, key=lambda one: judge(one.trajectory(problem)) if judge else one.log_value)


def _climb_from(problem: SearchProblem, z: Array) -> SearchResult:
    """One climb; its value is -inf where IPOPT came to nothing."""
    counted = {ALWAYS} | _used(problem, z, FAR)
    values = gradients = iterations = 0
    while True:
        solver = _solver(problem, counted)
        done, stats = _solve(solver, z)
        values = values + int(stats["n_call_nlp_f"])
        gradients = gradients + int(stats["n_call_nlp_grad_f"])
        iterations = iterations + int(stats["iter_count"])
        reason = str(stats["return_status"])
        found = np.array(done["x"]).ravel()
        if not np.isfinite(found).all() or not np.isfinite(float(done["f"])):
            return SearchResult(z, -np.inf, values, gradients, iterations, reason)
        broken = _used(problem, found, 1.0) - counted
        admissible = problem.drawn_in(found)
        if not broken:
            return SearchResult(
                admissible, problem.value(admissible), values, gradients, iterations, reason
            )
        counted = counted | broken
        z = INTERIOR * admissible


@one_thread
def _solve(solver: ca.Function, z: Array) -> tuple[dict[str, ca.DM], dict[str, Any]]:
    """What IPOPT finds from z, and its statistics."""
    done = solver(x0=z, lbg=-1.0, ubg=1.0)
    raise_noted()  # IPOPT takes Ctrl-C for an evaluation that failed
    return done, solver.stats()


def _used(problem: SearchProblem, z: Array, share: float) -> set[str]:
    """Names of the limits of which z uses more than a share."""
    return {worst.name for worst in problem.worst(z) if not worst.share <= share}


def _solver(problem: SearchProblem, counted: set[str]) -> ca.Function:
    """IPOPT for the problem with the limits `counted`, whose shares stay within -1 and 1."""
    z = ca.MX.sym("z", problem.unknowns.size)
    poses, rates, _ = motion(problem.unknowns, z, problem.times)
    shares = problem.constraints.shares_of(counted).map(len(problem.times))(poses, rates)
    options: dict[str, Any] = {
        "print_time": False,
        "ipopt": {
            "print_level": 0,
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


SEARCHES: dict[str, Search] = {"random": best_of, "evolutionary": evolve, "gradient": climb}
"""The methods of a scenario, see `excitation.method`."""
