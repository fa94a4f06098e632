"""Identifiability of each parameter and group of parameters.

A quantity counts as identified if the record

- at least halves its prior standard deviation, and
- leaves a standard deviation of less than half of its size.

The size follows from the initial guess and not from the noisy estimate. A criterion with the
estimate would select quantities whose estimates are large by chance, and their intervals would miss
the truth too often. The size of a parameter is its initial guess. For friction with a guess of
zero, the size is a tenth of the torque that the joints hold at home. For a first moment or a
product of inertia with a guess of zero, it is a tenth of `asymmetry`. The size of a group is the
root of the sum of squares of the contributions of its members. A difference of large masses thus
has the size of these masses, even if the guess of the difference is zero.

Groups are the base parameters, the combinations that a record can identify. The uncertainty of a
group follows from its members by linear propagation. A group is often known well although none of
its members is known. Poses identify the groups and the gains up to a common factor, and the scale
anchor identifies the measured quantity. Another parameter can still have a small standard
deviation, if the guess of the other members of its group is accurate. For example, a mass that acts
only in link4.Ixx - 0.0227 link4.mass depends on the guess of link4.Ixx. If errors of the guess make
more than half of the variance of an estimate, the estimate rests on the prior. Its interval then
contains the truth only if the interval of the guess does, and further records do not help.

The common factor of all parameters can also rest on the prior. If poses show the platform's mass
only in a sum with other heavy bodies, weighing the platform does not fix the factor. The gains
reveal this, because poses determine them up to the common factor.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynamics import Robot
from dynamics.parameters import ParameterLayout
from identify.arrays import Array
from identify.estimation.base_parameters import (
    BaseParameters,
    rank_by_threshold,
    reference_regressor,
    structure,
)
from identify.estimation.bounded_least_squares import Solution
from identify.estimation.conditioning import Conditioning, conditioning
from identify.estimation.covariance import Uncertainty
from identify.estimation.explanation import Explanation
from identify.estimation.full_bodies import full_body_warnings
from identify.estimation.intervals import BoundedEstimate, bounded_estimate, combined_std
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.estimation.prior import (
    StartingGuess,
    asymmetry,
    friction,
    holding_torque,
    passive_torque,
)
from identify.estimation.scale_anchor import ScaleAnchor

# Fraction of the prior standard deviation and of the size of a quantity. The standard deviation of
# an identified quantity is below this fraction of both.
IDENTIFIABLE_SHARE = 0.5
# Fraction of the variance due to errors of the guess above which an estimate rests on the prior.
RESTS_ON_PRIOR = 0.5
# Ordinary friction, as a fraction of the holding torque or force. It is Coulomb friction, or
# viscous friction at 1 rad/s or 1 m/s.
FRICTION_SHARE = 0.1
# Ordinary first moments and products of inertia, as a fraction of `asymmetry`.
ASYMMETRY_SHARE = 0.1


@dataclass(frozen=True)
class Identifiability:
    """Criterion by which quantities are identified.

    std, sizes (p,): prior standard deviations and sizes of the parameters, SI. model_holds: False
    if an error of the model causes most of the residuals. Then nothing counts as identified.
    """

    std: Array
    sizes: Array
    model_holds: bool = True

    def judge(self, rows: Array, covariance: Array) -> NDArray[np.bool_]:
        """Return which of the quantities rows (n, p) @ parameters are identified.

        covariance (p, p): covariance of the estimate.
        """
        after = combined_std(rows, covariance)
        before = np.sqrt(rows**2 @ self.std**2)
        size = np.sqrt(rows**2 @ self.sizes**2)
        return self.model_holds & (after < IDENTIFIABLE_SHARE * np.minimum(before, size))


def identifiability(
    guess: StartingGuess, robot: Robot, model_holds: bool = True
) -> Identifiability:
    """Return the criterion that follows from an initial guess.

    Parameters with a guess of zero, except friction, first moments and products of inertia, have
    the size 1.
    """
    layout = robot.layout
    usual_friction = FRICTION_SHARE * holding_torque(robot, guess.values[robot.layout.dynamic])
    ordinary = np.where(friction(layout), usual_friction, 1.0)
    uneven = ASYMMETRY_SHARE * asymmetry(robot, guess.values)
    ordinary[layout.inertial] = np.where(layout.signed[layout.inertial], uneven, 1.0)
    ordinary[layout.passive] = passive_torque(robot, usual_friction)
    sizes = np.where(guess.values != 0, np.abs(guess.values), ordinary)
    return Identifiability(guess.std, sizes, model_holds)


@dataclass(frozen=True)
class GroupEstimates:
    """Estimates of the base parameters, in SI units of the leading parameter of each group.

    names, expressions              Name of each group, and the group as a sum.
    combinations (rank, d)          Groups as combinations of the d dynamic parameters.
    initial, estimate, std (rank,)  Initial guesses, estimates, and standard deviations of the
                                    estimates.
    identifiable (rank,)            True for identified groups.
    prior_share (rank,)             Fraction of the variance due to errors of the initial guess.
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
    def several(self) -> NDArray[np.bool_]:
        """True for each group (rank,) of several parameters."""
        return np.asarray(np.count_nonzero(self.combinations, axis=1) > 1)

    @property
    def rests_on_prior(self) -> NDArray[np.bool_]:
        """True for each group (rank,) that is identified only with the help of the guess."""
        return self.identifiable & (self.prior_share > RESTS_ON_PRIOR)


