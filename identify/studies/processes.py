"""Batches of a study on processes of this machine, and a check that they fit into its memory.

Each process is connected to the main process by a pipe. The pipe has no name, address or file, so
other users cannot reach it. A process gets its next batch when the rows of the batch before are on
the disk. If a process dies, a new process replaces it. The rows of the dead process are computed
again at the end, each alone. If a process dies again during such a row, the row gets an error.

`concurrent.futures.ProcessPoolExecutor` is not used. If one process dies, that executor ends all
processes and does not report the rows of the dead process. If the main process is killed, the
processes of that executor wait forever.
"""

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing import current_process, get_context, resource_tracker
from multiprocessing.connection import wait

import psutil

from identify.errors import StudyError
from identify.runtime import delay_interrupts, shield_children
from identify.setup import Setup
from identify.studies.rows import find_kind
from identify.studies.runner import Batches, Suspects
from identify.studies.study_design import Case, Finished, Shared
from identify.studies.study_file import Range, Study
from identify.studies.worker import work

# Factors whose largest values give the longest records and stretches of a path.
LENGTH = ("scenario.excitation.duration_s", "scenario.timing.frame_rate_hz", "options.stretch_s")
PROCESS = 0.5e9  # memory of a process before its first row, bytes

GB = 1e9


