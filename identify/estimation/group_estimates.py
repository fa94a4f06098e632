"""What an identification says about the base parameters: the combinations that a record can show.

A group's estimate and standard deviation follow from those of its parameters by linear propagation; it is often known
well where none of its members is. A group is called identified when the record at least halves what was unknown of it,
and leaves less than half of its value in doubt.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from identify.arrays import Array
from identify.estimation.base_parameters import BaseParameters
from identify.estimation.loop_parameters import StartingGuess

IDENTIFIABLE_SHARE = 0.5
"""A quantity counts as identified when the record at least halves the standard deviation of the starting guess."""


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


def group_estimates(
    base: BaseParameters, guess: StartingGuess, estimate: Array, covariance: Array
) -> GroupEstimates:
    """Estimates of the groups from parameters (67,) and their covariance (67, 67); the PID gains come after the 64."""
    rows = base.combinations
    count = rows.shape[1]
    values = rows @ estimate[:count]
    std = np.sqrt(np.einsum("gi,ij,gj->g", rows, covariance[:count, :count], rows))
    before = np.sqrt((rows**2) @ guess.std[:count] ** 2)
    return GroupEstimates(
        names=base.group_names(),
        expressions=base.expressions(),
        combinations=rows,
        initial=rows @ guess.values[:count],
        estimate=values,
        std=std,
        identifiable=(std < IDENTIFIABLE_SHARE * before) & (std < IDENTIFIABLE_SHARE * np.abs(values)),
    )
