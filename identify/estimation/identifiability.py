"""What the records decide of each parameter and group: whether it is identified, in what interval,
and at what risk.

A quantity counts as identified when the record

    at least halves the standard deviation that the starting guess leaves, and
    leaves less than half of the quantity's size in doubt.

The size follows from the starting guess and not from the estimate. An estimate is noisy, and what
is judged by it is called identified just where chance made it large: intervals selected so miss the
truth too often. A parameter's size is that of its guess. Of friction that is guessed to be zero it
is a tenth of the torque that the joints hold at home. The size of a group is the root of the summed
squares of what its members contribute. So a difference of large masses is as large as they are,
though the guess may have it vanish: known to a fraction of that, it is known to be small, while its
own relative error may be anything.

Groups are the base parameters, the combinations that a record can show: what is known of one
follows from its members by linear propagation, and it is often known well where none of them is.
Poses show the groups and the gains up to their common factor; the scale anchor adds what it
measures. A parameter that is none of these, nor a combination of them, may be estimated with a
small standard deviation all the same: where the guess knows the other members of a sum well enough
for that, however vaguely in their own units. A mass shown only in link4.Ixx - 0.0227 link4.mass is
one: it rests on the guess of link4.Ixx. Where errors of the guess make more than half of an
estimate's variance, it rests on the prior: it is as good as what the guess says, which is the same
in every record, and its interval holds the truth where that does.

The common factor may rest on it, too: weighing a platform does not fix it where poses show the
platform's mass only in a sum with others that are heavy. The gains tell, since poses show them but
for this factor.

Conditioning says how unevenly a record tells the parameters apart. The information is taken in
units of the starting guess: an eigenvalue of one is a direction that the record shows as well as
the guess knows it. With the guess the information is that of all parameters. Without it, most of
them would have none: there the poses are asked for the base parameters and the gains, with their
common factor held, which poses never show (`scale_anchor`).
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
from identify.estimation.prior import StartingGuess, friction, holding_torque
from identify.estimation.scale_anchor import ScaleAnchor
from identify.scenario import Scenario

IDENTIFIABLE_SHARE = 0.5
"""Of the guess's standard deviation and of the size: what the record may leave of an identified
quantity.
"""

RESTS_ON_PRIOR = 0.5
"""Of an estimate's variance: what errors of the starting guess make of it where it rests on the
prior.
"""

FRICTION_SHARE = 0.1
"""Of the holding torque or force: an ordinary Coulomb friction, and viscous friction at 1 rad/s or
1 m/s.
"""


@dataclass(frozen=True)
class Identifiability:
    """What the starting guess leaves of each parameter, std (p,), and its size (p,), SI;
    model_holds: whether noise, and not an error of the model, makes most of the residuals: with
    another model nothing is identified."""

    std: Array
    sizes: Array
    model_holds: bool = True

    def judge(self, rows: Array, covariance: Array) -> NDArray[np.bool_]:
        """Whether each quantity rows (n, p) @ parameters is identified, with the estimate's
        covariance (p, p).
        """
        left = combined_std(rows, covariance)
        before = np.sqrt(rows**2 @ self.std**2)
        size = np.sqrt(rows**2 @ self.sizes**2)
        return self.model_holds & (left < IDENTIFIABLE_SHARE * np.minimum(before, size))


def identifiability(
    guess: StartingGuess, robot: Robot, model_holds: bool = True
) -> Identifiability:
    """The criterion that follows from a starting guess; a guess of zero, other than of friction,
    has the size 1.
    """
    held = FRICTION_SHARE * holding_torque(robot, guess.values[robot.layout.dynamic])
    unsaid = np.where(friction(robot.layout), held, 1.0)
    return Identifiability(
        guess.std, np.where(guess.values != 0, np.abs(guess.values), unsaid), model_holds
    )


@dataclass(frozen=True)
class GroupEstimates:
    """Base parameters of the dynamic parameters, one row each: what they are, and what is known of
    them.

    combinations (rank, p); initial, estimate, std (rank,), SI units of the leading parameter;
    identifiable (rank,); prior_share (rank,): of the variance.
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
        """Whether each group (rank,) is identified only with what the starting guess says of other
        parameters.
        """
        return self.identifiable & (self.prior_share > RESTS_ON_PRIOR)


def group_rows(base: BaseParameters) -> Array:
    """The groups as combinations (rank, p) of all parameters: the gains of the joint PID belong to
    none.
    """
    return np.pad(base.combinations, ((0, 0), (0, len(JOINT_PID))))


def group_estimates(
    base: BaseParameters,
    guess: StartingGuess,
    criterion: Identifiability,
    estimate: Array,
    uncertainty: Uncertainty,
) -> GroupEstimates:
    """Estimates of the groups from parameters (p,) and their uncertainty."""
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
    """What share of the variance of each quantity rows (n, p) @ parameters a part (p, p) of their
    covariance makes.
    """
    return np.asarray((combined_std(rows, part) / combined_std(rows, covariance)) ** 2)


SCALE_KNOWN = 0.015
"""Standard deviation of the common factor, as a share of it, that the starting values may leave
where an instrument was to fix it."""