def check_memory(study: Study, shared: Shared, workers: int) -> None:
    """Raise StudyError if the longest rows, one per worker, need more memory than is installed."""
    kind = find_kind(study.kind)
    if kind.memory is None:
        return
    longest = {path: _largest(study.factors[path]) for path in LENGTH if path in study.factors}
    case = Case(0, 0, longest)
    options = kind.checked(shared.row_options(case))
    needed = PROCESS + kind.memory(Setup(shared.row_scenario(case)), options)
    installed = psutil.virtual_memory().total
    if workers * needed > installed:
        fit = int(installed // needed)
        raise StudyError(
            f"the longest rows of study {study.name!r} need {needed / GB:.3g} GB each and "
            f"{workers * needed / GB:.3g} GB in {workers} processes, but this machine has "
            f"{installed / GB:.3g} GB: " + (f"--workers {fit} fits" if fit else "shorten its rows")
        )


def _largest(values: list[float] | Range) -> float:
    return values.high if isinstance(values, Range) else max(values)


# Start method with which processes inherit neither threads nor locks.
SPAWN = get_context("spawn")
# Variables that limit a process to one thread, because there are as many processes as cores. They
# are set before a process loads its libraries.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
MEMORY_SHARE = 0.95  # largest fraction of the installed memory, of which processes get equal parts
LOOK_S = 1.0  # interval of the checks of memory, and longest wait for a process to report, s
# The study fails after this number of consecutive processes that die before they are ready.
MOST_FAILED_STARTS = 3
# Exit status of a new process that reached a study while it read the script, see
# `end_if_unguarded`.
UNGUARDED = 97
END_S = 10.0  # longest time to wait for the end of a killed process, s


def end_if_unguarded() -> None:
    """End this process if it is a worker that reads the script of the main process anew.

    A new process first executes the script, except what is below ``if __name__ == "__main__":``. If
    this starts a study, the script lacks this line. `ProcessExecutor` then says so.
    """
    if getattr(current_process(), "_inheriting", False):  # so `multiprocessing` itself finds it out
        sys.exit(UNGUARDED)


class ProcessExecutor:
    """Executor of a study's batches on a number of processes. A process that dies is replaced."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._workers: list[_Worker] = []
        self._failed_starts = 0
        self._looked = time.monotonic()

    def __call__(self, shared: Shared, batches: Batches) -> Iterator[list[Finished]]:
        """Yield the rows of each batch when it finishes, and an empty list after each wait.

        Raises StudyError if processes cannot be started, repeatedly die before they are ready, or
        start the study anew.
        """
        suspects = Suspects()
        try:
            self._start_missing()
            while self._assign_batches(shared, batches, suspects):
                for worker in self._wait():
                    if finished := self._collect(worker, batches, suspects):
                        yield finished
                yield []
                self._start_missing()
        finally:
            # After an error, processes can still compute rows that nobody will read.
            if any(worker.cases for worker in self._workers):
                self.close()

    def close(self) -> None:
        """End all processes, also in the middle of a row."""
        with delay_interrupts():
            for worker in self._workers:
                worker.end()
            self._workers.clear()

    def _start_missing(self) -> None:
        try:
            while len(self._workers) < self._count:
                with delay_interrupts():
                    self._workers.append(_Worker())
        except OSError as error:
            raise StudyError(
                f"process {len(self._workers) + 1} of {self._count} cannot be started: "
                f"{error.strerror}; use fewer processes (--workers)"
            ) from error

    def _assign_batches(self, shared: Shared, batches: Batches, suspects: Suspects) -> bool:
        """Give each idle process a batch. Return False once no rows are left.

        Rows during which a process died come last, one at a time.
        """
        ready = [worker for worker in self._workers if worker.ready]
        for worker in ready:
            if not worker.cases:
                worker.send(shared, batches.next_batch(self._count))
        # A suspect row is computed alone, so that a second death is certainly due to this row.
        if ready and not any(worker.cases for worker in ready):
            ready[0].send(shared, suspects.next_batch())
        return not ready or any(worker.cases for worker in ready)

    def _wait(self) -> list["_Worker"]:
        """Return the processes that have become ready, have finished a batch, or have died.

        The method waits at most LOOK_S for such a process. Processes that use too much memory are
        killed.
        """
        if time.monotonic() > self._looked + LOOK_S:
            self._looked = time.monotonic()
            limit = MEMORY_SHARE * psutil.virtual_memory().total / self._count
            for worker in self._workers:
                worker.kill_above(limit)
        reporting = wait([worker.pipe for worker in self._workers], timeout=LOOK_S)
        return [worker for worker in self._workers if worker.pipe in reporting]

    def _collect(self, worker: "_Worker", batches: Batches, suspects: Suspects) -> list[Finished]:
        """Return the rows that a process has computed, or the failed row of a dead process.

        The list is empty if the process has become ready, or if its rows will be computed again.
        """
        cases = worker.cases
        finished: list[Finished] | None = None
        with suppress(EOFError, OSError):
            finished = worker.receive()
        if finished is None:
            return self._remove_dead(worker, suspects)
        self._failed_starts = 0
        if cases:
            batches.update_row_time(finished)
        return finished

    def _remove_dead(self, worker: "_Worker", suspects: Suspects) -> list[Finished]:
        """Remove a dead process. A row that has ended two processes is returned as failed."""
        with delay_interrupts():
            self._workers.remove(worker)
            worker.end()
        if not worker.ready and worker.exit_status == UNGUARDED:
            raise StudyError(
                "each worker process executes this script, and would start the study anew: call "
                'study.run() below if __name__ == "__main__": or with workers=0'
            )
        if not worker.ready:
            self._failed_starts += 1
            if self._failed_starts >= MOST_FAILED_STARTS:
                raise StudyError(
                    f"{MOST_FAILED_STARTS} processes died before they computed a row; "
                    "--workers 0 computes in the main process, and may show the reason"
                )
        return suspects.record_death(worker.cases, worker.end_reason)


class _Worker:
    """Process of this machine, and the pipe to it.

    ready       True once the process has loaded its libraries.
    cases       Rows that the process computes now.
    end_reason  What happened to the process, for an error message.
    pipe        Main process's end of the pipe.
    """

    def __init__(self) -> None:
        self.ready = False
        self.cases: list[Case] = []
        self.end_reason = "died"
        self.pipe, theirs = SPAWN.Pipe()
        self._process = SPAWN.Process(target=work, args=(theirs,), daemon=True)
        # multiprocessing's resource tracker is started before the block, because starting it in the
        # block would unblock Ctrl-C.
        resource_tracker.ensure_running()
        with _one_thread_each(), shield_children():
            self._process.start()
        theirs.close()

    @property
    def exit_status(self) -> int | None:
        """Exit status of the process, or None while it runs."""
        return self._process.exitcode

    def send(self, shared: Shared, cases: list[Case]) -> None:
        """Send rows to compute, unless the list is empty."""
        self.cases = cases
        if cases:
            # OSError means that the process has died, which `receive` will report.
            with suppress(OSError):
                self.pipe.send((shared, cases))

    def receive(self) -> list[Finished]:
        """Return the computed rows, or an empty list if the process has become ready.

        Raises EOFError or OSError if the process has died.
        """
        finished: list[Finished] = self.pipe.recv()
        self.ready = True
        self.cases = []
        return finished

    def kill_above(self, limit: float) -> None:
        """Kill the process if its memory (resident set) exceeds the limit, bytes."""
        with suppress(psutil.Error):
            if psutil.Process(self._process.pid).memory_info().rss > limit:
                self.end_reason = f"took more than {limit / GB:.3g} GB of memory"
                self._process.kill()

    def end(self) -> None:
        """Close the pipe, kill the process, and wait up to END_S for its end."""
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
