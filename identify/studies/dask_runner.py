"""Rows on Dask: a local cluster of one process a core, or a cluster that is running already.

A worker that dies loses nothing but the batches it had: Dask gives them to others. A batch on which workers die again
and again is taken apart, and each of its rows is tried alone; a row that then still kills its worker is an error of
this row.
"""

import logging
import math
import os
import queue
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from uuid import uuid4

import dask
from distributed import Client, Future, KilledWorker, LocalCluster, WorkerPlugin, get_worker

from identify.errors import StudyError
from identify.files.versions import versions
from identify.studies.batches import Batches
from identify.studies.computation import Finished, compute
from identify.studies.design import Case, Setup
from identify.studies.same_versions import check_workers, product_version, require_product

CONNECT_SECONDS = 5
"""How long a scheduler may take to answer."""

WORKERLESS_SECONDS = 60
"""How long a cluster may be without any worker."""

GONE = "the Dask scheduler is gone; the same command goes on from here with another"

BATCHES_A_WORKER = 3
"""Batches on their way for each worker: one in work, and the next ones at hand."""

LOCAL_SETTINGS = {
    "distributed.scheduler.allowed-failures": 1,
    **{
        f"distributed.nanny.pre-spawn-environ.{name}": 1
        for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
    },
}
"""A second death of its worker makes a batch suspect, as it does not cost the batch: its rows are tried alone. One
thread a process, set before the libraries are loaded: there are as many processes as cores."""


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


@contextmanager
def local_cluster(workers: int) -> Iterator["DaskExecutor"]:
    """Workers: so many new processes on this machine."""
    _silence_dask()
    with (
        dask.config.set(LOCAL_SETTINGS),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            dashboard_address="127.0.0.1:0",
            silence_logs=logging.CRITICAL,
        ) as cluster,
        Client(cluster) as client,
    ):
        client.register_plugin(_OneThread(), name="one thread")
        yield DaskExecutor(client)


@contextmanager
def running_cluster(address: str) -> Iterator["DaskExecutor"]:
    """Workers: those of a cluster that is running.

    Raises:
        StudyError: no scheduler answers there, or it has no workers, or one with another version of cmmsim.
    """
    _silence_dask()
    try:
        client = Client(address, timeout=CONNECT_SECONDS)
    except Exception as error:  # whatever else listens there may answer anything
        raise StudyError(
            f"no Dask scheduler answers at {address} within {CONNECT_SECONDS} s: {' '.join(str(error).split())}"
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=CONNECT_SECONDS)
        except TimeoutError as error:
            raise StudyError(f"the Dask scheduler at {address} has no workers; start some with: dask worker") from error
        try:
            check_workers(client.run(versions, on_error="return"))
        except OSError as error:
            raise _gone(error) from error
        yield DaskExecutor(client)


class DaskExecutor:
    """Computes the batches of a study on the workers of a client, only a few of them on their way at a time."""

    def __init__(self, client: Client) -> None:
        self._client, self._name = client, f"study-{uuid4().hex[:8]}"
        self._done: queue.SimpleQueue[Future] = queue.SimpleQueue()
        self._open: dict[str, tuple[Future, list[Case]]] = {}
        self._suspects: list[Case] = []
        self._sent = self._workerless = 0
        self._workers, self._asked = 1, -math.inf

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
            raise _gone(error) from error
        finally:
            if self._open and self._client.status == "running":
                self._client.cancel([future for future, _ in self._open.values()], force=True)

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
            return list(future.result())
        except KilledWorker as error:
            return self._blame(cases, error)
        except StudyError:
            raise
        except Exception as error:
            self._check_cluster()
            causes = [error, *([error.__cause__] if error.__cause__ else [])]
            text = " ".join("; ".join(f"{type(one).__name__}: {one}" for one in causes).split())
            raise StudyError(f"the cluster cannot compute rows: {text}") from error

    def _blame(self, cases: list[Case], error: KilledWorker) -> list[Finished]:
        alone = len(cases) == 1 and not self._open
        if alone:
            return [Finished(cases[0].number, {}, 0.0, f"KilledWorker: {error}")]
        self._suspects += cases
        return []

    def _count_workers(self) -> int:
        """How many workers there are, or were a second ago; at least one, which may be about to come."""
        if time.monotonic() > self._asked + 1.0:
            self._workers, self._asked = max(1, len(self._client.nthreads())), time.monotonic()
        return self._workers

    def _check_cluster(self) -> None:
        if self._client.status != "running":
            raise StudyError(GONE)
        self._workerless = 0 if self._client.nthreads() else self._workerless + 1
        if self._workerless > WORKERLESS_SECONDS:
            raise StudyError(f"no Dask worker for {WORKERLESS_SECONDS} s; the same command goes on from here")


def _compute_alike(version: str, setup: Setup, cases: list[Case]) -> list[Finished]:
    """Compute rows on a worker, which may have come after the others were checked.

    Raises:
        StudyError: it has another version of cmmsim than the study's.
    """
    require_product(get_worker().address, product_version(), version)
    return compute(setup, cases)


def _gone(error: OSError) -> StudyError:
    return StudyError(f"{GONE}: {' '.join(str(error).split())}")


def _silence_dask() -> None:
    """What Dask notes of workers that come and go is no news for the user of a study."""
    for name in ("distributed", "distributed.client", "distributed.core"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


class _OneThread(WorkerPlugin):
    """OpenCV's own threads off; Ctrl-C is for the main process, which ends its workers."""

    def setup(self, worker: object) -> None:
        import cv2

        cv2.setNumThreads(1)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
