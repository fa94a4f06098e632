"""Commands and times of a run whose frames are at any times."""

import numpy as np

from dynamics.checks import floats
from dynamics.errors import SimulationError


def checked_times(times: object, frames: int) -> np.ndarray:
    """Times (frames,) of frames, s, which increase. Raises SimulationError."""
    checked = floats("times", times, (frames,), error=SimulationError)
    back = np.flatnonzero(np.diff(checked) <= 0)
    if len(back):
        first = int(back[0])
        raise SimulationError(
            f"times must increase, but frame {first + 1} is at {checked[first + 1]:.9g} s and "
            f"frame {first} at {checked[first]:.9g} s"
        )
    return checked


def held_commands(
    commands: object, shape: tuple[int, int], before: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Commands (frames, n) with rows of NaN replaced by the command before, and which are given.

    Raises SimulationError for a row of which only a part is NaN.
    """
    given = floats("commands", commands, shape, error=SimulationError, finite=False)
    missing = np.isnan(given)
    written = ~missing.all(axis=1)
    if not np.isfinite(given[written]).all():
        frame = int(np.flatnonzero(written & ~np.isfinite(given).all(axis=1))[0])
        raise SimulationError(
            f"commands of frame {frame} are {given[frame]}: a row is finite, or NaN as a whole"
        )
    newest = np.maximum.accumulate(np.where(written, np.arange(len(given)), -1))
    held = np.where((newest >= 0)[:, None], given[newest], before)
    return np.ascontiguousarray(held), written
