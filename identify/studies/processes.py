"""The batches of a study on processes of this machine, which no other user can reach.

Each process has a pipe of its own to this one, without name or address, and no file. It gets a
batch, and the next one when what it found is on the disk. Where a process dies, another takes its
place, and the rows of its batch are computed again when all others are done, each alone. A row that
then ends its process again is an error of this row.

`concurrent.futures.ProcessPoolExecutor` ends all processes where one dies, does not say which rows
that one had, and lets its processes wait without end where this one is killed.
"""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection, wait

import psutil

from identify.errors import StudyError
from identify.runtime import deaf_offspring, end_with_parent, held
from identify.studies.design import Case, Finished, Setup
from identify.studies.memory import GB
from identify.studies.runner import Batches, Suspects, compute

SPAWN = get_context("spawn")
"""A process begins anew: it inherits no threads, and no locks that they hold."""

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
"""One thread a process, set before the libraries are loaded: there are as many as cores."""

MEMORY_SHARE = 0.95
"""How much of its share of the memory a process may take: it ends before the machine does."""

LOOK_S = 1.0
"""How often the memory of the processes is looked at, seconds."""

STILLBORN = 3
"""How many processes may die one after the other before they are ready."""

END_S = 10.0
"""How long a killed process may take to end, seconds."""


class ProcessExecutor:
    """Computes the batches of a study on so many processes, each replaced when it dies."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._workers: list[_Worker] = []
        self._stillborn = 0
        self._looked = time.monotonic()

    def __call__(self, setup: Setup, batches: Batches) -> Iterator[list[Finished]]:
        """Yield batches as they are done.

        Raises StudyError: processes cannot be started, or die before they compute anything.
        """
        suspects = Suspects()
        try:
            self._start_missing()
            while self._hand_out(setup, batches, suspects):
                for worker in self._heard():
                    if finished := self._take(worker, batches, suspects):
                        yield finished
                self._start_missing()
        finally:
            if any(worker.cases for worker in self._workers):  # nobody waits for it any more
                self.close()

    def close(self) -> None:
        """End all processes, also in the middle of a row."""
        with held():
            for worker in self._workers:
                worker.end()
            self._workers.clear()

    def _start_missing(self) -> None:
        try:
            while len(self._workers) < self._count:
                with held():
                    self._workers.append(_Worker())
        except OSError as error:
            raise StudyError(
                f"process {len(self._workers) + 1} of {self._count} cannot be started: "
                f"{error.strerror}; name fewer with --workers"
            ) from error

    def _hand_out(self, setup: Setup, batches: Batches, suspects: Suspects) -> bool:
        """Give each idle process a batch, and suspects last, one at a time. False at the end."""
        ready = [worker for worker in self._workers if worker.ready]
        for worker in ready:
            if not worker.cases:
                worker.give(setup, batches.take(self._count))
        if ready and not any(worker.cases for worker in ready):
            ready[0].give(setup, suspects.take())
        return not ready or any(worker.cases for worker in ready)

    def _heard(self) -> list["_Worker"]:
        """Processes that are ready, have found something or have died, as far as there are any."""
        if time.monotonic() > self._looked + LOOK_S:
            self._looked = time.monotonic()
            limit = MEMORY_SHARE * psutil.virtual_memory().total / self._count
            for worker in self._workers:
                worker.keep_below(limit)
        heard = wait([worker.pipe for worker in self._workers], timeout=LOOK_S)
        return [worker for worker in self._workers if worker.pipe in heard]

    def _take(self, worker: "_Worker", batches: Batches, suspects: Suspects) -> list[Finished]:
        """What a process has found; nothing where it has become ready, or has died."""
        cases = worker.cases
        try:
            finished = worker.receive()
        except (EOFError, OSError):
            return self._bury(worker, suspects)
        self._stillborn = 0
        if cases:
            batches.learn(finished)
        return finished

    def _bury(self, worker: "_Worker", suspects: Suspects) -> list[Finished]:
        """Make room for another process; the rows that were its second victim are errors."""
        with held():
            self._workers.remove(worker)
            worker.end()
        if not worker.ready:
            self._stillborn += 1
            if self._stillborn >= STILLBORN:
                raise StudyError(
                    f"{STILLBORN} processes died before they computed a row; "
                    "--workers 0 computes in this one, and may show why"
                )
        return suspects.blame(worker.cases, worker.fate)


class _Worker:
    """A process and the pipe to it.

    ready: it has loaded its libraries. cases: the rows that it computes. fate: how it ends.
    """

    def __init__(self) -> None:
        self.ready = False
        self.cases: list[Case] = []
        self.fate = "died"
        self.pipe, theirs = SPAWN.Pipe()
        self._process = SPAWN.Process(target=_work, args=(theirs,), daemon=True)
        # The tracker is started outside the block, where it would unblock Ctrl-C.
        resource_tracker.ensure_running()
        with _one_thread_each(), deaf_offspring():
            self._process.start()
        theirs.close()

    def give(self, setup: Setup, cases: list[Case]) -> None:
        """Have it compute rows; none are no work."""
        self.cases = cases
        if cases:
            with suppress(OSError):  # it has died, which is seen when it is heard
                self.pipe.send((setup, cases))

    def receive(self) -> list[Finished]:
        """What it has found; nothing when it becomes ready. Raises EOFError or OSError: it died."""
        finished: list[Finished] = self.pipe.recv()
        self.ready = True
        self.cases = []
        return finished

    def keep_below(self, limit: float) -> None:
        """End it where it takes more memory than the limit, in bytes."""
        with suppress(psutil.Error):
            if psutil.Process(self._process.pid).memory_info().rss > limit:
                self.fate = f"took more than {limit / GB:.3g} GB of memory"
                self._process.kill()

    def end(self) -> None:
        """End it, whatever it does."""
        self.pipe.close()
        self._process.kill()
        self._process.join(END_S)


@contextmanager
def local_processes(count: int) -> Iterator[ProcessExecutor]:
    """Workers: so many new processes on this machine."""
    executor = ProcessExecutor(count)
    try:
        yield executor
    finally:
        executor.close()


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Environment of a process that begins in the block."""
    before = {name: os.environ[name] for name in THREADS if name in os.environ}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name in THREADS:
            del os.environ[name]
        os.environ.update(before)


def _work(pipe: Connection) -> None:
    """Compute batches in a process of its own until the pipe closes."""
    end_with_parent()
    import cv2

    cv2.setNumThreads(1)
    with suppress(EOFError, OSError, KeyboardInterrupt):
        pipe.send([])
        while True:
            pipe.send(compute(*pipe.recv()))
