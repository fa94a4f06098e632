"""Batches of a study on processes of this machine.

Each process is connected to the main process by a pipe. The pipe has no name, address or file, so
other users cannot reach it. A process gets its next batch when the rows of the batch before are on
the disk. If a process dies, a new process replaces it. The rows of its batch are computed again at
the end, each alone. If a process dies again during such a row, the row gets an error.

`concurrent.futures.ProcessPoolExecutor` is not used. If one process dies, that executor ends all
processes and does not report the rows of the dead process. If the main process is killed, its
processes wait forever.
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
"""Start method of the processes, by which they inherit neither threads nor locks."""

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
"""Variables that limit a process to one thread, because there are as many processes as cores.

They are set before a process loads its libraries.
"""

MEMORY_SHARE = 0.95
"""Memory limit of a process, as a part of the machine's memory divided by the processes."""

LOOK_S = 1.0
"""Interval at which the memory of the processes is checked, s."""

STILLBORN = 3
"""Number of consecutive processes that die before they are ready at which the study fails."""

END_S = 10.0
"""Longest time to wait for the end of a killed process, s."""


class ProcessExecutor:
    """Executor of a study's batches on a number of processes, each replaced when it dies."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._workers: list[_Worker] = []
        self._stillborn = 0
        self._looked = time.monotonic()

    def __call__(self, shared: Shared, batches: Batches) -> Iterator[list[Finished]]:
        """Yield batches in the order in which they finish.

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
            # After an error, processes can still compute rows that nobody will read.
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
                f"{error.strerror}; use fewer processes (--workers)"
            ) from error

    def _hand_out(self, shared: Shared, batches: Batches, suspects: Suspects) -> bool:
        """Give each idle process a batch. Suspect rows come last, one at a time.

        Returns False at the end.
        """
        ready = [worker for worker in self._workers if worker.ready]
        for worker in ready:
            if not worker.cases:
                worker.give(shared, batches.take(self._count))
        # A suspect row is computed alone, so that a second death is certainly its fault.
        if ready and not any(worker.cases for worker in ready):
            ready[0].give(shared, suspects.take())
        return not ready or any(worker.cases for worker in ready)

    def _heard(self) -> list["_Worker"]:
        """Return the processes that have become ready, have finished a batch or have died.

        Waits at most LOOK_S, and also checks the memory of all processes.
        """
        if time.monotonic() > self._looked + LOOK_S:
            self._looked = time.monotonic()
            limit = MEMORY_SHARE * psutil.virtual_memory().total / self._count
            for worker in self._workers:
                worker.keep_below(limit)
        heard = wait([worker.pipe for worker in self._workers], timeout=LOOK_S)
        return [worker for worker in self._workers if worker.pipe in heard]

    def _take(self, worker: "_Worker", batches: Batches, suspects: Suspects) -> list[Finished]:
        """Return the rows that a process has finished, or its failed rows if it has died.

        The list is empty for a process that has become ready.
        """
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
        """Remove a dead process. A row that has killed two processes is returned as an error."""
        with held():
            self._workers.remove(worker)
            worker.end()
        if not worker.ready:
            self._stillborn += 1
            if self._stillborn >= STILLBORN:
                raise StudyError(
                    f"{STILLBORN} processes died before they computed a row; "
                    "--workers 0 computes in the main process, and may show the reason"
                )
        return suspects.blame(worker.cases, worker.fate)


class _Worker:
    """Process of this machine, and the pipe to it.

    Attributes
    ----------
    ready : bool
        Whether the process has loaded its libraries.
    cases : list of Case
        Rows that the process computes now.
    fate : str
        Text for an error message about the end of the process.
    pipe : Connection
        Main process's end of the pipe.
    """

    def __init__(self) -> None:
        self.ready = False
        self.cases: list[Case] = []
        self.fate = "died"
        self.pipe, theirs = SPAWN.Pipe()
        self._process = SPAWN.Process(target=work, args=(theirs,), daemon=True)
        # The tracker is started before the block, because its start would unblock Ctrl-C.
        resource_tracker.ensure_running()
        with _one_thread_each(), deaf_offspring():
            self._process.start()
        theirs.close()

    def give(self, shared: Shared, cases: list[Case]) -> None:
        """Send rows to compute, unless the list is empty."""
        self.cases = cases
        if cases:
            # OSError means that the process has died, which `receive` will report.
            with suppress(OSError):
                self.pipe.send((shared, cases))

    def receive(self) -> list[Finished]:
        """Return finished rows, or an empty list if the process has become ready.

        Raises EOFError or OSError if the process has died.
        """
        finished: list[Finished] = self.pipe.recv()
        self.ready = True
        self.cases = []
        return finished

    def keep_below(self, limit: float) -> None:
        """Kill the process if it uses more memory than the limit, bytes."""
        with suppress(psutil.Error):
            if psutil.Process(self._process.pid).memory_info().rss > limit:
                self.fate = f"took more than {limit / GB:.3g} GB of memory"
                self._process.kill()

    def end(self) -> None:
        """Kill the process."""
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
    """Set the environment so that processes started in the block use one thread each."""
    before = {name: os.environ[name] for name in THREADS if name in os.environ}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name in THREADS:
            del os.environ[name]
        os.environ.update(before)
