"""Batches of a study on the workers of a Dask cluster that is already running.

A worker that dies loses only the batches it had, which are computed elsewhere. A batch whose
workers died is taken apart, and each of its rows is tried alone. A row that then kills its worker
again becomes an error of this row.

Whoever can speak to a scheduler can run code as its owner. A scheduler beyond this machine must
therefore be reached by TLS, with the certificates of Dask's own configuration.

A callback puts finished batches into a queue, which is read with a time limit. The limit of
``distributed.as_completed`` would hold for the whole study, and it polls ten times a second.
``Client.get_versions(check=True)`` compares Dask's own packages, also those of the scheduler, which
computes nothing. Here the packages are compared that compute the rows.
"""

import asyncio
import ipaddress
import logging
import math
import queue
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from distributed import Client, Future, KilledWorker, get_worker, rpc
from distributed.comm import parse_address
from distributed.comm.registry import get_backend
from distributed.security import Security

from identify.errors import StudyError
from identify.files.versions import product_version, require_product, same_versions, versions
from identify.studies.runner import Batches, Suspects, compute
from identify.studies.study_design import Case, Finished, Shared

WORKERLESS_SECONDS = 180
"""Longest time that a cluster may be without workers, s. On a busy machine they start slowly."""

ANSWER_SECONDS = 30
"""Longest time that a scheduler may take to answer, s."""

GONE = "the Dask scheduler is gone; the same command goes on from here with another"

REMEDY = "install the same on all machines"

BATCHES_A_WORKER = 3
"""Batches on their way for each worker: one in work, and the next ones at hand."""


class DaskExecutor:
    """Executor of a study's batches on the workers of a client.

    Only a few batches are on their way at a time.
    """

    def __init__(self, client: Client) -> None:
        self._client = client
        self._done: queue.SimpleQueue[Future] = queue.SimpleQueue()
        self._open: dict[str, tuple[Future, list[Case]]] = {}
        self._suspects = Suspects()
        self._workers = 1
        self._asked = -math.inf
        self._seen = time.monotonic()

    def __call__(self, shared: Shared, batches: Batches) -> Iterator[list[Finished]]:
        """Yield batches as they are done.

        Raises
        ------
        StudyError
            The scheduler or all workers are gone, or workers cannot run this program.
        """
        try:
            while self._send_more(shared, batches):
                finished = self._next()
                if finished:
                    batches.learn(finished)
                    yield finished
        except OSError as error:
            raise gone(error) from error

    def _send_more(self, shared: Shared, batches: Batches) -> bool:
        """Keep all workers busy. Return False at the end.

        Rows that may kill their workers come last, one at a time.
        """
        workers = self._count_workers()
        while len(self._open) < BATCHES_A_WORKER * workers and (cases := batches.take(workers)):
            self._send(shared, cases)
        if not self._open and (cases := self._suspects.take()):
            self._send(shared, cases)
        return bool(self._open)

    def _send(self, shared: Shared, cases: list[Case]) -> None:
        # With pure=True, Dask would answer a second try with the failure of the first.
        future = self._client.submit(_compute_alike, product_version(), shared, cases, pure=False)
        self._open[future.key] = (future, cases)
        future.add_done_callback(self._done.put)

    def _next(self) -> list[Finished]:
        """Return the next finished batch.

        It is empty if none has finished yet, or if its workers died and it was taken apart.
        """
        try:
            future = self._done.get(timeout=1.0)
        except queue.Empty:
            self._check_cluster()
            return []
        _, cases = self._open.pop(future.key)
        try:
            return self._result(future)
        except KilledWorker:
            return self._suspects.blame(cases)
        except StudyError:
            raise
        except Exception as error:
            self._check_cluster()
            causes = [error, *([error.__cause__] if error.__cause__ else [])]
            text = " ".join("; ".join(f"{type(one).__name__}: {one}" for one in causes).split())
            raise StudyError(f"the cluster cannot compute rows: {text}") from error

    def _result(self, future: Future) -> list[Finished]:
        """Return the rows of a finished batch.

        If they were lost with their worker, Dask computes them again. That may take a while, but
        not without any worker.
        """
        while True:
            try:
                return list(future.result(timeout=ANSWER_SECONDS))
            except TimeoutError:
                self._check_cluster()

    def _count_workers(self) -> int:
        """Return the number of workers, at most a second old.

        It is at least 1, since a worker may be about to come.
        """
        if time.monotonic() > self._asked + 1.0:
            self._workers = max(1, self._ask_workers())
            self._asked = time.monotonic()
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
            raise StudyError(
                f"no Dask worker for {WORKERLESS_SECONDS} s; the same command goes on from here"
            )