def scale_warnings(anchor: ScaleAnchor, left: float, prior_share: float) -> tuple[str, ...]:
    """One line where an instrument was to fix the scale, and the controller's gain, which poses
    show but for the scale, rests on the prior: errors of the starting values leave it uncertain by
    this share, and make most of its variance.
    """
    if anchor.value is None or left <= SCALE_KNOWN or prior_share <= RESTS_ON_PRIOR:
        return ()
    return (
        f"the scale anchor {anchor.name} does not fix the scale of this robot: poses show what "
        "was measured only in "
        "sums with other parameters, and the starting values of these leave joint_pid.lp "
        f"uncertain by {left:.1%}; all "
        "that is given in kg, N m or N is as uncertain: take identification.scale_anchor = "
        "joint_gain, or state in "
        "identification.prior what else was weighed",
    )


POOR = 1e13
"""Condition number of the poses' information beyond which double precision (1.1e-16) leaves the
variance of the least known direction fewer than three digits."""


@dataclass(frozen=True)
class Conditioning:
    """Condition numbers (largest over smallest eigenvalue) of the scaled information, with the
    starting guess and of the poses alone (infinite where rounding hides the smallest); of the
    `directions` of base parameters and gains, `unshown` are those that the guess knows better than
    the poses show them."""

    with_guess: float
    poses_alone: float
    directions: int
    unshown: int

    @property
    def poor(self) -> bool:
        """Whether rounding decides what the poses say of the least known direction."""
        return self.poses_alone > POOR

    def warnings(self) -> tuple[str, ...]:
        """One line where the record is poorly conditioned."""
        if not self.poor:
            return ()
        number = (
            f"{self.poses_alone:.1e}, more than {POOR:.0e}"
            if np.isfinite(self.poses_alone)
            else "beyond rounding"
        )
        return (
            f"the record is poorly conditioned: of {self.directions} independent combinations of "
            "parameters and gains, "
            f"{self.unshown} are known from the starting values rather than from the poses (the "
            "condition number of "
            f"what the poses tell is {number}); move the robot faster, farther or longer",
        )


def conditioning(
    information: Array, known: Array, base: BaseParameters, guess: StartingGuess, estimate: Array
) -> Conditioning:
    """Conditioning of an estimate (p,) from the information (p, p) of the poses and of what is
    known beside them.
    """
    everything = np.linalg.eigvalsh((information + known) * np.outer(guess.std, guess.std))
    count = base.combinations.shape[1]
    # without those that the law of the drives lacks
    gains = count + np.flatnonzero(np.diag(information)[count:])
    seen = np.concatenate([base.pivots, gains])
    size = np.concatenate(
        [np.sqrt(base.combinations**2 @ guess.std[:count] ** 2), guess.std[gains]]
    )
    values = np.concatenate([base.combinations @ estimate[:count], estimate[gains]])
    # A base parameter acts through its pivot alone, whose column is therefore its own.
    scaled = information[np.ix_(seen, seen)] * np.outer(size, size)
    free = null_space((values / size)[None])
    shown = np.linalg.eigvalsh(free.T @ scaled @ free)
    smallest = float(shown[0])
    alone = float(shown[-1]) / smallest if smallest > 0 else np.inf
    return Conditioning(
        float(everything[-1] / everything[0]), alone, len(shown), int(np.sum(shown < 1))
    )


@dataclass(frozen=True)
class Judgement:
    """identifiable (p,) bool; prior_share (p,): of the variance, what errors of the guess make;
    common_share (p,) by kind: what those make that all poses of a record have in common; intervals
    (p, 2) and group_intervals: 95 %, cut at the bounds; base_rank: independent groups that the
    references excite by the paper's rule; active_bounds: what holds the estimate back; warnings:
    what a reader must know before believing any of it."""

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
    scenario: Scenario,
    solution: Solution,
    uncertainty: Uncertainty,
    explanation: Explanation,
) -> Judgement:
    """Judge what a search found, given its uncertainty and how well it explains the records."""
    robot = problem.runs[0].robot
    guess = problem.guess
    estimate = solution.parameters
    base = structure(robot)
    known = problem.known_information()
    criterion = identifiability(guess, robot, model_holds=explanation.model_holds)
    each = np.eye(len(estimate))
    gain = robot.layout.names.index("joint_pid.lp")
    prior_share = variance_share(each, uncertainty.of_guess, uncertainty.covariance)
    gain_left = float(np.sqrt(uncertainty.of_guess[gain, gain]) / estimate[gain])
    if not uncertainty.information[
        gain, gain
    ]:  # commands that are torques show the scale themselves
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
        base_rank=_excited_rank(problem, scenario),
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


def _excited_rank(problem: OutputErrorProblem, scenario: Scenario) -> int:
    """Independent groups that the records' references excite, by the paper's rule."""
    rate_hz = scenario.timing.frame_rate_hz
    excited = [reference_regressor(run.robot, run.reference, rate_hz) for run in problem.runs]
    return rank_by_threshold(np.concatenate(excited), scenario.identification.qr_threshold)
