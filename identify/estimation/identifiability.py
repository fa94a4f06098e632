"""Identifiability of each parameter and group: whether the records identify it, and at what risk.

A quantity counts as identified when the record

- at least halves the standard deviation that the starting guess leaves, and
- leaves less than half of the quantity's size in doubt.

The size follows from the starting guess and not from the estimate. An estimate is noisy, and what
is judged by it is called identified just where chance made it large. Intervals that are selected in
this way miss the truth too often. A parameter's size is that of its guess. For friction that is
guessed to be zero, it is a tenth of the torque that the joints hold at home. The size of a group is
the root of the summed squares of what its members contribute. So a difference of large masses is as
large as they are, though the guess may have it vanish. If it is known to a fraction of that, it is
known to be small, while its own relative error may be anything.

Groups are the base parameters, the combinations that a record can show. What is known of one
follows from its members by linear propagation, and it is often known well where none of them is.
Poses show the groups and the gains up to their common factor. The scale anchor adds what it
measures. A parameter that is none of these, nor a combination of them, may be estimated with a
small standard deviation all the same, if the guess knows the other members of a sum well enough. A
mass that shows only in link4.Ixx - 0.0227 link4.mass is an example: it rests on the guess of
link4.Ixx. Where errors of the guess make more than half of an estimate's variance, the estimate
rests on the prior. It is as good as what the guess says, which is the same in every record, and its
interval holds the truth where that of the guess does.

The common factor may rest on the prior, too. Weighing a platform does not fix it where poses show
the platform's mass only in a sum with others that are heavy. The gains tell, since poses show them
but for this factor.

Conditioning says how unevenly a record tells the parameters apart. The information is taken in
units of the starting guess: an eigenvalue of one is a direction that the record shows as well as
the guess knows it. With the guess, the information is that of all parameters. Without it, most of
them would have none. The poses alone are therefore asked for the base parameters and the gains,
with their common factor held, which poses never show (`prior`).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space

from dynamics import Robot
from dynamics.parameters import JOINT_PID
from identify.arrays import Array
from identify.estimation.base_parameters import (
    BaseParameters,
    rank_by_threshold,
    reference_regressor,
    structure,
)
from identify.estimation.bounded_least_squares import Solution
from identify.estimation.bounds import bounded_estimate, combined_std
from identify.estimation.covariance import Uncertainty
from identify.estimation.explanation import Explanation
from identify.estimation.output_error import OutputErrorProblem
from identify.estimation.prior import ScaleAnchor, StartingGuess, friction, holding_torque

IDENTIFIABLE_SHARE = 0.5
"""Share of the guess's standard deviation, and of the size, that may be left in doubt.

A quantity is identified if its standard deviation is below both.
"""

RESTS_ON_PRIOR = 0.5
"""Share of an estimate's variance by errors of the guess above which it rests on the prior."""

FRICTION_SHARE = 0.1
"""Ordinary friction, as a share of the holding torque or force.

It is Coulomb friction, or viscous friction at 1 rad/s or 1 m/s.
"""


@dataclass(frozen=True)
class Identifiability:
    """Criterion by which quantities are identified.

    std, sizes (p,): standard deviations of the parameters in the starting guess, and their sizes,
    SI. model_holds: False if an error of the model makes most of the residuals. Nothing is
    identified then.
    """

    std: Array
    sizes: Array
    model_holds: bool = True

    def judge(self, rows: Array, covariance: Array) -> NDArray[np.bool_]:
        """Return which of the quantities rows (n, p) @ parameters are identified.

        covariance (p, p): that of the estimate.
        """
        left = combined_std(rows, covariance)
        before = np.sqrt(rows**2 @ self.std**2)
        size = np.sqrt(rows**2 @ self.sizes**2)
        return self.model_holds & (left < IDENTIFIABLE_SHARE * np.minimum(before, size))


def identifiability(
    guess: StartingGuess, robot: Robot, model_holds: bool = True
) -> Identifiability:
    """Return the criterion that follows from a starting guess.

    A guess of zero, other than of friction, has the size 1.
    """
    held = FRICTION_SHARE * holding_torque(robot, guess.values[robot.layout.dynamic])
    unsaid = np.where(friction(robot.layout), held, 1.0)
    sizes = np.where(guess.values != 0, np.abs(guess.values), unsaid)
    return Identifiability(guess.std, sizes, model_holds)


