"""The batches of a study on Dask: on a local cluster, one process a core, or on one that is running already.

A worker that dies loses nothing but the batches it had, which are computed elsewhere. Batches whose workers died are
taken apart, and each of their rows is tried alone; a row that then kills its worker again is an error of this row.

Finished batches come by a callback into a queue, which is waited for with a limit: that of ``distributed.as_completed``
holds for all of a study, and it looks ten times a second. ``Client.get_versions(check=True)`` compares Dask's own
packages, also those of the scheduler, which computes nothing; here those count with which rows are computed.
"""

import asyncio
import logging
import math
import queue
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from multiprocessing import active_children, resource_tracker

import dask
from distributed import Client, Future, KilledWorker, LocalCluster, WorkerPlugin, get_worker, rpc
from distributed.comm import parse_address
from distributed.comm.registry import get_backend
from tornado.ioloop import PeriodicCallback

from identify.errors import StudyError
from identify.files.versions import product_version, require_product, same_versions, versions
from identify.runtime import deaf_offspring, held
from identify.studies.design import Case, Finished, Setup
from identify.studies.runner import Batches, compute

WORKERLESS_SECONDS = 180
"""How long a cluster may be without any worker; one that starts again needs its time on a busy machine."""

ANSWER_SECONDS = 30
"""How long a scheduler may take to answer."""

GONE = "the Dask scheduler is gone; the same command goes on from here with another"

KILLED = "KilledWorker: the process that computed this row died, and died again when it computed this row alone"

REMEDY = "install the same on all machines"

BATCHES_A_WORKER = 3
"""Batches on their way for each worker: one in work, and the next ones at hand."""


