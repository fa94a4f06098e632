"""A study from its first to its last row.

Rows that are not done yet are computed and kept at once, and all are tabulated at the end.
"""

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import pandas as pd

from cmmsim.allowed_plugins import allow_plugin
from identify.errors import StudyInterrupted
from identify.progress import Progress
from identify.runtime import honoured, raise_noted
from identify.studies.rows import find_kind
from identify.studies.store import VIEW, Journal, open_folder, resolved
from identify.studies.study_design import Case, Design, Finished, Shared, prepare
from identify.studies.study_file import Study
from identify.studies.table import FIRST, LAST, TABLE, tidy_table, write_table, write_view


@dataclass(frozen=True)
class Outcome:
    """A study that is done: its table, and how many of its rows were found done.

    beyond: rows that its folder keeps of repeats which it no longer has.
    """

    frame: pd.DataFrame
    found: int
    beyond: int

    @property
    def rows(self) -> int:
        """How many rows it has."""
        return len(self.frame)

    @property
    def failures(self) -> list[str]:
        """The rows that failed, each in words."""
        bad = self.frame[self.frame["error"] != ""]
        return [f"row {row}: {error}" for row, error in zip(bad["row"], bad["error"], strict=True)]


Executor = Callable[[Shared, "Batches"], Iterator[list[Finished]]]
"""Computes batches until there are none left, and yields them as they are done, in any order."""

Workers = Callable[[], AbstractContextManager[Executor]]
"""Starts what computes, for as long as the context lasts."""


@contextmanager
def in_this_process() -> Iterator[Executor]:
    """Workers: none but this process, one row after the other."""
    yield _serial


def _serial(shared: Shared, batches: "Batches") -> Iterator[list[Finished]]:
    while cases := batches.take(workers=1):
        finished = compute(shared, cases)
        batches.learn(finished)
        yield finished


SoFar = Callable[[pd.DataFrame], object]
"""Gets the table of what is done so far."""

SO_FAR_S, SO_FAR_SHARE = 30.0, 0.02
"""How often results so far are shown, seconds; and what share of the time that may take."""


def run_study(
    study: Study,
    folder: Path,
    progress: Progress,
    workers: Workers = in_this_process,
    so_far: SoFar = lambda frame: None,
    shared: Shared | None = None,
) -> Outcome:
    """Run a study in its folder, or go on with it there.

    The same study gives the same figures whatever the workers. Finished rows are kept, and the
    same call goes on from there.

    Parameters
    ----------
    study : Study
        The study.
    folder : Path
        Folder of its files.
    progress : Progress
        Where the rows are counted.
    workers : callable
        Starts what computes the rows.
    so_far : callable
        Gets the table of what is done now and then while the study runs.
    shared : Shared, optional
        What the rows share, from `prepare`. The default prepares the study as its file has it.

    Returns
    -------
    Outcome
        The table of all rows.

    Raises
    ------
    StudyError
        The study is not valid (see `identify.studies.study_design.prepare`), the folder is not
        its own (see `identify.studies.store.open_folder`), the disk is full, or the workers are
        lost.
    StudyInterrupted
        Ctrl-C ended it.
    """
    shared = shared or prepare(study)
    entry = resolved(study, shared)
    design = Design(study)
    with open_folder(folder, entry, len(design)) as journal:
        found = int(journal.finished.sum())
        try:
            with honoured():
                shown = _now_and_then(lambda: so_far(tidy_table(study, journal.rows())))
                _compute_pending(study.name, shared, design, journal, progress, workers, shown)
        except KeyboardInterrupt:
            done = sum(1 for _ in journal.rows())  # it may have come while some were being noted
            raise StudyInterrupted(
                f"stopped: {done} of {len(design)} rows are done and kept"
            ) from None
        frame = tidy_table(study, journal.rows())
        write_table(folder / TABLE, frame, entry)
        write_view(folder / VIEW, frame, study)
    return Outcome(frame, found, journal.beyond)