@dataclass(frozen=True)
class GroupEstimates:
    """Estimates of the base parameters, in SI units of the leading parameter of each group.

    Attributes
    ----------
    names, expressions : tuple of str
        Name of each group, and the group as a sum.
    combinations : ndarray, shape (rank, p)
        Groups as combinations of the dynamic parameters.
    initial, estimate, std : ndarray, shape (rank,)
        Values of the starting guess, estimates, and their standard deviations.
    identifiable : ndarray of bool, shape (rank,)
        Groups that are identified.
    prior_share : ndarray, shape (rank,)
        Share of the variance that errors of the starting guess make.
    """

    names: tuple[str, ...]
    expressions: tuple[str, ...]
    combinations: Array
    initial: Array
    estimate: Array
    std: Array
    identifiable: NDArray[np.bool_]
    prior_share: Array

    @property
    def rests_on_prior(self) -> NDArray[np.bool_]:
        """Groups (rank,) that are identified only with what the guess says of other parameters."""
        return self.identifiable & (self.prior_share > RESTS_ON_PRIOR)


def group_rows(base: BaseParameters) -> Array:
    """Return the groups as combinations (rank, p) of all parameters.

    The gains of the joint PID belong to none.
    """
    return np.pad(base.combinations, ((0, 0), (0, len(JOINT_PID))))


def group_estimates(
    base: BaseParameters,
    guess: StartingGuess,
    criterion: Identifiability,
    estimate: Array,
    uncertainty: Uncertainty,
) -> GroupEstimates:
    """Return the estimates of the groups from parameters (p,) and their uncertainty."""
    rows = group_rows(base)
    return GroupEstimates(
        names=base.group_names(),
        expressions=base.expressions(),
        combinations=base.combinations,
        initial=rows @ guess.values,
        estimate=rows @ estimate,
        std=combined_std(rows, uncertainty.covariance),
        identifiable=criterion.judge(rows, uncertainty.covariance),
        prior_share=variance_share(rows, uncertainty.of_guess, uncertainty.covariance),
    )


def variance_share(rows: Array, part: Array, covariance: Array) -> Array:
    """Return the share of the variance of rows (n, p) @ parameters that a part of it makes.

    part, covariance (p, p): the part and the whole of the parameters' covariance.
    """
    return np.asarray((combined_std(rows, part) / combined_std(rows, covariance)) ** 2)


SCALE_KNOWN = 0.015
"""Largest doubt of the common factor, as a share of it, that starting values may leave.

It counts where an instrument was to fix the factor.
"""


def scale_warnings(anchor: ScaleAnchor, left: float, prior_share: float) -> tuple[str, ...]:
    """Return a warning if an instrument was to fix the scale, but does not.

    Poses show the controller's gain but for the scale. left: standard deviation of the gain by
    errors of the starting values, as a share of it. prior_share: share of its variance that they
    make.
    """
    if anchor.value is None or left <= SCALE_KNOWN or prior_share <= RESTS_ON_PRIOR:
        return ()
    return (
        f"the scale anchor {anchor.name} does not fix the scale of this robot: poses show what was "
        "measured only in sums with other parameters, and the starting values of these leave "
        f"joint_pid.lp uncertain by {left:.1%}; all that is given in kg, N m or N is as uncertain: "
        "take identification.scale_anchor = joint_gain, or state in identification.prior what else "
        "was weighed",
    )


POOR = 1e13
"""Condition number of the poses' information beyond which double precision is not enough.

With its resolution of 1.1e-16, the variance of the least known direction has fewer than three
digits left.
"""


@dataclass(frozen=True)
class Conditioning:
    """Condition numbers of the scaled information, largest over smallest eigenvalue.

    Attributes
    ----------
    with_guess : float
        Condition number with the starting guess.
    poses_alone : float
        Condition number of the poses alone, infinite where rounding hides the smallest eigenvalue.
    directions, unshown : int
        Number of directions of base parameters and gains, and number of those that the guess knows
        better than the poses show them.
    """

    with_guess: float
    poses_alone: float
    directions: int
    unshown: int

    @property
    def poor(self) -> bool:
        """True if rounding decides what the poses say of the least known direction."""
        return self.poses_alone > POOR

    def warnings(self) -> tuple[str, ...]:
        """Return a warning if the record is poorly conditioned."""
        if not self.poor:
            return ()
        number = (
            f"{self.poses_alone:.1e}, more than {POOR:.0e}"
            if np.isfinite(self.poses_alone)
            else "beyond rounding"
        )
        return (
            f"the record is poorly conditioned: of {self.directions} independent combinations of "
            f"parameters and gains, {self.unshown} are known from the starting values rather than "
            f"from the poses (the condition number of what the poses tell is {number}); move the "
            "robot faster, farther or longer",
        )


