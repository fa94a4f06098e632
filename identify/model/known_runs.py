"""Latest runs of a model, so that repeated parameters need no further simulation."""

from collections.abc import Callable

from dynamics.closed_loop import ClosedLoopRun
from identify.arrays import Array

Simulate = Callable[[Array, bool], ClosedLoopRun]
"""Function (parameters (p,), with sensitivities) -> run."""

MOST = 4
"""Number of runs without sensitivities that are kept.

A search compares its starts twice, and has up to three starts.
"""


class KnownRuns:
    """Latest runs of a model by their parameters (p,).

    Of runs with sensitivities, which are large, only the latest is kept.
    """

    def __init__(self) -> None:
        self._runs: dict[bytes, ClosedLoopRun] = {}
        self._differentiated: tuple[bytes, ClosedLoopRun] | None = None

    def latest(self, parameters: Array, sensitivities: bool, simulate: Simulate) -> ClosedLoopRun:
        """Return the run with some parameters. If it is not known, it is simulated.

        A known run with sensitivities is also returned if none are asked for, because its poses
        are the same.
        """
        given = parameters.tobytes()
        if self._differentiated is not None and self._differentiated[0] == given:
            return self._differentiated[1]
        if sensitivities or given not in self._runs:
            run = simulate(parameters, sensitivities)
            self.add(parameters, run)
            return run
        return self._runs[given]

    def add(self, parameters: Array, run: ClosedLoopRun) -> None:
        """Keep a run, and forget the oldest one if there are too many."""
        given = parameters.tobytes()  # a copy, because the caller can change the array
        if run.pose_sensitivity is not None:
            self._differentiated = given, run
            return
        self._runs[given] = run
        while len(self._runs) > MOST:
            del self._runs[next(iter(self._runs))]

    def update(self, other: "KnownRuns") -> None:
        """Add the runs of another model that moves in the same way."""
        self._runs |= other._runs
        self._differentiated = other._differentiated or self._differentiated

    def clear(self) -> None:
        """Forget all runs."""
        self._runs.clear()
        self._differentiated = None
