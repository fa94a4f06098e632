"""Effect of errors that all poses of a run have in common, by runs of the model with each error."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from dynamics.closed_loop import ClosedLoopRun
from identify.arrays import Array
from identify.runtime import in_threads

if TYPE_CHECKING:
    from identify.model.loop_model import LoopModel


LEAST_COMMAND = 1e-10
"""Largest change of a command, rad, m, N m or N, that counts as none."""


def error_modes(
    run: "LoopModel",
    parameters: Array,
    shown: Callable[[ClosedLoopRun], Array],
    known: Mapping[int, Array | float],
) -> Array:
    """Return the changes (N, 6, k) of a run's poses by one standard deviation of each error.

    They are central differences about the common errors that the model contains, at parameters
    (p,).
    shown: function that returns the poses (N, 6) of a simulated run. known: changes (N, 6) by
    errors that are not simulated, by the place of the error.

    Raises LoopFailure if the model is unstable.
    """
    drawn = run.errors_had
    modes = np.zeros((*run.measured.shape, len(drawn)))
    for place, change in known.items():
        modes[:, :, place] = change
    # Errors of poses beyond the noticed ones change nothing.
    unnoticed = range(run.common.noticed, len(run.common.names))
    moving = [k for k in range(len(drawn)) if k not in known and k not in unnoticed]
    if run.bodies is not None:
        # A crank about a vertical axis, for example, needs no torque for most of its errors.
        without = np.abs(run.bodies).max(axis=(1, 2)) < LEAST_COMMAND
        still = len(drawn) - len(without) + np.flatnonzero(without)
        moving = [k for k in moving if k not in still]
    ends = [
        np.maximum(drawn + sign * np.diag(run.difference_steps)[k], run.lowest_drawn)
        for k in moving
        for sign in (1.0, -1.0)
    ]
    found = in_threads(lambda end: shown(run.having(end).simulate(parameters)), ends)
    for place, k in enumerate(moving):
        more, less = found[2 * place : 2 * place + 2]
        high, low = ends[2 * place : 2 * place + 2]
        # The distance is less than two steps if the loop cannot contain the lower end.
        modes[:, :, k] = (more - less) / (high[k] - low[k])
    if (geometry := run.common.geometry) is None:
        return modes
    by_geometry = geometry.modes(lambda robot: run.simulate(parameters, robot=robot).pose)
    return np.concatenate([modes, by_geometry], axis=2)