def conditioning(
    information: Array, known: Array, base: BaseParameters, guess: StartingGuess, estimate: Array
) -> Conditioning:
    """Return the conditioning of an estimate (p,).

    information (p, p): that of the poses. known (p, p): that of what is known beside them.
    """
    everything = np.linalg.eigvalsh((information + known) * np.outer(guess.std, guess.std))
    count = base.combinations.shape[1]
    # gains that the law of the drives lacks have no information
    gains = count + np.flatnonzero(np.diag(information)[count:])
    seen = np.concatenate([base.pivots, gains])
    group_std = np.sqrt(base.combinations**2 @ guess.std[:count] ** 2)
    size = np.concatenate([group_std, guess.std[gains]])
    values = np.concatenate([base.combinations @ estimate[:count], estimate[gains]])
    # a base parameter acts through its pivot alone, so that the pivot's column is its own
    scaled = information[np.ix_(seen, seen)] * np.outer(size, size)
    # what is left without the direction of the common factor, that of the values themselves
    free = null_space((values / size)[None])
    shown = np.linalg.eigvalsh(free.T @ scaled @ free)
    smallest = float(shown[0])
    alone = float(shown[-1]) / smallest if smallest > 0 else np.inf
    with_guess = float(everything[-1] / everything[0])
    return Conditioning(with_guess, alone, len(shown), int(np.sum(shown < 1)))


@dataclass(frozen=True)
class Judgement:
    """Judgement of an estimate, and what a reader must know before believing any of it.

    Attributes
    ----------
    identifiable : ndarray of bool, shape (p,)
        Parameters that are identified.
    prior_share : ndarray, shape (p,)
        Share of the variance that errors of the starting guess make.
    common_share : dict of ndarray, shape (p,)
        Share that errors make which all poses of a record have in common, by kind.
    intervals, group_intervals : ndarray, shapes (p, 2) and (rank, 2)
        95 % intervals of parameters and groups, cut at the bounds.
    groups : GroupEstimates
        Estimates of the base parameters.
    conditioning : Conditioning
        Conditioning of the estimate.
    base_rank : int
        Number of independent groups that the references excite, by the paper's rule.
    active_bounds : tuple of str
        What holds the estimate back.
    warnings : tuple of str
        Warnings of the records, the model and the estimate.
    """

    identifiable: NDArray[np.bool_]
    prior_share: Array
    common_share: dict[str, Array]
    intervals: Array
    groups: GroupEstimates
    group_intervals: Array
    conditioning: Conditioning
    base_rank: int
    active_bounds: tuple[str, ...]
    warnings: tuple[str, ...]


def judge(
    problem: OutputErrorProblem,
    qr_threshold: float,
    solution: Solution,
    uncertainty: Uncertainty,
    explanation: Explanation,
) -> Judgement:
    """Judge what a search found, by its uncertainty and by how well it explains the records.

    qr_threshold: that of `rank_by_threshold` for the groups that the references excite.
    """
    robot = problem.runs[0].robot
    guess = problem.guess
    estimate = solution.parameters
    base = structure(robot)
    known = problem.known_information()
    criterion = identifiability(guess, robot, model_holds=explanation.model_holds)
    each = np.eye(len(estimate))
    # every law of the drives has this gain, and poses show it but for the common factor
    gain = robot.layout.names.index("joint_pid.lp")
    prior_share = variance_share(each, uncertainty.of_guess, uncertainty.covariance)
    gain_left = float(np.sqrt(uncertainty.of_guess[gain, gain]) / estimate[gain])
    # commands that are torques show the scale themselves
    if not uncertainty.information[gain, gain]:
        gain_left = 0.0
    conditioned = conditioning(uncertainty.information, known, base, guess, estimate)
    bounded = bounded_estimate(
        estimate,
        solution.at_bound,
        uncertainty.gradient,
        uncertainty.information + known,
        uncertainty.covariance,
        problem.bounds,
    )
    excited = [
        reference_regressor(run.robot, run.reference, run.settings.timing.frame_rate_hz)
        for run in problem.runs
    ]
    of_the_records = (warning for run in problem.runs for warning in run.warnings())
    return Judgement(
        identifiable=criterion.judge(each, uncertainty.covariance),
        prior_share=prior_share,
        common_share={
            kind: variance_share(each, part, uncertainty.covariance)
            for kind, part in uncertainty.of_common.items()
        },
        intervals=bounded.intervals(each),
        groups=group_estimates(base, guess, criterion, estimate, uncertainty),
        group_intervals=bounded.intervals(group_rows(base)),
        conditioning=conditioned,
        base_rank=rank_by_threshold(np.concatenate(excited), qr_threshold),
        active_bounds=bounded.active_bounds,
        warnings=(
            *of_the_records,
            *uncertainty.warnings(),
            *explanation.warnings(),
            *bounded.warnings(),
            *conditioned.warnings(),
            *scale_warnings(problem.anchor, gain_left, float(prior_share[gain])),
        ),
    )
