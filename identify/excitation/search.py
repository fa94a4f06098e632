"""What the searches share, and the search by differential evolution, in the place of the paper's genetic algorithm.

Exciting trajectory by differential evolution, in the place of the paper's genetic algorithm.
A member of the population is scaled, a pose component at a time, until it fills the box, as a random trajectory is:
its size is then no unknown any more, and no limit on the amplitude has to be found by chance. Among two members the
admissible one wins, among two that are not the one that breaks its limits less.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.optimize import differential_evolution

from identify.arrays import Array
from identify.errors import TrajectoryError
from identify.excitation.constraints import MotionConstraints, Worst
from identify.excitation.motion import SAMPLES_PER_HARMONIC, Unknowns, sample_times
from identify.progress import Advance
from identify.trajectory import FourierTrajectory

# What both searches share: the problem, its admissible candidates, and what a search found.


CHECK_REFINEMENT = 8
"""How much finer constraints are checked in the end than while a search runs."""

CLEARANCE = (np.pi / (SAMPLES_PER_HARMONIC * CHECK_REFINEMENT)) ** 2 / 2
"""Share of every limit that is kept: by so much the highest harmonic can rise between the instants of the check."""


@dataclass(frozen=True)
class SearchProblem:
    """Maximise `value` (z -> logarithm of a criterion) under `constraints`; `smooth` is `value` with derivatives."""

    unknowns: Unknowns
    constraints: MotionConstraints
    value: ca.Function
    smooth: ca.Function

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
        """The largest share of z that is admissible: the home pose itself is, so shrinking the motion leads there.

        Raises TrajectoryError, naming the constraint, where not even a thousandth of it is.
        """
        if self.is_admissible(z):
            return z
        inside, outside = 0.0, 1.0
        while outside - inside > 1e-6:
            middle = (inside + outside) / 2
            inside, outside = (middle, outside) if self.is_admissible(middle * z) else (inside, middle)
            if outside < 1e-3:
                worst = max(self.worst(middle * z), key=lambda w: np.inf if np.isnan(w.share) else w.share)
                raise TrajectoryError(f"no start is admissible, not even close to home: {worst}")
        return inside * z


@dataclass(frozen=True)
class SearchResult:
    """The z that a search found, logarithm of its criterion, evaluations of the criterion (and of its gradient),
    iterations or generations, and why the search stopped."""

    z: Array
    log_value: float
    evaluations: int
    gradients: int
    iterations: int
    reason: str

    def trajectory(self, problem: SearchProblem) -> FourierTrajectory:
        """The trajectory that was found."""
        return problem.unknowns.trajectory(self.z)


STALLED = 1e-10
"""The paper's stop criterion: spread of the population's values, relative."""

FEWEST_MEMBERS, MOST_MEMBERS = 5, 32
"""Differential evolution combines members with others; more of them converge more slowly than they find better."""

RECOMBINATION = 0.9
"""Share of the unknowns that a trial takes from its mutant; the best of what was tried, with MOST_MEMBERS."""

NOT_ADMISSIBLE = 1e6
"""Added to the cost of a member that breaks a limit, beyond any value of a criterion."""


def evolve(
    problem: SearchProblem,
    population: list[Array],
    generations: int,
    rng: np.random.Generator,
    advance: Advance = lambda n=1: None,
) -> SearchResult:
    """The best of `generations` generations that begin with the first of `population` (z); `advance` per generation.

    `population` has at least FEWEST_MEMBERS; no more than MOST_MEMBERS take part.
    """
    filling = _Filling(problem)
    start = np.array([_normalised(z, problem.unknowns.columns) for z in population[:MOST_MEMBERS]])
    found = differential_evolution(
        filling.cost,
        bounds=[(-1.0, 1.0)] * problem.unknowns.size,
        init=start,
        maxiter=generations,
        tol=STALLED,
        polish=False,
        recombination=RECOMBINATION,
        rng=rng,
        callback=lambda intermediate_result: advance(),
    )
    z = problem.drawn_in(filling.fill(found.x))
    reason = "values no longer spread" if found.success else f"{found.nit} generations"
    return SearchResult(z, float(problem.value(z)), found.nfev, 0, found.nit, reason)


class _Filling:
    """The cost of members of the population."""

    def __init__(self, problem: SearchProblem) -> None:
        self._problem = problem
        self._offset, self._rate, _ = problem.unknowns.basis(problem.times)
        self._shares = problem.constraints.shares.map(len(problem.times))

    def fill(self, member: Array) -> Array:
        """z of a member: each pose component scaled to fill the box."""
        matrix = member.reshape(6, -1)
        largest = np.abs(matrix @ self._offset.T).max(axis=1)
        return np.asarray((matrix / np.where(largest > 0, largest, 1.0)[:, None]).ravel())

    def cost(self, member: Array) -> float:
        """Minus the logarithm of the criterion, or what is broken."""
        z = self.fill(member)
        matrix, unknowns = z.reshape(6, -1), self._problem.unknowns
        poses = unknowns.home[:, None] + unknowns.box[:, None] * (matrix @ self._offset.T)
        shares = np.array(self._shares(poses, unknowns.box[:, None] * (matrix @ self._rate.T)))[6:]
        worst = float(np.abs(shares).max())
        if not worst <= 1:
            return NOT_ADMISSIBLE * (2 if np.isnan(worst) else 2 - 1 / worst)
        value = float(self._problem.value(z))
        return -value if np.isfinite(value) else NOT_ADMISSIBLE


def _normalised(z: Array, columns: int) -> Array:
    matrix = z.reshape(6, columns)
    return np.asarray((matrix / np.abs(matrix).max(axis=1, keepdims=True)).ravel())