def group_rows(combinations: Array, layout: ParameterLayout) -> Array:
    """Return the groups as combinations (rank, p) of all parameters.

    combinations (rank, d): the groups as combinations of the d dynamic parameters. The gains of the
    joint PID belong to no group.
    """
    return np.pad(combinations, ((0, 0), (0, len(layout.joint_pid_names))))


def group_estimates(
    base: BaseParameters,
    guess: StartingGuess,
    criterion: Identifiability,
    estimate: Array,
    uncertainty: Uncertainty,
) -> GroupEstimates:
    """Return the estimates of the groups from parameters (p,) and their uncertainty."""
    rows = group_rows(base.combinations, guess.layout)
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
    """Return the fraction (n,) of the variance of rows @ parameters that a part of it causes.

    rows (n, p): combinations. part, covariance (p, p): the part of the covariance of the
    parameters, and the whole covariance.
    """
    return np.asarray((combined_std(rows, part) / combined_std(rows, covariance)) ** 2)


# Largest relative standard deviation of the common factor without a warning. Only the part due to
# the initial guess counts, and only if an instrument was used to fix the factor.
SCALE_KNOWN = 0.015
# Largest relative standard deviation of the common factor, from all causes, without a warning.
SCALE_WIDE = 0.03


def scale_warnings(
    anchor: ScaleAnchor, gain: str, std: float, prior_share: float, whole_std: float
) -> tuple[str, ...]:
    """Return a warning if an instrument was used to fix the scale, but does not fix it well.

    Poses determine the controller's gain up to the scale. gain: name of this gain. std: its
    relative standard deviation due to errors of the initial guess. prior_share: fraction of its
    variance due to these errors. whole_std: its relative standard deviation from all causes.
    """
    if anchor.value is None:
        return ()
    if std <= SCALE_KNOWN or prior_share <= RESTS_ON_PRIOR:
        if whole_std <= SCALE_WIDE:
            return ()
        return (
            f"the scale anchor {anchor.name} fixes the scale of this robot only to "
            f"{whole_std:.1%}, the standard deviation of {gain}; all values in kg, N m or N share "
            "this error: a new run with --set identification.scale_anchor=joint_gain, or payload, "
            "makes it smaller",
        )
    return (
        f"the scale anchor {anchor.name} does not fix the scale of this robot: {gain} is known "
        f"only to {whole_std:.1%}, of which the initial guess causes {std:.1%}, because poses show "
        "the measured quantity only in sums with other parameters; all values in kg, N m or N "
        "share this error: use identification.scale_anchor = joint_gain, or state further weighed "
        "masses in identification.prior",
    )


