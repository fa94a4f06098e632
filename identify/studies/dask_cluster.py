"""Batches of a study on the workers of a Dask cluster that is already running.

If a worker dies, other workers compute its batches. If several workers die with the same batch, the
batch is split, and each of its rows is computed alone. If a worker dies again during such a row,
the row gets an error.

Everyone who can connect to a scheduler can run code under the account of its owner. A scheduler on
another machine must therefore be reached by TLS, with the certificates of Dask's configuration,
unless the user accepts the risk.

A callback puts finished batches into a queue, which is read with a time limit. The time limit of
``distributed.as_completed`` would apply to the whole study, and that function polls ten times a
second. ``Client.get_versions(check=True)`` is not used, because it compares the packages of Dask,
even on the scheduler, which computes nothing. Here the packages that compute rows are compared.
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

# Longest allowed time without workers, s. On a busy machine workers start slowly.
WORKERLESS_SECONDS = 180
ANSWER_SECONDS = 30  # longest wait for an answer, after which the cluster is checked, s

SCHEDULER_LOST = (
    "the Dask scheduler is gone; the same command with another scheduler continues the study"
)

REMEDY = "install the same version on all machines"

# Number of submitted batches per worker: one being computed, and the next batches waiting.
BATCHES_A_WORKER = 3


class DaskExecutor:
    """Executor of a study's batches on the workers of a client.

    Only a few batches per worker are submitted at a time.
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
        """Yield the rows of each batch when it finishes, and empty lists while none has finished.

        Raises StudyError if the scheduler is gone, if there has been no worker for
        WORKERLESS_SECONDS, or if a worker cannot run this program.
        """
        try:
            while self._send_more(shared, batches):
                finished = self._next()
                if finished:
                    batches.update_row_time(finished)
                yield finished
        except OSError as error:
            raise scheduler_lost(error) from error

    def _send_more(self, shared: Shared, batches: Batches) -> bool:
        """Submit batches so that all workers are busy. Return False once all rows are computed.

        Rows during which workers have died come last, one at a time.
        """
        workers = self._count_workers()
        while len(self._open) < BATCHES_A_WORKER * workers and (
            cases := batches.next_batch(workers)
        ):
            self._send(shared, cases)
        if not self._open and (cases := self._suspects.next_batch()):
            self._send(shared, cases)
        return bool(self._open)

    def _send(self, shared: Shared, cases: list[Case]) -> None:
        # With pure=True, Dask would return the failure of the first try for a second try.
        future = self._client.submit(_compute_checked, product_version(), shared, cases, pure=False)
        self._open[future.key] = (future, cases)
        future.add_done_callback(self._done.put)

    def _next(self) -> list[Finished]:
        """Return the next finished batch.

        The list is empty if no batch has finished within a second, or if workers died with the
        batch and its rows will be computed again.
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
            return self._suspects.record_death(cases)
        except StudyError:
            raise
        except Exception as error:
            self._check_cluster()
            causes = [error, *([error.__cause__] if error.__cause__ else [])]
            text = " ".join("; ".join(f"{type(one).__name__}: {one}" for one in causes).split())
            raise StudyError(f"the cluster cannot compute rows: {text}") from error

    def _result(self, future: Future) -> list[Finished]:
        """Return the rows of a finished batch.

        If the rows were lost with their worker, Dask computes them again. The wait is unlimited,
        but ends with StudyError if the cluster has no workers for too long.
        """
        while True:
            try:
                return list(future.result(timeout=ANSWER_SECONDS))
            except TimeoutError:
                self._check_cluster()

    def _count_workers(self) -> int:
        """Return the number of workers. The number is at most a second old.

        The number is at least 1, because a worker can still join.
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
            raise StudyError(SCHEDULER_LOST)
        if not self._ask_workers() and time.monotonic() > self._seen + WORKERLESS_SECONDS:
            raise StudyError(
                f"no Dask worker for {WORKERLESS_SECONDS} s; the same command continues the study"
            )