def _compute_alike(version: str, shared: Shared, cases: list[Case]) -> list[Finished]:
    """Compute rows on a worker, which may have come after the others were checked.

    Raises StudyError if the worker has another version of cmmsim than the study.
    """
    require_product(f"worker {get_worker().address}", product_version(), version, REMEDY)
    return compute(shared, cases)


def gone(error: OSError) -> StudyError:
    """Return the error of a study whose scheduler no longer answers."""
    return StudyError(f"{GONE}: {' '.join(str(error).split())}")


CONNECT_SECONDS = 20
"""Longest time that a scheduler may take to answer at first, s. TLS takes seconds if it is busy."""

ENCRYPTED = ("tls", "wss")
"""Kinds of address for which both sides show a certificate."""


@contextmanager
def running_cluster(address: str, insecure: bool = False) -> Iterator[DaskExecutor]:
    """Provide the workers of a cluster that is running.

    Parameters
    ----------
    address : str
        Address of the scheduler.
    insecure : bool, optional
        Also take a scheduler that anybody on the network can speak to.

    Raises
    ------
    StudyError
        No scheduler answers there, anybody can speak to it, it has no workers, or one of its
        workers has another version of cmmsim.
    """
    _silence_dask()
    try:
        kind, place = parse_address(address)
        # A client of an address of no kind would go on trying in the background.
        host = get_backend(kind).get_address_host(place)
    except (ValueError, ImportError) as error:
        raise _no_scheduler(address, str(error)) from error
    if kind not in ENCRYPTED and not insecure and not _is_here(host):
        raise StudyError(
            f"{address} asks for no certificate: whoever reaches it can run code as you; "
            "name a tls:// address, or say --insecure"
        )
    security = Security()
    if kind in ENCRYPTED:
        _check_certificates(address, security)
    try:
        asyncio.run(_identity(address, security))
        client = Client(address, security=security, timeout=CONNECT_SECONDS)
    except OSError as error:
        why = str(error) or "nothing listens there, or what does says nothing"
        raise _no_scheduler(address, why) from error
    except Exception as error:
        # Dask takes the first bytes of whatever it is told for the size of a message.
        raise _no_scheduler(address, "what listens there speaks another protocol") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=CONNECT_SECONDS)
        except TimeoutError as error:
            raise StudyError(
                f"the Dask scheduler at {address} has no workers; start some with: dask worker"
            ) from error
        try:
            check_workers(client.run(versions, on_error="return"))
        except OSError as error:
            raise gone(error) from error
        yield DaskExecutor(client)


def _is_here(host: str) -> bool:
    """Tell whether only this machine reaches a host."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _check_certificates(address: str, security: Security) -> None:
    """Refuse to call a scheduler without certificates. Raises StudyError."""
    try:
        there = security.get_connection_args("client").get("ssl_context")
        why = "none are named"
    except (OSError, ValueError) as error:
        there = None
        why = str(error)
    if not there:
        raise StudyError(
            f"{address} asks for certificates ({why}): name them in Dask's configuration, "
            "distributed.comm.tls.ca-file, client.cert and client.key"
        )


def check_workers(there: Mapping[str, dict[str, str] | Exception]) -> None:
    """Compare the versions that workers answered, by address, with those here.

    A worker that answered with an error cannot run cmmsim. One that did not answer (OSError) is
    gone, and does not count.

    Raises
    ------
    StudyError
        A worker has another cmmsim, or none.
    """
    for worker, answer in there.items():
        if isinstance(answer, Exception) and not isinstance(answer, OSError):
            raise StudyError(
                f"worker {worker} cannot run cmmsim {product_version()}: "
                f"{' '.join(str(answer).split())}"
            )
    same_versions(
        {f"worker {one}": answer for one, answer in there.items() if isinstance(answer, dict)},
        REMEDY,
    )


async def _identity(address: str, security: Security) -> object:
    """Ask a scheduler for its identity.

    A client would wait without end for something that listens and never answers. Raises OSError if
    nothing answers in time, and other errors if something else does.
    """
    arguments = security.get_connection_args("client")
    async with rpc(address, connection_args=arguments) as scheduler:
        return await asyncio.wait_for(scheduler.identity(), CONNECT_SECONDS)


def _no_scheduler(address: str, why: str) -> StudyError:
    return StudyError(
        f"no Dask scheduler answers at {address} within {CONNECT_SECONDS} s: "
        f"{' '.join(why.split())}"
    )


def _silence_dask() -> None:
    """Silence Dask's log of workers that come and go, which is no news for the user of a study."""
    for name in (
        "distributed",
        "distributed.client",
        "distributed.core",
        "tornado.application",
        "asyncio",
    ):
        logging.getLogger(name).setLevel(logging.CRITICAL)
