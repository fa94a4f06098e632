"""Run of a study from its first to its last row.

Missing rows are computed in batches, and each batch is stored as soon as it finishes. At the end
all rows are tabulated.
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
from identify.runtime import interruptible, raise_interrupt
from identify.studies.rows import find_kind
from identify.studies.store import VIEW, Journal, open_folder, resolved
from identify.studies.study_design import Case, Design, Finished, Shared, prepare
from identify.studies.study_file import Study
from identify.studies.table import FIRST, LAST, TABLE, tidy_table, write_table, write_view


@dataclass(frozen=True)
class Outcome:
    """Finished study.

    frame    Table of all rows.
    found    Number of rows that were finished before this run.
    surplus  Number of stored rows of repeats that the study no longer has.
    """

    frame: pd.DataFrame
    found: int
    surplus: int

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self.frame)

    @property
    def failures(self) -> list[str]:
        """Failed rows, each as a text with its number and error."""
        bad = self.frame[self.frame["error"] != ""]
        return [f"row {row}: {error}" for row, error in zip(bad["row"], bad["error"], strict=True)]


# Function that computes all batches, and yields the rows of each batch when it finishes. It also
# yields empty lists, so that the progress is shown while the first rows take long.
Executor = Callable[[Shared, "Batches"], Iterator[list[Finished]]]
# Function that returns an executor as a context. The workers live as long as the context.
Workers = Callable[[], AbstractContextManager[Executor]]


@contextmanager
def in_this_process() -> Iterator[Executor]:
    """Provide this process as the only worker."""
    yield _serial


def _serial(shared: Shared, batches: "Batches") -> Iterator[list[Finished]]:
    while cases := batches.next_batch(workers=1):
        finished = compute(shared, cases)
        batches.update_row_time(finished)
        yield finished


SoFar = Callable[[pd.DataFrame], object]  # function that gets the table of the rows finished so far
# Shortest interval between tables of finished rows, seconds, and the largest fraction of the time
# that these tables take.
SO_FAR_S, SO_FAR_SHARE = 30.0, 0.02


def run_study(
    study: Study,
    folder: Path,
    progress: Progress,
    workers: Workers = in_this_process,
    so_far: SoFar = lambda frame: None,
    shared: Shared | None = None,
) -> Outcome:
    """Run a study in its folder, or continue it there, and write its table and arrays.

    The figures do not depend on the workers. Finished rows are stored, and the same call continues
    the study.

    folder    Folder of its files.
    progress  Display of the number of finished rows.
    workers   Function that starts the workers.
    so_far    Function that gets the table of finished rows from time to time while the study runs,
              and after Ctrl-C.
    shared    Common data of the rows, from `prepare`. By default it is prepared from the study.

    Returns the table of all rows, failed ones included, with counts. Raises StudyError if the study
    is not valid (see `identify.studies.study_design.prepare`), the folder cannot be used (see
    `identify.studies.store.open_folder`), the disk is full, or the workers are lost. Raises
    StudyInterrupted if Ctrl-C stopped the study.
    """
    shared = shared or prepare(study)
    entry = resolved(study, shared)
    design = Design(study)
    with open_folder(folder, entry, len(design)) as journal:
        found = int(journal.finished.sum())
        try:
            with interruptible():
                show = _rate_limited(lambda: so_far(tidy_table(study, journal.rows())))
                _compute_pending(study.name, shared, design, journal, progress, workers, show)
        except KeyboardInterrupt:
            # The rows are read from the file, because Ctrl-C can interrupt their registration.
            done = list(journal.rows())
            if done:
                so_far(tidy_table(study, done))
            raise StudyInterrupted(
                f"stopped: {len(done)} of {len(design)} rows are done and stored"
            ) from None
        frame = tidy_table(study, journal.rows())
        write_table(folder / TABLE, frame, entry)
        write_view(folder / VIEW, frame, study)
    return Outcome(frame, found, journal.surplus)


def _rate_limited(show: Callable[[], object]) -> Callable[[], None]:
    """Return a function that calls `show` only as often as SO_FAR_S and SO_FAR_SHARE allow."""
    next_time = time.perf_counter() + SO_FAR_S

    def show_if_due() -> None:
        nonlocal next_time
        began = time.perf_counter()
        if began < next_time:
            return
        show()
        took = time.perf_counter() - began
        # A table of many rows takes long, so the fraction of the time for tables is limited.
        next_time = began + took + max(SO_FAR_S, took / SO_FAR_SHARE)

    return show_if_due


def _compute_pending(
    name: str,
    shared: Shared,
    design: Design,
    journal: Journal,
    progress: Progress,
    workers: Workers,
    show: Callable[[], None],
) -> None:
    missing = len(design) - int(journal.finished.sum())
    if not missing:
        return
    batches = Batches((design.case(number) for number in journal.pending()), missing)
    raise_interrupt()
    with workers() as execute, progress.stage(f"rows of {name}", missing) as advance:
        for finished in execute(shared, batches):
            if finished:
                journal.append(finished)
            advance(len(finished))
            if finished:
                show()


# Intended duration of a batch, s. Batches of this duration cost little to send, and little is lost
# if a process is killed. A row that takes longer is a batch by itself.
BATCH_SECONDS = 0.25

LARGEST_BATCH = 500  # largest number of rows in a batch


class Batches:
    """Missing rows of a study, handed out in batches of about the same duration.

    The size of a batch depends on the time per row of earlier batches.
    """

    def __init__(self, cases: Iterator[Case], count: int) -> None:
        self._cases = cases
        self._left = count
        self._row_seconds = BATCH_SECONDS  # so the first batches have one row

    def next_batch(self, workers: int) -> list[Case]:
        """Return the next batch for one of `workers` workers, empty if all rows are handed out.

        Towards the end batches become smaller, so that all workers end together.
        """
        fair = max(1, self._left // (4 * workers))
        size = max(1, min(int(BATCH_SECONDS / self._row_seconds), LARGEST_BATCH, fair, self._left))
        batch = list(islice(self._cases, size))
        self._left -= len(batch)
        return batch

    def update_row_time(self, finished: list[Finished]) -> None:
        """Update the time per row from a finished batch."""
        mean = sum(row.seconds for row in finished) / len(finished)
        # Averaging with the old value limits the effect of one slow batch.
        self._row_seconds = max(0.5 * (self._row_seconds + mean), 1e-6)


class Suspects:
    """Rows of batches whose process died.

    Each row is computed again, alone, because another row of the batch can be the cause. If the
    process dies again during this row, the row gets an error.
    """

    def __init__(self) -> None:
        self._rows: list[Case] = []
        self._deaths: Counter[int] = Counter()

    def next_batch(self) -> list[Case]:
        """Return a list with one row, to be computed alone. It is empty if no row is left."""
        return [self._rows.pop()] if self._rows else []

    def record_death(self, cases: list[Case], end_reason: str = "died") -> list[Finished]:
        """Register the end of a process that computed these rows.

        A row that was computed alone, and whose process ended for the second time, is returned with
        an error. Otherwise the list is empty, and `next_batch` will return the rows.
        """
        self._deaths.update(case.number for case in cases)
        if len(cases) == 1 and self._deaths[cases[0].number] > 1:
            error = (
                f"KilledWorker: its process {end_reason}, and again when it computed this row alone"
            )
            return [Finished(cases[0].number, {}, 0.0, error)]
        self._rows += cases
        return []


def compute(shared: Shared, cases: list[Case]) -> list[Finished]:
    """Compute rows one after the other. An exception in a row does not affect the other rows.

    Other processes and other machines compute rows only by this function.
    """
    # Other processes do not know which modules the user has allowed in the main process.
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
    except BaseException as error:  # sys.exit() in a row must not end the study
        raise_interrupt()
        text = " ".join(f"{type(error).__name__}: {error}".split())
        return Finished(case.number, {}, time.perf_counter() - start, text)
    return Finished(case.number, figures, time.perf_counter() - start)


def _plain(figures: Mapping[str, float], taken: set[str]) -> dict[str, float]:
    """Return figures as plain numbers.

    Raises ArithmeticError for a figure that is not finite, so that no average hides it. Raises
    ValueError for a figure with a name in `taken`, the names of the other columns of the table.
    """
    if hidden := sorted(taken & set(figures)):
        raise ValueError(
            f"a figure must not be called {hidden[0]!r}: the table has a column of this name"
        )
    plain = {name: float(value) for name, value in figures.items()}
    for name, value in plain.items():
        if not math.isfinite(value):
            raise ArithmeticError(f"{name} is {value}")
    return plain