def _compute_checked(version: str, shared: Shared, cases: list[Case]) -> list[Finished]:
    """Compute rows on a worker.

    The version is checked here again, because a worker can join after the first check. Raises
    StudyError if the worker has another version of cmmsim than the study.
    """
    require_product(f"worker {get_worker().address}", product_version(), version, REMEDY)
    return compute(shared, cases)


def scheduler_lost(error: OSError) -> StudyError:
    """Return the error of a study whose scheduler no longer answers."""
    return StudyError(f"{SCHEDULER_LOST}: {' '.join(str(error).split())}")


# Longest wait for the first answer of a scheduler, and for its first worker, s. With TLS a busy
# scheduler takes seconds.
CONNECT_SECONDS = 20
ENCRYPTED = ("tls", "wss")  # protocols in which both sides present a certificate


@contextmanager
def running_cluster(address: str, insecure: bool = False) -> Iterator[DaskExecutor]:
    """Provide the workers of a cluster that is running.

    address   Address of the scheduler.
    insecure  Also accept a scheduler to which everyone on the network can connect.

    Raises StudyError if no scheduler answers at the address, certificates that it asks for are
    missing, it has no workers, or a worker has another version of cmmsim. Unless ``insecure``,
    StudyError is also raised for a scheduler on another machine that asks for no certificate.
    """
    _silence_dask()
    try:
        protocol, location = parse_address(address)
        # For an address with an unknown protocol, a client would keep trying in the background.
        host = get_backend(protocol).get_address_host(location)
    except (ValueError, ImportError) as error:
        raise _no_scheduler(address, str(error)) from error
    if protocol not in ENCRYPTED and not insecure and not _is_here(host):
        raise StudyError(
            f"{address} asks for no certificate: everyone who reaches it can run code under your "
            "account; name a tls:// address, or use --insecure"
        )
    security = Security()
    if protocol in ENCRYPTED:
        _check_certificates(address, security)
    try:
        asyncio.run(_identity(address, security))
        client = Client(address, security=security, timeout=CONNECT_SECONDS)
    except OSError as error:
        why = str(error) or "nothing listens there, or the program there does not answer"
        raise _no_scheduler(address, why) from error
    except Exception as error:
        # Dask reads the first bytes of any answer as the size of a message.
        raise _no_scheduler(address, "the program there uses another protocol") from error
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
            raise scheduler_lost(error) from error
        yield DaskExecutor(client)


def _is_here(host: str) -> bool:
    """Return whether a host is this machine, reached only from itself (loopback)."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _check_certificates(address: str, security: Security) -> None:
    """Raise StudyError if there are no certificates for a scheduler."""
    try:
        certificates = security.get_connection_args("client").get("ssl_context")
        why = "none are named"
    except (OSError, ValueError) as error:
        certificates = None
        why = str(error)
    if not certificates:
        raise StudyError(
            f"{address} asks for certificates ({why}): name them in Dask's configuration, "
            "distributed.comm.tls.ca-file, client.cert and client.key"
        )


def check_workers(there: Mapping[str, dict[str, str] | Exception]) -> None:
    """Compare the versions on the workers, by address, with the versions in this process.

    A worker that answered with an error cannot run cmmsim. A worker that did not answer (OSError)
    is gone, and is not checked. Other versions of other packages give a warning.

    Raises StudyError if a worker has another cmmsim, or none.
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

    A client would wait forever for a program that listens and never answers. Raises OSError if
    there is no answer in time, and other errors if the answer is not from a scheduler.
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
    """Silence Dask's log of joining and leaving workers, which users of a study do not need."""
    for name in (
        "distributed",
        "distributed.client",
        "distributed.core",
        "tornado.application",
        "asyncio",
    ):
        logging.getLogger(name).setLevel(logging.CRITICAL)
