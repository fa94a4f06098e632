"""Many closed-loop runs at once, on all cores: the compiled loop runs without Python's lock."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar, cast

import numpy as np

from dynamics.checks import Shape, check_type, floats, whole
from dynamics.closed_loop.problem import PARAMETER_COUNT
from dynamics.closed_loop.simulate import ClosedLoopRun, LoopSettings, Reference, StartState, simulate
from dynamics.errors import SimulationError
from dynamics.robot import Robot

Item = TypeVar("Item", Reference, StartState)


def simulate_batch(
    robot: Robot,
    parameters: np.ndarray,
    references: Reference | Sequence[Reference],
    settings: LoopSettings,
    *,
    starts: StartState | Sequence[StartState] | None = None,
    sensitivities: bool = False,
    start_sensitivities: bool = False,
    workers: int | None = None,
) -> list[ClosedLoopRun]:
    """Run the closed loop with the ideal sensor for N parameter vectors (N, 67), references, starts, or them in pairs.

    A single vector (67,), reference or start serves all runs. Results are those of `simulate`, in order, and do not
    depend on `workers` (default: one a core). Raises what `simulate` raises, for the first run that fails.
    """
    threads = len(os.sched_getaffinity(0)) if workers is None else whole("workers", workers, SimulationError, least=1)
    shapes: tuple[Shape, Shape] = (PARAMETER_COUNT,), ("N", PARAMETER_COUNT)
    vectors = np.atleast_2d(floats("loop parameters", parameters, *shapes, error=SimulationError, finite=False))
    given = _listed("references", references, Reference)
    begins: Sequence[StartState | None] = [None] if starts is None else _listed("starts", starts, StartState)
    lengths = (len(vectors), len(given), len(begins))
    count = max(lengths)
    if not set(lengths) <= {1, count}:
        of_starts = "" if starts is None else f" and {len(begins)} start states"
        raise SimulationError(f"{len(vectors)} parameter vectors and {len(given)} references{of_starts} do not pair up")

    def one(index: int) -> ClosedLoopRun:
        return simulate(
            robot,
            vectors[index % len(vectors)],
            given[index % len(given)],
            settings,
            start=begins[index % len(begins)],
            sensitivities=sensitivities,
            start_sensitivities=start_sensitivities,
        )

    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(one, range(count)))


def _listed(name: str, given: Item | Sequence[Item], kind: type[Item]) -> list[Item]:
    if isinstance(given, kind):
        return [given]
    check_type(name, given, Sequence, SimulationError)
    items = list(cast(Sequence[Item], given))
    for index, item in enumerate(items):
        check_type(f"{name}[{index}]", item, kind, SimulationError)
    return items
