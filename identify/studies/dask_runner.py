"""Clusters that compute a study: a local one of one process a core, or one that is running already."""

import asyncio
import logging
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from multiprocessing import active_children, resource_tracker

import dask
from distributed import Client, LocalCluster, WorkerPlugin, rpc
from distributed.comm import parse_address
from distributed.comm.registry import get_backend
from tornado.ioloop import PeriodicCallback

from identify.errors import StudyError
from identify.files.same_versions import check_workers
from identify.files.versions import versions
from identify.interrupts import deaf_offspring, held
from identify.studies.dask_executor import DaskExecutor, gone

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

    Raises:
        StudyError: no scheduler answers there, or it has no workers, or one with another version of cmmsim.
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
        raise _no_scheduler(address, str(error) or "what listens there says nothing") from error
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
