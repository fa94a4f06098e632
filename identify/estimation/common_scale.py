"""Common scale of the parameters: the factor that poses do not show, and how well it is known.

Multiplying all masses, inertias, friction and gains by one factor changes no pose (`scale_anchor`).
Poses determine the ratio of each parameter to the gain of the drives better than the factor itself.
The relative standard deviation of this gain is therefore that of the factor, and an error of the
factor is an error of all parameters that share it.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from identify.arrays import Array
from identify.estimation.result import IdentificationResult

# Largest ratio of a parameter's relative standard deviation without the factor to that with it, at
# which the parameter counts as sharing the factor.
SHARED = 0.5
ENTRY = "common_scale"  # name of the entry of an identification in result.json


def common_scale(result: IdentificationResult) -> dict[str, Any] | None:
    """Return the entry of the common scale for JSON.

    The entry has the gain, the relative standard deviation of the scale, and for each identified
    parameter that shares the scale the relative standard deviation that is left without it. Returns
    None if no law of the drives acted, the gain is unidentified, or no parameter shares the scale.
    """
    gain = result.layout.joint_pid.start
    if not (result.drive.in_loop and result.identifiable[gain]):
        return None
    shown = np.flatnonzero(result.identifiable & (result.estimate != 0))
    own, without = deviations(result.estimate, result.covariance, gain)
    sharing = [index for index in shown if index != gain and without[index] <= SHARED * own[index]]
    if not sharing:
        return None
    return {
        "gain": result.names[gain],
        "std": float(own[gain]),
        "shared": {result.names[index]: float(without[index]) for index in sharing},
    }


def deviations(estimate: Array, covariance: Array, gain: int) -> tuple[Array, Array]:
    """Return relative standard deviations (p,) of parameters, and those of their ratios to a gain.

    estimate (p,), covariance (p, p): parameters and their covariance. gain: index of the gain. To
    first order, the ratio a / g has the relative variance var(a) / a^2 + var(g) / g^2 -
    2 cov(a, g) / (a g). Entries of parameters that are zero are infinite.
    """
    nonzero = np.where(estimate == 0, np.nan, estimate)
    relative = covariance / np.outer(nonzero, nonzero)
    own = np.diag(relative)
    ratio = np.maximum(own + own[gain] - 2 * relative[gain], 0.0)
    stds = np.nan_to_num(np.sqrt([own, ratio]), nan=np.inf)
    return stds[0], stds[1]


def found_errors(identification: Mapping[str, Any]) -> tuple[float, float] | None:
    """Return the relative error of the common scale, and the largest one that is left without it.

    Both are errors against the truth. The second is the largest absolute one of the parameters that
    share the scale. None is returned if there is no common scale, or if a true value or an estimate
    is zero or unknown.
    """
    scale = identification.get(ENTRY)
    if scale is None:
        return None
    parameters = identification["parameters"]
    entries = [parameters[name] for name in (scale["gain"], *scale["shared"])]
    if not all(one["true"] and one["estimate"] for one in entries):
        return None
    ratios = np.array([one["estimate"] / one["true"] for one in entries])
    return float(ratios[0] - 1), float(np.abs(ratios[1:] / ratios[0] - 1).max())
