"""The rows of a study, one by one, and their computation in batches; a large grid takes no memory.

The rows of a study, one by one: what holds in each. None is kept, so that a large grid takes no memory.
Rows are numbered repeat by repeat, and within a repeat point by point, the last factor fastest. The seed of row n is
the n-th child that ``numpy.random.SeedSequence(seed).spawn`` gives. So neither the machines, nor the order of work, nor
further repeats change the numbers of a row; nor do further points of a sample, as long as there are no repeats.
"""

import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any

import numpy as np

from identify.errors import ScenarioError, StudyError
from identify.experiment.sensor_in_loop import with_renderer
from identify.random_streams import SAMPLED_POINTS, child, mixed_generator
from identify.runtime import raise_noted
from identify.scenario import Scenario, load_scenario
from identify.studies.keys import (
    check,
    check_ever_read,
    check_law_names,
    check_read_here,
    is_integer,
    options_in,
    overrides,
)
from identify.studies.rows.kinds import check_kind, kind_reads, options_model, row_function
from identify.studies.study_file import Range, Study


@dataclass(frozen=True)
class Case:
    """One row that is to be computed: its number, its repeat, and the value of each factor by dotted path."""

    number: int
    repeat: int
    factors: dict[str, Any]


@dataclass(frozen=True)
class Setup:
    """What all rows of a study share: kind, scenario with the changes of all rows, options, seed."""

    kind: str
    scenario: Scenario
    options: dict[str, Any]
    seed: int

    def row_scenario(self, case: Case) -> Scenario:
        """The scenario of a row. Raises ScenarioError where its factors contradict each other."""
        return self.scenario.with_overrides(overrides(case.factors))

    def row_options(self, case: Case) -> dict[str, Any]:
        """The options of a row."""
        return self.options | options_in(case.factors)

    def row_seed(self, number: int) -> np.random.SeedSequence:
        """The seed of a row."""
        return child(self.seed, number)


class Design:
    """All rows of a study."""

    def __init__(self, study: Study) -> None:
        self._study = study
        self._lists = {path: values for path, values in study.factors.items() if isinstance(values, list)}

    def __len__(self) -> int:
        return self._study.rows

    def case(self, number: int) -> Case:
        """The row of a number."""
        repeat, point = divmod(number, self._study.points)
        return Case(number, repeat, self._drawn(point) if self._study.sample else self._on_grid(point))

    def _on_grid(self, point: int) -> dict[str, Any]:
        places = {}
        for path, values in reversed(self._lists.items()):
            point, places[path] = divmod(point, len(values))
        return {path: values[places[path]] for path, values in self._lists.items()}

    def _drawn(self, point: int) -> dict[str, Any]:
        shares = dict(zip(self._study.factors, self._shares[point], strict=True))
        return {path: self._value(path, share) for path, share in shares.items()}

    @cached_property
    def _shares(self) -> np.ndarray:
        """Where each point (points, factors) lies between the ends of each factor, in [0, 1)."""
        rng = mixed_generator(SAMPLED_POINTS, self._study.seed)
        return rng.random((self._study.points, len(self._study.factors)))

    def _value(self, path: str, share: float) -> Any:
        values = self._study.factors[path]
        if isinstance(values, list):
            return values[int(share * len(values))]
        if is_integer(path, options_model(self._study.kind)):
            return int(values.low) + int(share * (values.high - values.low + 1))
        if values.scale == "log":
            return float(values.low * (values.high / values.low) ** share)
        return float(values.low + (values.high - values.low) * share)


def prepare(study: Study) -> Setup:
    """Check a study's keys, values, kind and laws, and load what its rows share.

    The first row is checked as a whole. Values that contradict each other only in other rows are errors of these.

    Raises:
        StudyError: an unknown kind, key, option, or figure or factor of a law, with the valid ones; a wrong value; a
            key that the kind's rows do not read.
        ScenarioError: no such scenario, or changes that contradict it.
    """
    check_kind(study.kind, study.options)
    model = options_model(study.kind)
    for path, value in study.changes.items():
        if path.startswith("options."):
            raise StudyError(f"changes.{path}: what holds in every row stands in [options]")
        check(path, [value], model)
    for path in study.factors:
        if path.startswith("options.") and path.partition(".")[2] in study.options:
            raise StudyError(f"{path} is both a factor and among the options")
    for path, values in study.factors.items():
        check(path, [values.low, values.high] if isinstance(values, Range) else values, model)
        _check_factor(path, values)
    reads = kind_reads(study.kind)
    if reads is not None:
        check_ever_read(study, reads)
    setup = Setup(study.kind, _scenario(study.scenario, overrides(study.changes)), study.options, study.seed)
    first = Design(study).case(0)
    scenario, options = setup.row_scenario(first), setup.row_options(first)
    check_kind(study.kind, options)
    if reads is not None and model is not None:
        check_read_here(study, reads, scenario, model.model_validate(options))
    check_law_names(study)
    return setup


def _scenario(name: str, changes: Mapping[str, Any]) -> Scenario:
    """What draws the images is decided here, once for all machines."""
    try:
        return with_renderer(load_scenario(name).with_overrides(changes))
    except ScenarioError as error:
        raise StudyError(f"scenario of the study: {error}") from error


def _check_factor(path: str, values: list[Any] | Range) -> None:
    if not isinstance(values, list):
        return
    kinds = {"number" if type(value) in (int, float) else type(value).__name__ for value in values}
    if len(kinds) > 1:
        raise StudyError(f"factors.{path} = {values} has values of several kinds: {', '.join(sorted(kinds))}")
    if len({repr(value) for value in values}) < len(values):
        raise StudyError(f"factors.{path} = {values} has a value twice; repeats = N computes every point N times")


# Computing rows: the only part of a study that runs on other processes and machines.


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


# Rows in batches: as many a task as keep a worker busy for a while, so that sending them costs little.


BATCH_SECONDS = 0.25
"""Work in a batch; what is lost at most with each worker when everything is killed at once."""

LARGEST_BATCH = 500


class Batches:
    """Hands out the rows that are still to be done, in batches sized by how long the last ones took."""

    def __init__(self, cases: Iterator[Case], count: int) -> None:
        self._cases, self._left = cases, count
        self._row_seconds = BATCH_SECONDS

    def take(self, workers: int) -> list[Case]:
        """The next batch for one of so many workers; empty when all rows are handed out.

        Towards the end batches become smaller, so that all workers end together.
        """
        fair = max(1, self._left // (4 * workers))
        size = max(1, min(int(BATCH_SECONDS / self._row_seconds), LARGEST_BATCH, fair, self._left))
        batch = list(islice(self._cases, size))
        self._left -= len(batch)
        return batch

    def learn(self, finished: list[Finished]) -> None:
        """Take from a finished batch how long rows take."""
        mean = sum(row.seconds for row in finished) / len(finished)
        self._row_seconds = max(0.5 * (self._row_seconds + mean), 1e-6)
