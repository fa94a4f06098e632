"""The batches of a study on the workers of a Dask cluster.

A worker that dies loses nothing but the batches it had, which are computed elsewhere. Batches whose workers died are
taken apart, and each of their rows is tried alone; a row that then kills its worker again is an error of this row.
"""

import math
import queue
import time
from collections import Counter
from collections.abc import Iterator
from uuid import uuid4

from distributed import Client, Future, KilledWorker, get_worker

from identify.errors import StudyError
from identify.files.same_versions import product_version, require_product
from identify.studies.batches import Batches
from identify.studies.computation import Finished, compute
from identify.studies.design import Case, Setup

WORKERLESS_SECONDS = 180
"""How long a cluster may be without any worker; one that starts again needs its time on a busy machine."""

ANSWER_SECONDS = 30
"""How long a scheduler may take to answer."""

GONE = "the Dask scheduler is gone; the same command goes on from here with another"

KILLED = "KilledWorker: the process that computed this row died, and died again when it computed this row alone"

BATCHES_A_WORKER = 3
"""Batches on their way for each worker: one in work, and the next ones at hand."""


class DaskExecutor:
    """Computes the batches of a study on the workers of a client, only a few of them on their way at a time."""

    def __init__(self, client: Client) -> None:
        self._client, self._name = client, f"study-{uuid4().hex[:8]}"
        self._done: queue.SimpleQueue[Future] = queue.SimpleQueue()
        self._open: dict[str, tuple[Future, list[Case]]] = {}
        self._suspects: list[Case] = []
        self._deaths: Counter[int] = Counter()
        self._sent = 0
        self._workers, self._asked, self._seen = 1, -math.inf, time.monotonic()

    def __call__(self, setup: Setup, batches: Batches) -> Iterator[list[Finished]]:
        """Yield batches as they are done.

        Raises:
            StudyError: the scheduler or all workers are gone, or workers cannot run this program.
        """
        try:
            while self._send_more(setup, batches):
                finished = self._next()
                if finished:
                    batches.learn(finished)
                    yield finished
        except OSError as error:
            raise gone(error) from error

    def _send_more(self, setup: Setup, batches: Batches) -> bool:
        """Keep all workers busy; rows that may kill their workers come last, one at a time. False at the end."""
        workers = self._count_workers()
        while len(self._open) < BATCHES_A_WORKER * workers and (cases := batches.take(workers)):
            self._send(setup, cases)
        if not self._open and self._suspects:
            self._send(setup, [self._suspects.pop()])
        return bool(self._open)

    def _send(self, setup: Setup, cases: list[Case]) -> None:
        self._sent += 1
        key = f"{self._name}-{self._sent}"
        future = self._client.submit(_compute_alike, product_version(), setup, cases, key=key, pure=False)
        self._open[future.key] = (future, cases)
        future.add_done_callback(self._done.put)

    def _next(self) -> list[Finished]:
        """The next finished batch; empty when there is none yet, or when one was taken apart."""
        try:
            future = self._done.get(timeout=1.0)
        except queue.Empty:
            self._check_cluster()
            return []
        _, cases = self._open.pop(future.key)
        try:
            return self._result(future)
        except KilledWorker:
            return self._blame(cases)
        except StudyError:
            raise
        except Exception as error:
            self._check_cluster()
            causes = [error, *([error.__cause__] if error.__cause__ else [])]
            text = " ".join("; ".join(f"{type(one).__name__}: {one}" for one in causes).split())
            raise StudyError(f"the cluster cannot compute rows: {text}") from error

    def _result(self, future: Future) -> list[Finished]:
        """What a finished batch found. Where it died with its worker it is computed again: that may take a while, but
        not without any worker."""
        while True:
            try:
                return list(future.result(timeout=ANSWER_SECONDS))
            except TimeoutError:
                self._check_cluster()

    def _blame(self, cases: list[Case]) -> list[Finished]:
        """Make rows suspects, or the one an error that was alone and has lost its worker for the second time."""
        self._deaths.update(case.number for case in cases)
        alone = len(cases) == 1 and not self._open
        if alone and self._deaths[cases[0].number] > 1:
            return [Finished(cases[0].number, {}, 0.0, KILLED)]
        self._suspects += cases
        return []

    def _count_workers(self) -> int:
        """How many workers there are, or were a second ago; at least one, which may be about to come."""
        if time.monotonic() > self._asked + 1.0:
            self._workers, self._asked = max(1, self._ask_workers()), time.monotonic()
        return self._workers

    def _ask_workers(self) -> int:
        workers = len(self._client.nthreads(callback_timeout=ANSWER_SECONDS))
        if workers:
            self._seen = time.monotonic()
        return workers

    def _check_cluster(self) -> None:
        if self._client.status != "running":
            raise StudyError(GONE)
        if not self._ask_workers() and time.monotonic() > self._seen + WORKERLESS_SECONDS:
            raise StudyError(f"no Dask worker for {WORKERLESS_SECONDS} s; the same command goes on from here")


def _compute_alike(version: str, setup: Setup, cases: list[Case]) -> list[Finished]:
    """Compute rows on a worker, which may have come after the others were checked.

    Raises:
        StudyError: it has another version of cmmsim than the study's.
    """
    require_product(get_worker().address, product_version(), version)
    return compute(setup, cases)


def gone(error: OSError) -> StudyError:
    """A scheduler that does not answer any more, as the error of the study."""
    return StudyError(f"{GONE}: {' '.join(str(error).split())}")
