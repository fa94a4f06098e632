"""What an identification says about the base parameters: the combinations that a record can show.

A group's estimate and standard deviation follow from those of its parameters by linear propagation; it is often known
well where none of its members is.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynamics.parameters import JOINT_PID_NAMES
from identify.arrays import Array
from identify.estimation.base_parameters import BaseParameters
from identify.estimation.identifiability import Identifiability
from identify.estimation.propagation import combined_std
from identify.loop_parameters import StartingGuess


@dataclass(frozen=True)
class GroupEstimates:
    """Base parameters of the 64 dynamic parameters, one row each: what they are, and what is known of them.

    combinations (rank, 64); initial, estimate, std (rank,), SI units of the leading parameter; identifiable (rank,).
    """

    names: tuple[str, ...]
    expressions: tuple[str, ...]
    combinations: Array
    initial: Array
    estimate: Array
    std: Array
    identifiable: NDArray[np.bool_]


def group_rows(base: BaseParameters) -> Array:
    """The groups as combinations (rank, 67) of all parameters: the gains of the joint PID belong to none."""
    return np.pad(base.combinations, ((0, 0), (0, len(JOINT_PID_NAMES))))


def group_estimates(
    base: BaseParameters, guess: StartingGuess, criterion: Identifiability, estimate: Array, covariance: Array
) -> GroupEstimates:
    """Estimates of the groups from parameters (67,) and their covariance (67, 67)."""
    rows = group_rows(base)
    return GroupEstimates(
        names=base.group_names(),
        expressions=base.expressions(),
        combinations=base.combinations,
        initial=rows @ guess.values,
        estimate=rows @ estimate,
        std=combined_std(rows, covariance),
        identifiable=criterion.judge(rows, covariance),
    )