def _now_and_then(show: Callable[[], object]) -> Callable[[], None]:
    """What shows, but not more often than it may."""
    next_time = time.perf_counter() + SO_FAR_S

    def perhaps() -> None:
        nonlocal next_time
        began = time.perf_counter()
        if began < next_time:
            return
        show()
        took = time.perf_counter() - began
        # A table of many rows takes long, and may take no more than its share of the study.
        next_time = began + took + max(SO_FAR_S, took / SO_FAR_SHARE)

    return perhaps


def _compute_pending(
    name: str,
    shared: Shared,
    design: Design,
    journal: Journal,
    progress: Progress,
    workers: Workers,
    shown: Callable[[], None],
) -> None:
    left = len(design) - int(journal.finished.sum())
    if not left:
        return
    batches = Batches((design.case(number) for number in journal.pending()), left)
    raise_noted()
    with workers() as execute, progress.stage(f"rows of {name}", left) as advance:
        for finished in execute(shared, batches):
            journal.append(finished)
            advance(len(finished))
            shown()


BATCH_SECONDS = 0.25
"""Work in a batch, so that sending it costs little; what is lost at most with each worker when
everything is killed.
"""

LARGEST_BATCH = 500


class Batches:
    """Hands out the rows that are still to be done, in batches sized by how long the last ones
    took.
    """

    def __init__(self, cases: Iterator[Case], count: int) -> None:
        self._cases = cases
        self._left = count
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
        # Half of the old value stays, so that one slow batch does not make all others small.
        self._row_seconds = max(0.5 * (self._row_seconds + mean), 1e-6)


class Suspects:
    """Rows whose process died. Each is computed again, alone, and then is an error if its process
    dies again: the first death may be the fault of another row.
    """

    def __init__(self) -> None:
        self._rows: list[Case] = []
        self._deaths: Counter[int] = Counter()

    def take(self) -> list[Case]:
        """A row to be computed while no other is; empty when there is none."""
        return [self._rows.pop()] if self._rows else []

    def blame(self, cases: list[Case], fate: str = "died") -> list[Finished]:
        """Note what became of the process of some rows; one that was alone again, as an error."""
        self._deaths.update(case.number for case in cases)
        if len(cases) == 1 and self._deaths[cases[0].number] > 1:
            error = f"KilledWorker: its process {fate}, and again when it computed this row alone"
            return [Finished(cases[0].number, {}, 0.0, error)]
        self._rows += cases
        return []


def compute(shared: Shared, cases: list[Case]) -> list[Finished]:
    """Compute rows one after the other; what goes wrong in one is noted there, and the others go
    on.

    The only part of a study that runs on other processes and machines.
    """
    # The user allowed these modules to the command, and another process has not heard of it.
    allow_plugin(*shared.plugins)
    return [_compute(shared, case) for case in cases]


def _compute(shared: Shared, case: Case) -> Finished:
    start = time.perf_counter()
    try:
        kind = find_kind(shared.kind)
        options = kind.checked(shared.row_options(case))
        row = kind.compute(shared.row_scenario(case), shared.row_seed(case.number), options)
        figures = _plain(row, {*FIRST, *case.factors, *LAST})
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # also sys.exit() ends the row and not the study
        raise_noted()
        text = " ".join(f"{type(error).__name__}: {error}".split())
        return Finished(case.number, {}, time.perf_counter() - start, text)
    return Finished(case.number, figures, time.perf_counter() - start)


def _plain(figures: Mapping[str, float], taken: set[str]) -> dict[str, float]:
    """Figures as plain numbers; one that is none is an error of the row, so that no average hides
    it, and so is one that no column of the table is left for."""
    if hidden := sorted(taken & set(figures)):
        raise ValueError(
            f"a figure must not be called {hidden[0]!r}: the table has a column of this name"
        )
    plain = {name: float(value) for name, value in figures.items()}
    for name, value in plain.items():
        if not math.isfinite(value):
            raise ArithmeticError(f"{name} is {value}")
    return plain
