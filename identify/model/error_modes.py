"""Effect of errors that all poses of a run have in common, by runs of the model with each error."""

from collections.abc import Callable
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
    beside: Array | float | None = None,
) -> Array:
    """Return the changes (N, 6, k) of a run's poses by one standard deviation of each error.

    They are central differences about the common errors that the model contains, at parameters
    (p,).
    shown: function that returns the poses (N, 6) of a simulated run. beside (N, 6, k): given
    columns for the errors of measured poses. If it is given, these errors are not simulated.

    Raises LoopFailure if the model is unstable.
    """
    drawn = run.errors_had
    modes = np.zeros((*run.measured.shape, len(drawn)))
    count = len(run.common.names)
    if beside is not None:
        modes[:, :, :count] = beside
    moving = [] if beside is not None else list(range(count))[: run.common.noticed]
    moving += range(count, len(drawn))
    if run.bodies is not None:
        # A crank about a vertical axis, for example, needs no torque for most of its errors.
        without = np.abs(run.bodies).max(axis=(1, 2)) < LEAST_COMMAND
        still = len(drawn) - len(without) + np.flatnonzero(without)
        moving = [k for k in moving if k not in still]
    ends = [
        np.maximum(drawn + sign * np.eye(len(drawn))[k], run.lowest_drawn)
        for k in moving
        for sign in (1.0, -1.0)
    ]
    found = in_threads(lambda end: shown(run.having(end).simulate(parameters)), ends)
    for place, k in enumerate(moving):
        more, less = found[2 * place : 2 * place + 2]
        high, low = ends[2 * place : 2 * place + 2]
        # The distance is less than two units if the loop cannot contain the lower end.
        modes[:, :, k] = (more - less) / (high[k] - low[k])
    if (geometry := run.common.geometry) is None:
        return modes
    by_geometry = geometry.modes(lambda robot: run.simulate(parameters, robot=robot).pose)
    return np.concatenate([modes, by_geometry], axis=2)
