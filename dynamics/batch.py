"""Many closed-loop runs at once, on all cores: the compiled loop runs without Python's lock."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from dynamics.arrays import Shape, check_type, floats, whole
from dynamics.closed_loop import ClosedLoopRun, LoopSettings, Reference, simulate
from dynamics.errors import SimulationError
from dynamics.loop_types import PARAMETER_COUNT
from dynamics.robot import Robot


def simulate_batch(
    robot: Robot,
    parameters: np.ndarray,
    references: Reference | Sequence[Reference],
    settings: LoopSettings,
    *,
    sensitivities: bool = False,
    workers: int | None = None,
) -> list[ClosedLoopRun]:
    """Run the closed loop with the ideal sensor for N parameter vectors (N, 67), N references, or both in pairs.

    A single vector (67,) or a single reference serves all runs. Results are those of `simulate`, in order, and do not
    depend on `workers` (default: one a core). Raises what `simulate` raises, for the first run that fails.
    """
    threads = (os.cpu_count() or 1) if workers is None else whole("workers", workers, SimulationError, least=1)
    shapes: tuple[Shape, Shape] = (PARAMETER_COUNT,), ("N", PARAMETER_COUNT)
    vectors = np.atleast_2d(floats("loop parameters", parameters, *shapes, error=SimulationError, finite=False))
    given = _listed(references)
    count = max(len(vectors), len(given))
    if not (len(vectors) in (1, count) and len(given) in (1, count)):
        raise SimulationError(f"{len(vectors)} parameter vectors and {len(given)} references do not pair up")

    def one(index: int) -> ClosedLoopRun:
        vector, reference = vectors[index % len(vectors)], given[index % len(given)]
        return simulate(robot, vector, reference, settings, sensitivities=sensitivities)

    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(one, range(count)))


def _listed(references: Reference | Sequence[Reference]) -> list[Reference]:
    if isinstance(references, Reference):
        return [references]
    check_type("references", references, Sequence, SimulationError)
    for index, reference in enumerate(references):
        check_type(f"references[{index}]", reference, Reference, SimulationError)
    return list(references)