class DaskExecutor:
    """Computes the batches of a study on the workers of a client, only a few of them on their way at a time."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._done: queue.SimpleQueue[Future] = queue.SimpleQueue()
        self._open: dict[str, tuple[Future, list[Case]]] = {}
        self._suspects: list[Case] = []
        self._deaths: Counter[int] = Counter()
        self._workers, self._asked, self._seen = 1, -math.inf, time.monotonic()

    def __call__(self, setup: Setup, batches: Batches) -> Iterator[list[Finished]]:
        """Yield batches as they are done.

        Raises StudyError: the scheduler or all workers are gone, or workers cannot run this program.
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
        future = self._client.submit(_compute_alike, product_version(), setup, cases, pure=False)
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

    Raises StudyError: it has another version of cmmsim than the study's.
    """
    require_product(f"worker {get_worker().address}", product_version(), version, REMEDY)
    return compute(setup, cases)


def gone(error: OSError) -> StudyError:
    """A scheduler that does not answer any more, as the error of the study."""
    return StudyError(f"{GONE}: {' '.join(str(error).split())}")


CONNECT_SECONDS = 5
"""How long a scheduler may take to answer at first."""

START_SECONDS = 60
"""How long a study waits for all workers of a local cluster before it begins with those that have started."""

CLOSE_SECONDS = 20
"""How long a local cluster may take to end; what is left of it then ends with this process."""

LOCAL_SETTINGS = {
    "distributed.scheduler.allowed-failures": 0,
    "distributed.deploy.lost-worker-timeout": "90 s",
    **{
        f"distributed.nanny.pre-spawn-environ.{name}": 1
        for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
    },
}
"""The first death of its worker makes a batch suspect, as it does not cost the batch: its rows are tried alone. A
worker that has not started again by itself within the time, far more than it needs on a busy machine, is given up, and
another one started; giving it up sooner would end it with its next rows. One thread a process, set before the libraries
are loaded: there are as many processes as cores."""


@contextmanager
def local_cluster(workers: int) -> Iterator[DaskExecutor]:
    """Workers: so many new processes on this machine, each started again when it dies."""
    _silence_dask()
    with dask.config.set(LOCAL_SETTINGS), _empty_cluster(workers) as cluster, Client(cluster) as client:
        client.register_plugin(_OneThread(), name="one thread")
        cluster.scale(workers)
        cluster.loop.add_callback(PeriodicCallback(partial(cluster.scale, workers), 1000).start)
        with suppress(TimeoutError):  # those that are there begin, and where there are none, the executor says so
            client.wait_for_workers(workers, timeout=START_SECONDS)
        yield DaskExecutor(client)


@contextmanager
def _empty_cluster(workers: int) -> Iterator[LocalCluster]:
    """A cluster for so many workers, which has none yet: it can be left at any moment, also while they start."""
    others = active_children()
    resource_tracker.ensure_running()  # it would let the thread that starts it hear Ctrl-C again
    with ExitStack() as stack:
        with held(), deaf_offspring():
            cluster = LocalCluster(
                n_workers=0,
                threads_per_worker=1,
                memory_limit=1.0 / workers,
                processes=True,
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL,
            )
            stack.callback(_close, cluster, {child.pid for child in others})
        yield cluster


def _close(cluster: LocalCluster, others: set[int | None]) -> None:
    """End a cluster and its processes; those that are just starting are killed, as Dask would wait for them."""

    def kill_starting() -> None:
        known = others | {nanny.pid for nanny in cluster.workers.values()}
        for child in active_children():
            if child.pid not in known:
                child.kill()

    with held(), suppress(Exception):  # nothing in it is needed any more
        cluster.loop.add_callback(PeriodicCallback(kill_starting, 100).start)
        cluster.close(timeout=CLOSE_SECONDS)


@contextmanager
def running_cluster(address: str) -> Iterator[DaskExecutor]:
    """Workers: those of a cluster that is running.

    Raises StudyError: no scheduler answers there, or it has no workers, or one with another version of cmmsim.
    """
    _silence_dask()
    try:
        kind, place = parse_address(address)
        get_backend(kind).get_address_host(place)  # a client of no such kind would go on trying in the background
    except (ValueError, ImportError) as error:
        raise _no_scheduler(address, str(error)) from error
    try:
        asyncio.run(_identity(address))
        client = Client(address, timeout=CONNECT_SECONDS)
    except OSError as error:
        raise _no_scheduler(address, str(error) or "nothing listens there, or what does says nothing") from error
    except Exception as error:  # Dask takes the first bytes of whatever it is told for the size of a message
        raise _no_scheduler(address, "what listens there speaks another protocol") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=CONNECT_SECONDS)
        except TimeoutError as error:
            raise StudyError(f"the Dask scheduler at {address} has no workers; start some with: dask worker") from error
        try:
            check_workers(client.run(versions, on_error="return"))
        except OSError as error:
            raise gone(error) from error
        yield DaskExecutor(client)


def check_workers(there: Mapping[str, dict[str, str] | Exception]) -> None:
    """Compare with the versions here those that workers answered, by address.

    A worker that answered with an error cannot run cmmsim, but one that did not answer (OSError) is gone.

    Raises StudyError: a worker has another cmmsim, or none.
    """
    for worker, answer in there.items():
        if isinstance(answer, Exception) and not isinstance(answer, OSError):
            raise StudyError(f"worker {worker} cannot run cmmsim {product_version()}: {' '.join(str(answer).split())}")
    same_versions({f"worker {one}": answer for one, answer in there.items() if isinstance(answer, dict)}, REMEDY)


async def _identity(address: str) -> object:
    """What a scheduler says of itself. A client would wait without end where something listens and never answers.

    Raises OSError where nothing answers in time, and other errors where something else does.
    """
    async with rpc(address) as scheduler:
        return await asyncio.wait_for(scheduler.identity(), CONNECT_SECONDS)


def _no_scheduler(address: str, why: str) -> StudyError:
    return StudyError(f"no Dask scheduler answers at {address} within {CONNECT_SECONDS} s: {' '.join(why.split())}")


def _silence_dask() -> None:
    """What Dask notes of workers that come and go is no news for the user of a study."""
    for name in ("distributed", "distributed.client", "distributed.core", "tornado.application", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


class _OneThread(WorkerPlugin):
    """OpenCV's own threads off."""

    def setup(self, worker: object) -> None:
        import cv2

        cv2.setNumThreads(1)
