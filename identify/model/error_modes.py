"""Effect of errors that all poses of a run have in common, from runs of the model with each error.

Errors that act as changes of the commands need no run of their own: one run is differentiated along
all of these changes.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np

from dynamics.closed_loop import ClosedLoopRun, LoopFailure, most_directions
from dynamics.parameters import LANES
from identify.arrays import Array
from identify.record.stored_common_errors import FRICTION, kind_of
from identify.runtime import in_threads

if TYPE_CHECKING:
    from identify.model.loop_model import LoopModel

# Step of the differences in a constant of friction, in standard deviations. It is small because the
# motion is far from linear in such a constant. The step in other errors is one standard deviation.
FRICTION_STEP = 1e-4


def error_modes(
    run: "LoopModel",
    parameters: Array,
    shown: Callable[[ClosedLoopRun], Array],
    known: Mapping[int, Array | float],
) -> Array:
    """Return the changes (N, 6, k) of a run's poses by one standard deviation of each error.

    They are central differences about the common errors that the model contains, at parameters
    (p,). Errors of the geometry are the last. shown: function that returns the poses (N, 6) of a
    simulated run. known: changes (N, 6) that need no simulation, by the index of their error. The
    model's `derived_modes` are added to these.

    Raises LoopFailure if the model is unstable.
    """
    had = run.errors_had
    modes = np.zeros((*run.measured.shape, len(had)))
    known = {**known, **run.derived_modes(parameters)}
    for index, change in known.items():
        modes[:, :, index] = change
    # Errors of poses in unnoticed directions count as without effect.
    unnoticed = range(run.common.noticed, len(run.common.names))
    moving = [k for k in range(len(had)) if k not in known and k not in unnoticed]
    inside = (*run.common.names, *run.common.loop_std, *run.common.body_std)
    steps = np.diag([FRICTION_STEP if kind_of(name) == FRICTION else 1.0 for name in inside])
    ends = [
        np.maximum(had + sign * steps[k], run.lowest_drawn) for k in moving for sign in (1.0, -1.0)
    ]
    # Errors of poses come first. Their runs differ only in what the servo measures.
    measured = 2 * sum(k < len(run.common.names) for k in moving)
    poses = _measuring(run, parameters, shown, ends[:measured])
    poses += in_threads(lambda end: shown(run.having(end).simulate(parameters)), ends[measured:])
    for index, k in enumerate(moving):
        more, less = poses[2 * index : 2 * index + 2]
        high, low = ends[2 * index : 2 * index + 2]
        # The distance is less than two steps if the loop cannot contain the lower end.
        modes[:, :, k] = (more - less) / (high[k] - low[k])
    if (geometry := run.common.geometry) is None:
        return modes
    by_geometry = geometry.modes(lambda robot: run.simulate(parameters, robot=robot).pose)
    return np.concatenate([modes, by_geometry], axis=2)


def _measuring(
    run: "LoopModel",
    parameters: Array,
    shown: Callable[[ClosedLoopRun], Array],
    ends: Sequence[Array],
) -> list[Array]:
    """Return, for each of `ends` (k,), the poses (N, 6) of a run that measures with these errors.

    The ends differ from the errors of the model only in errors of poses, so that several runs are
    simulated together. Raises LoopFailure if the model is unstable.
    """
    if not ends:
        return []
    count = len(run.common.names)
    changes = (np.array(ends) - run.errors_had)[:, :count]
    noises = np.tensordot(changes, run.common.modes, (1, 2))
    groups = np.split(noises, range(LANES, len(noises), LANES))
    runs_by_group = in_threads(lambda group: run.simulate_repeats(parameters, group), groups)
    poses = []
    for repeated in chain.from_iterable(runs_by_group):
        if isinstance(repeated, LoopFailure):
            raise repeated
        poses.append(shown(repeated))
    return poses


def differentiated(
    run: "LoopModel", parameters: Array, directions: Array
) -> tuple[ClosedLoopRun, Array]:
    """Return a run of the model with sensitivities, and derivatives (N, 6, k) along directions.

    directions (N, n, k): directions of the commands, see `LoopModel.along`. The model is simulated
    several times if one run has no room for all of them.
    """
    most = most_directions(run.moving(parameters, run.robot)[0], run.groups)
    parts = np.split(directions, range(most, directions.shape[2], most), axis=2)
    runs = [run.along(parameters, part) for part in parts]
    slopes = [one.command_sensitivity for one in runs if one.command_sensitivity is not None]
    empty = np.zeros((*run.measured.shape, 0))
    return runs[0], np.concatenate([empty, *slopes], axis=2)
