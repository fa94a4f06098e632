"""Batches of a study on processes of this machine, which no other user can reach.

Each process is joined to this one by a pipe of its own, which has no name, address or file. It gets
a batch, and the next one when the rows it found are on the disk. If a process dies, another takes
its place. The rows of its batch are computed again when all others are done, each alone. A row that
then ends its process again becomes an error of this row.

`concurrent.futures.ProcessPoolExecutor` is not used. If one process dies, it ends all of them and
does not say which rows that one had. If this process is killed, its processes wait without end.
"""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import wait

import psutil

from identify.errors import StudyError
from identify.runtime import deaf_offspring, held
from identify.studies.memory import GB
from identify.studies.runner import Batches, Suspects
from identify.studies.study_design import Case, Finished, Shared
from identify.studies.worker import work

SPAWN = get_context("spawn")
"""Way to start processes anew, so that they inherit neither threads nor the locks these hold."""

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
"""Variables that limit a process to one thread, set before it loads its libraries.

There are as many processes as cores.
"""

MEMORY_SHARE = 0.95
"""Part of its share of the memory that a process may take. It ends before the machine does."""

LOOK_S = 1.0
"""Interval at which the memory of the processes is checked, s."""

STILLBORN = 3
"""Number of processes that may die one after the other before they are ready."""

END_S = 10.0
"""Longest time that a killed process may take to end, s."""


class ProcessExecutor:
    """Executor of a study's batches on a number of processes, each replaced when it dies."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._workers: list[_Worker] = []
        self._stillborn = 0
        self._looked = time.monotonic()

    def __call__(self, shared: Shared, batches: Batches) -> Iterator[list[Finished]]:
        """Yield batches as they are done.

        Raises
        ------
        StudyError
            Processes cannot be started, or die before they compute anything.
        """
        suspects = Suspects()
        try:
            self._start_missing()
            while self._hand_out(shared, batches, suspects):
                for worker in self._heard():
                    if finished := self._take(worker, batches, suspects):
                        yield finished
                self._start_missing()
        finally:
            # Nobody waits for the rows of a process that still computes, so it ends.
            if any(worker.cases for worker in self._workers):
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

    def _hand_out(self, shared: Shared, batches: Batches, suspects: Suspects) -> bool:
        """Give each idle process a batch, and suspects last, one at a time.

        Returns False at the end.
        """
        ready = [worker for worker in self._workers if worker.ready]
        for worker in ready:
            if not worker.cases:
                worker.give(shared, batches.take(self._count))
        # Nothing else runs beside a suspect, so that a second death is its own fault.
        if ready and not any(worker.cases for worker in ready):
            ready[0].give(shared, suspects.take())
        return not ready or any(worker.cases for worker in ready)

    def _heard(self) -> list["_Worker"]:
        """Return the processes that are ready, have found something or have died.

        It waits LOOK_S at most, and also checks the memory of all processes.
        """
        if time.monotonic() > self._looked + LOOK_S:
            self._looked = time.monotonic()
            limit = MEMORY_SHARE * psutil.virtual_memory().total / self._count
            for worker in self._workers:
                worker.keep_below(limit)
        heard = wait([worker.pipe for worker in self._workers], timeout=LOOK_S)
        return [worker for worker in self._workers if worker.pipe in heard]

    def _take(self, worker: "_Worker", batches: Batches, suspects: Suspects) -> list[Finished]:
        """Return what a process has found; nothing if it has become ready, or has died."""
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
        """Remove a dead process. Rows that have now killed two processes are returned as errors."""
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
    """Process of this machine, and the pipe to it.

    Attributes
    ----------
    ready : bool
        Whether the process has loaded its libraries.
    cases : list of Case
        Rows that it computes now.
    fate : str
        Words for its end in an error message.
    pipe : Connection
        This side of the pipe.
    """

    def __init__(self) -> None:
        self.ready = False
        self.cases: list[Case] = []
        self.fate = "died"
        self.pipe, theirs = SPAWN.Pipe()
        self._process = SPAWN.Process(target=work, args=(theirs,), daemon=True)
        # The tracker is started outside the block, where it would unblock Ctrl-C.
        resource_tracker.ensure_running()
        with _one_thread_each(), deaf_offspring():
            self._process.start()
        theirs.close()

    def give(self, shared: Shared, cases: list[Case]) -> None:
        """Hand over rows to compute. An empty list is no work."""
        self.cases = cases
        if cases:
            # OSError means that it has died, which is seen when it is heard.
            with suppress(OSError):
                self.pipe.send((shared, cases))

    def receive(self) -> list[Finished]:
        """Return the rows found, or none when the process becomes ready.

        Raises EOFError or OSError if it has died.
        """
        finished: list[Finished] = self.pipe.recv()
        self.ready = True
        self.cases = []
        return finished

    def keep_below(self, limit: float) -> None:
        """End the process if it takes more memory than the limit, bytes."""
        with suppress(psutil.Error):
            if psutil.Process(self._process.pid).memory_info().rss > limit:
                self.fate = f"took more than {limit / GB:.3g} GB of memory"
                self._process.kill()

    def end(self) -> None:
        """End the process, whatever it does."""
        self.pipe.close()
        self._process.kill()
        self._process.join(END_S)


@contextmanager
def local_processes(count: int) -> Iterator[ProcessExecutor]:
    """Provide a number of new processes on this machine as workers."""
    executor = ProcessExecutor(count)
    try:
        yield executor
    finally:
        executor.close()


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Set the environment of the processes that begin in the block to one thread each."""
    before = {name: os.environ[name] for name in THREADS if name in os.environ}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name in THREADS:
            del os.environ[name]
        os.environ.update(before)
