"""What both searches share: the problem, its admissible candidates, and what a search found."""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from identify.arrays import Array
from identify.errors import TrajectoryError
from identify.excitation.constraints import MotionConstraints, Worst
from identify.excitation.motion import SAMPLES_PER_HARMONIC, sample_times
from identify.excitation.unknowns import Unknowns
from identify.trajectory import FourierTrajectory

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
