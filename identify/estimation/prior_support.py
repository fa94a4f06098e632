"""Which parameters a record tells on their own, and which only with the help of the starting guess.

Poses show the base parameters, sums of parameters, and the gains; the scale anchor adds what it measures. A parameter
that is none of these, nor a combination of them, may be estimated with a small standard deviation all the same: where
the guess knows the other members of a sum well enough for that, however vaguely in their own units. Such an estimate
is as good as what the guess says of them, and its interval holds the truth where that does. A mass shown only in
link4.Ixx - 0.0227 link4.mass is one: it rests on the guess of link4.Ixx.

The common factor of all parameters counts as known by its anchor; where that is the prior, no parameter is on its own.
"""

import numpy as np
from numpy.typing import NDArray

from identify.arrays import Array
from identify.estimation.base_parameters import BaseParameters
from identify.estimation.group_estimates import group_rows
from identify.estimation.scale_anchor import ScaleAnchor

ROUNDING = 1e-6
"""Of a unit vector: what may be left of it outside the combinations that are shown, in units of the sizes."""


def rests_on_prior(base: BaseParameters, anchor: ScaleAnchor, estimate: Array, sizes: Array) -> NDArray[np.bool_]:
    """Whether each of the 67 parameters is no combination of what record and anchor show.

    estimate (67,): the direction of the common factor; sizes (67,): the unit in which each parameter is counted.
    """
    gains = np.eye(len(sizes))[base.combinations.shape[1] :]
    shown = np.concatenate([group_rows(base), gains, anchor.row()[0]]) * sizes
    if anchor.name == "prior":
        factor = estimate / sizes
        shown = shown - np.outer(shown @ factor, factor) / (factor @ factor)
    shown /= np.linalg.norm(shown, axis=1, keepdims=True)
    _, singular, directions = np.linalg.svd(shown, full_matrices=False)
    span = directions[singular > ROUNDING * singular[0]]
    outside = np.eye(len(sizes)) - span.T @ span
    return np.asarray(np.linalg.norm(outside, axis=1) > ROUNDING)
