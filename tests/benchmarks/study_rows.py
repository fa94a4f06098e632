"""Rows of studies for the benchmarks."""

import time
from collections.abc import Mapping

import numpy as np

from identify.scenario import Scenario

EMPTY = "tests.benchmarks.study_rows:empty"


def empty(scenario: Scenario, seed: np.random.SeedSequence, options: Mapping[str, object]) -> dict[str, float]:
    """A row that does almost nothing, and says in s how long it took over it."""
    start = time.perf_counter()
    draws = np.random.default_rng(seed).normal(size=1000)
    return {"mean_um": float(draws.mean()), "row_s": time.perf_counter() - start}