@dataclass(frozen=True)
class Judgement:
    """Judgement of an estimate: identifiability, intervals and warnings.

    identifiable (p,)               True for identified parameters.
    prior_share (p,)                Fraction of the variance due to errors of the initial guess.
    common_share (p,)               Fraction of the variance due to errors that all poses have in
                                    common, by kind.
    intervals, group_intervals (p, 2) and (rank, 2)
                                    95 % intervals of parameters and groups, truncated at the
                                    bounds.
    groups                          Estimates of the base parameters.
    bounded                         Estimate within bounds, which states the distribution of every
                                    quantity.
    conditioning                    Conditioning of the estimate.
    base_rank                       Number of independent groups that the references excite, by the
                                    paper's rule.
    active_bounds                   Bounds that limit the estimate.
    warnings                        Warnings of the records, the model and the estimate.
    """

    identifiable: NDArray[np.bool_]
    prior_share: Array
    common_share: dict[str, Array]
    intervals: Array
    groups: GroupEstimates
    group_intervals: Array
    bounded: BoundedEstimate
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
    """Judge a solution by its uncertainty and by how well the model explains the records.

    qr_threshold: threshold of `rank_by_threshold` for the groups that the references excite.
    """
    robot = problem.runs[0].robot
    guess = problem.guess
    estimate = solution.parameters
    base = structure(robot)
    known = problem.known_information()
    criterion = identifiability(guess, robot, model_holds=explanation.model_holds)
    each = np.eye(len(estimate))
    # Every law of the drives has this gain, and poses determine it up to the common factor.
    gain = robot.layout.joint_pid.start
    prior_share = variance_share(each, uncertainty.of_guess, uncertainty.covariance)
    gain_by_guess = float(np.sqrt(uncertainty.of_guess[gain, gain]) / estimate[gain])
    gain_whole = float(uncertainty.std[gain] / estimate[gain])
    # Under torque commands the gains have no information, but the commands determine the scale.
    if not uncertainty.information[gain, gain]:
        gain_by_guess = gain_whole = 0.0
    conditioned = conditioning(uncertainty.information, known, base, guess, estimate)
    bounded = bounded_estimate(
        estimate,
        solution.at_bound,
        uncertainty.gradient,
        uncertainty.covariance,
        uncertainty.white,
        problem.bounds,
    )
    excited = [
        reference_regressor(run.robot, run.reference, run.settings.timing.frame_rate_hz)
        for run in problem.runs
    ]
    groups = group_estimates(base, guess, criterion, estimate, uncertainty)
    identifiable = criterion.judge(each, uncertainty.covariance)
    in_groups = group_rows(base.combinations, robot.layout)[groups.identifiable] != 0
    shown = identifiable | np.any(in_groups, axis=0)
    of_the_records = (warning for run in problem.runs for warning in run.warnings())
    return Judgement(
        identifiable=identifiable,
        prior_share=prior_share,
        common_share={
            kind: variance_share(each, part, uncertainty.covariance)
            for kind, part in uncertainty.of_common.items()
        },
        intervals=bounded.intervals(each),
        groups=groups,
        group_intervals=bounded.intervals(group_rows(base.combinations, robot.layout)),
        bounded=bounded,
        conditioning=conditioned,
        base_rank=rank_by_threshold(np.concatenate(excited), qr_threshold),
        active_bounds=bounded.active_bounds,
        warnings=(
            *of_the_records,
            *uncertainty.warnings(),
            *explanation.warnings(),
            *bounded.warnings(),
            *full_body_warnings(robot, estimate, uncertainty.covariance, shown),
            *conditioned.warnings(),
            *scale_warnings(
                problem.anchor,
                robot.layout.names[gain],
                gain_by_guess,
                float(prior_share[gain]),
                gain_whole,
            ),
        ),
    )
