"""A study from its first to its last row: what is not done yet is computed, kept at once, and tabulated at the end."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from identify.errors import StudyInterrupted
from identify.progress import Progress
from identify.runtime import honoured, raise_noted
from identify.studies.design import Batches, Design, Finished, Setup, compute, prepare
from identify.studies.store import TABLE, VIEW, Journal, open_folder, resolved
from identify.studies.study_file import Study
from identify.studies.table import tidy_table, write_table, write_view

Executor = Callable[[Setup, Batches], Iterator[list[Finished]]]
"""Computes batches until there are none left, and yields them as they are done, in any order."""

Workers = Callable[[], AbstractContextManager[Executor]]
"""Starts what computes, for as long as the context lasts."""


@dataclass(frozen=True)
class Outcome:
    """A study that is done: its table, how many rows it has, how many of them were found done, and how many failed.

    beyond: rows that its folder keeps of repeats which it no longer has.
    """

    frame: pd.DataFrame
    rows: int
    found: int
    failed: int
    beyond: int

    @property
    def first_error(self) -> str:
        """The first failure in words; empty where there is none."""
        bad = self.frame[self.frame["error"] != ""]
        return f"row {bad['row'].iloc[0]}: {bad['error'].iloc[0]}" if len(bad) else ""


@contextmanager
def in_this_process() -> Iterator[Executor]:
    """Workers: none but this process, one row after the other."""
    yield _serial


def _serial(setup: Setup, batches: Batches) -> Iterator[list[Finished]]:
    while cases := batches.take(workers=1):
        finished = compute(setup, cases)
        batches.learn(finished)
        yield finished


def run_study(study: Study, folder: Path, progress: Progress, workers: Workers = in_this_process) -> Outcome:
    """Run a study in its folder, or go on with it there; the same study gives the same figures whatever the workers.

    Raises:
        StudyError: see :func:`identify.studies.design.prepare` and :func:`identify.studies.store.open_folder`; the disk
            is full; the workers are lost. Finished rows are kept, and the same call goes on from there.
        StudyInterrupted: Ctrl-C, likewise.
    """
    setup = prepare(study)
    entry, design = resolved(study, setup), Design(study)
    with open_folder(folder, entry, len(design)) as journal:
        found = int(journal.finished.sum())
        try:
            with honoured():
                _compute_pending(study.name, setup, design, journal, progress, workers)
        except KeyboardInterrupt:
            done = sum(1 for _ in journal.rows())  # it may have come while some were being noted
            raise StudyInterrupted(f"stopped: {done} of {len(design)} rows are done and kept") from None
        frame = tidy_table(study, journal.rows())
        write_table(folder / TABLE, frame, entry)
        write_view(folder / VIEW, frame, study)
    return Outcome(frame, len(design), found, int((frame["error"] != "").sum()), journal.beyond)


def _compute_pending(
    name: str, setup: Setup, design: Design, journal: Journal, progress: Progress, workers: Workers
) -> None:
    left = len(design) - int(journal.finished.sum())
    if not left:
        return
    batches = Batches((design.case(number) for number in journal.pending()), left)
    raise_noted()
    with workers() as execute, progress.stage(f"rows of {name}", left) as advance:
        for finished in execute(setup, batches):
            journal.append(finished)
            advance(len(finished))
