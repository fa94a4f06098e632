"""Computing rows: the only part of a study that runs on other processes and machines."""

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass

from identify.interrupts import raise_noted
from identify.studies.design import Case, Setup
from identify.studies.rows.kinds import row_function

FIRST = ("row", "repeat", "seed_entropy", "seed_spawn_key")
LAST = ("seconds", "error")
"""Columns of a study's table before its factors and behind its figures."""


@dataclass(frozen=True)
class Finished:
    """A row that is done: its figures, or in one line why there are none; the seconds it took."""

    number: int
    figures: dict[str, float]
    seconds: float
    error: str = ""


def compute(setup: Setup, cases: list[Case]) -> list[Finished]:
    """Compute rows one after the other; what goes wrong in one is noted there, and the others go on."""
    return [_compute(setup, case) for case in cases]


def _compute(setup: Setup, case: Case) -> Finished:
    start = time.perf_counter()
    try:
        figures = _checked(
            row_function(setup.kind)(setup.row_scenario(case), setup.row_seed(case.number), setup.row_options(case)),
            {*FIRST, *case.factors, *LAST},
        )
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # also sys.exit() ends the row and not the study
        raise_noted()
        text = " ".join(f"{type(error).__name__}: {error}".split())
        return Finished(case.number, {}, time.perf_counter() - start, text)
    return Finished(case.number, figures, time.perf_counter() - start)


def _checked(figures: Mapping[str, float], taken: set[str]) -> dict[str, float]:
    """Figures as plain numbers; one that is none is an error of the row, so that no average hides it, and so is one
    that no column of the table is left for."""
    if hidden := sorted(taken & set(figures)):
        raise ValueError(f"a figure must not be called {hidden[0]!r}: the table has a column of this name")
    plain = {name: float(value) for name, value in figures.items()}
    for name, value in plain.items():
        if not math.isfinite(value):
            raise ArithmeticError(f"{name} is {value}")
    return plain
