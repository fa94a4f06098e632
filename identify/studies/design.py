"""The rows of a study, one by one: what holds in each. None is kept, so that a large grid takes no memory.

Rows are numbered repeat by repeat, and within a repeat point by point, the last factor fastest. The seed of row n is
the n-th child that ``numpy.random.SeedSequence(seed).spawn`` gives. So neither the machines, nor the order of work, nor
further repeats change the numbers of a row; nor do further points of a sample, as long as there are no repeats.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from identify.errors import ScenarioError, StudyError
from identify.experiment.sensor_in_loop import with_renderer
from identify.random_streams import SAMPLED_POINTS, child, mixed_generator
from identify.scenario import Scenario, load_scenario
from identify.studies.keys import check, is_integer, options_in, overrides
from identify.studies.law_names import check_law_names
from identify.studies.rows.kinds import check_kind, kind_reads, options_model
from identify.studies.study_file import Range, Study
from identify.studies.unread_keys import check_ever_read, check_read_here


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
